"""Which numbers of a graph differ between the lanes of a batch, and where lanes part."""

from collections.abc import Iterator, Sequence
from typing import Any

from natcoord_jax.native.graph import Branch, Buffer, Graph, Loop, Node, Region, Store, Test


class Lanes:
    """What differs between lanes.

    Args:
        graph: a whole program.
        varies: which of its inputs differ.

    Attributes:
        nodes: numbers of the nodes that differ.
        buffers: memory with a number for each lane.
        parting: loops that lanes leave at different times, and branches that some lanes take.
    """

    def __init__(self, graph: Graph, varies: Sequence[bool]):
        self.nodes: set[int] = set()
        self.buffers = {
            b for b in graph.buffers if b.role == "output" or (b.role == "input" and varies[b.place])
        }
        self.parting: set[Region] = set()
        if not any(varies):
            return
        items = list(_items(graph.top))
        known = -1
        while known != self._size():
            known = self._size()
            for node in graph.nodes:
                if node.number not in self.nodes and self._differs(node):
                    self.nodes.add(node.number)
            for region, item in items:
                self._look(region, item)

    def _size(self) -> int:
        return len(self.nodes) + len(self.buffers) + len(self.parting)

    def __contains__(self, node: Node) -> bool:
        return node.number in self.nodes

    def _differs(self, node: Node) -> bool:
        if node.op == "load" and node.detail in self.buffers:
            return True
        return any(x.number in self.nodes for x in node.args)

    def _look(self, region: Region, item: Any) -> None:
        if isinstance(item, Store):
            if item.value in self or item.address in self or self.apart(region, item.buffer):
                self.buffers.add(item.buffer)
        elif isinstance(item, Test):
            if item.node in self:
                self.parting.add(region)
        elif isinstance(item, Loop):
            parting = item.region in self.parting
            for node, first, following in item.region.carries:
                if first in self or (following is not node and (parting or following in self)):
                    self.nodes.add(node.number)
        elif isinstance(item, Branch):
            if item.chosen in self:
                self.parting.update(item.regions)
            for k, node in enumerate(item.merges):
                if item.chosen in self or any(values[k] in self for values in item.values):
                    self.nodes.add(node.number)

    def apart(self, region: Region | None, buffer: Buffer) -> bool:
        """Whether lanes part between where a buffer belongs and a region inside."""
        while region is not None and region is not buffer.home:
            if region in self.parting:
                return True
            region = region.parent
        return False


def _items(region: Region) -> Iterator[tuple[Region, Any]]:
    for item in region.items:
        yield region, item
        inner = [item.region] if isinstance(item, Loop) else item.regions if isinstance(item, Branch) else []
        for one in inner:
            yield from _items(one)
