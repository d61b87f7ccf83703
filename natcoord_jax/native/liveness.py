"""What the outputs of a graph depend on, number by number: carries of loops that nobody reads go."""

from collections import defaultdict
from typing import Any

from natcoord_jax.native.graph import Branch, Buffer, Graph, Loop, Node, Region, Store, Test


class Live:
    """What is needed.

    Attributes:
        nodes: numbers of the nodes.
        buffers: memory that is read.
        regions: loops and branches in which anything is.
    """

    def __init__(self, graph: Graph):
        self.nodes: set[int] = set()
        self.buffers: set[Buffer] = set()
        self.regions: set[Region] = set()
        self._stores: dict[Buffer, list[tuple[Region, Store]]] = defaultdict(list)
        self._sources: dict[int, tuple[Node, ...]] = {}
        self._inside: dict[int, Region] = {}
        self._tests: dict[Region, Node] = {}
        self._stack: list[Node] = []
        self._enter(graph.top)
        for buffer in graph.buffers:
            if buffer.role == "output":
                self._read(buffer)
        while self._stack:
            self._visit(self._stack.pop())

    def __contains__(self, node: Node) -> bool:
        return node.number in self.nodes

    def _enter(self, region: Region) -> None:
        """Note what depends on what, besides operands."""
        for item in region.items:
            if isinstance(item, Store):
                self._stores[item.buffer].append((region, item))
            elif isinstance(item, Test):
                self._tests[region] = item.node
            elif isinstance(item, Loop):
                for node, first, following in item.region.carries:
                    self._sources[node.number] = first, following
                    self._inside[node.number] = item.region
                self._enter(item.region)
            elif isinstance(item, Branch):
                for k, node in enumerate(item.merges):
                    self._sources[node.number] = item.chosen, *(values[k] for values in item.values)
                    self._inside[node.number] = region
                for inner in item.regions:
                    self._tests[inner] = item.chosen
                    self._enter(inner)

    def _need(self, node: Node) -> None:
        if node.number not in self.nodes:
            self.nodes.add(node.number)
            self._stack.append(node)

    def _read(self, buffer: Buffer) -> None:
        if buffer in self.buffers:
            return
        self.buffers.add(buffer)
        for region, store in self._stores.pop(buffer, ()):
            self._need(store.address)
            self._need(store.value)
            self._run(region)

    def _run(self, region: Region | None) -> None:
        """A region has to be gone through, and what decides about that is needed."""
        while region is not None and region not in self.regions:
            self.regions.add(region)
            if region in self._tests:
                self._need(self._tests[region])
            region = region.parent

    def _visit(self, node: Node) -> None:
        for x in (*node.args, *self._sources.get(node.number, ())):
            self._need(x)
        self._run(self._inside.get(node.number, node.home))
        if node.op == "load":
            self._read(node.detail)


def lasting(items: list[Any], live: Live) -> list[Any]:
    """The items of a region that anything is needed of."""
    kept = []
    for item in items:
        if isinstance(item, Store):
            keep = item.buffer in live.buffers
        elif isinstance(item, Loop):
            keep = item.region in live.regions
        elif isinstance(item, Branch):
            keep = any(region in live.regions for region in item.regions) or any(
                x in live for x in item.merges
            )
        elif isinstance(item, Test):
            keep = True
        else:
            keep = item.node in live
        if keep:
            kept.append(item)
    return kept
