"""Arrays of a program: of known numbers and nodes, in memory, or not computed yet.

Small arrays are as many nodes: slices, transposes and gathers of them cost nothing. Large ones are in memory.
What is elementwise of large arrays is computed in the loop that needs it (fusion).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from natcoord_jax.native.graph import TYPES, Buffer, Graph, Node, Region
from natcoord_jax.native.program import UncoveredError

SMALL = 640
"""Numbers up to which an array is nodes: more than a Newton matrix of 25 unknowns has."""

ONCE = 64
"""The same outside of loops: what is there once is not worth the time that the compiler takes for it."""

CHEAP = 2
"""Operations of a number up to which it is computed again where it is needed again."""

UNROLLED = 64
"""Terms up to which a sum is written out."""

Place = int | Node
"""An index: known or not."""


class Array:
    """An array.

    Attributes:
        shape: of it.
        type: of its numbers.
        nodes: array of objects (nodes); or None.
        buffer: memory it is in; or None.
        strides: of its axes there.
        offset: of its first number there.
        owned: whether nothing else needs the memory, so that it may be written in place.
        compute: a function of an index to a node, for what is not computed yet; or None.
        cost: operations of that function, about.
        reads: buffers that it reads.
    """

    def __init__(self, shape: Sequence[int], type: str):
        self.shape, self.type = tuple(shape), type
        self.nodes: Any = None
        self.buffer: Buffer | None = None
        self.strides: tuple[int, ...] = ()
        self.offset: Place = 0
        self.owned = False
        self.compute: Callable[[tuple[Place, ...]], Node] | None = None
        self.cost = 0
        self.reads: frozenset[Buffer] = frozenset()
        self.copy: tuple[Array, Region] | None = None

    @property
    def size(self) -> int:
        """Number of numbers."""
        return math.prod(self.shape)

    @property
    def is_contiguous(self) -> bool:
        """Whether its numbers follow each other in memory."""
        return self.strides == contiguous(self.shape)

    @property
    def same(self) -> Node | None:
        """The node that all of its numbers are, where it is nodes that are stored once."""
        if (
            self.nodes is None
            or self.nodes.size == 0
            or any(self.nodes.strides[k] for k in _long(self.shape))
        ):
            return None
        return self.nodes.flat[0]


def _long(shape: Sequence[int]) -> list[int]:
    return [k for k, n in enumerate(shape) if n > 1]


def contiguous(shape: Sequence[int]) -> tuple[int, ...]:
    """Strides of an array whose numbers follow each other; zero along axes of one."""
    strides, step = [], 1
    for n in reversed(shape):
        strides.append(step if n > 1 else 0)
        step *= n
    return tuple(reversed(strides))


def type_of(aval: Any) -> str:
    """The type of the numbers of an array.

    Raises:
        UncoveredError: for another one.
    """
    name = getattr(aval.dtype, "name", str(aval.dtype))
    if name not in TYPES:
        raise UncoveredError(f"numbers of type {name}")
    return TYPES[name]


class Arrays:
    """Arrays and their numbers, in a graph."""

    def __init__(self, small: int = SMALL):
        self.graph, self.most = Graph(), small

    @property
    def small(self) -> int:
        """Numbers up to which an array is nodes where the graph is now; what runs once is in loops."""
        return min(self.most, ONCE) if self.graph.region.loops == 0 else self.most

    # Making

    def of_nodes(self, nodes: Any, type: str) -> Array:
        """An array of nodes."""
        made = Array(nodes.shape, type)
        made.nodes = nodes
        return made

    def filled(self, node: Node, shape: Sequence[int]) -> Array:
        """An array of one number."""
        return self.of_nodes(np.broadcast_to(_scalar(node), tuple(shape)), node.type)

    def literal(self, values: Any, type: str) -> Array:
        """An array that is known."""
        values = np.asarray(values)
        if values.size and (values == values.flat[0]).all():
            return self.filled(self.graph.constant(values.flat[0], type), values.shape)
        if values.size > self.small:
            return self.in_memory(values.shape, type, "constant", values)
        nodes = np.empty(values.shape, object)
        for index in np.ndindex(*values.shape):
            nodes[index] = self.graph.constant(values[index], type)
        return self.of_nodes(nodes, type)

    def in_memory(self, shape: Sequence[int], type: str, role: str = "work", place: Any = None) -> Array:
        """An array in memory of its own."""
        made = Array(shape, type)
        made.buffer = self.graph.buffer(made.size, type, role, place)
        made.strides, made.owned = contiguous(made.shape), role == "work"
        made.reads = frozenset((made.buffer,))
        return made

    def view(self, x: Array, shape: Sequence[int], strides: Sequence[int], offset: Place) -> Array:
        """Another view of an array in memory."""
        made = Array(shape, x.type)
        made.buffer, made.offset = x.buffer, offset
        made.strides = tuple(s if n > 1 else 0 for s, n in zip(strides, made.shape))
        made.reads = x.reads
        return made

    def made(
        self, shape: Sequence[int], type: str, compute: Callable, operands: Sequence[Array], cost: int = 1
    ) -> Array:
        """An array by a function from index to node: nodes at once if it is small, else computed later."""
        if math.prod(shape) <= self.small:
            nodes = np.empty(tuple(shape), object)
            for index in np.ndindex(*shape):
                nodes[index] = compute(index)
            return self.of_nodes(nodes, type)
        made = Array(shape, type)
        made.compute = compute
        made.cost = cost + sum(x.cost for x in operands)
        made.reads = frozenset().union(*(x.reads for x in operands))
        return made

    # Reading

    def at(self, x: Array, index: Sequence[Place]) -> Node:
        """A number of an array."""
        if x.nodes is not None:
            if all(isinstance(k, int) for k in index):
                return x.nodes[tuple(index)]
            if x.same is not None:
                return x.same
            x = self.stored(x)
        if x.buffer is None:
            if x.copy is not None and self.graph.region.within(x.copy[1]):
                return self.at(x.copy[0], index)
            assert x.compute is not None
            return x.compute(tuple(index))
        address = self.address(x, index)
        if x.buffer.role == "constant" and address.is_const:
            return self.graph.constant(np.asarray(x.buffer.place).reshape(-1)[int(address.detail)], x.type)
        return self.graph.load(x.buffer, address)

    def plus(self, a: Place, b: Place) -> Place:
        """Sum of two places."""
        if isinstance(a, int) and isinstance(b, int):
            return a + b
        return self._place(self.graph.op("add", "i64", self.node(a), self.node(b)))

    def times(self, a: Place, b: int) -> Place:
        """A multiple of a place."""
        return a * b if isinstance(a, int) else self._place(self.graph.op("mul", "i64", a, self.node(b)))

    def node(self, place: Place) -> Node:
        """A place as a number."""
        return self.graph.integer(place) if isinstance(place, int) else place

    def _place(self, node: Node) -> Place:
        return int(node.detail) if node.is_const else node

    def place(self, node: Node) -> Place:
        """A number as a place."""
        return self._place(self.graph.convert(node, "i64"))

    def address(self, x: Array, index: Sequence[Place]) -> Node:
        """Where in its buffer a number is."""
        known, rest = 0, x.offset
        for k, stride in zip(index, x.strides):
            if stride and isinstance(k, int):
                known += k * stride
            elif stride:
                rest = self.plus(rest, self.times(k, stride))
        return self.node(self.plus(rest, known))

    # Memory

    def stored(self, x: Array) -> Array:
        """The same array in memory, where it may be already."""
        if x.buffer is not None:
            return x
        if x.copy is not None and self.graph.region.within(x.copy[1]):
            return x.copy[0]
        if x.nodes is not None:
            made, region = self._stored_nodes(x)
        else:
            made, region = self.computed(x), self.graph.region
        made.owned = False
        x.copy = made, region
        return made

    def _stored_nodes(self, x: Array) -> tuple[Array, Region]:
        """Nodes written to memory, once outside of loops that do not change them."""
        wide = tuple(n > 1 and s == 0 for n, s in zip(x.shape, x.nodes.strides))
        if any(wide):
            narrow = x.nodes[tuple(slice(0, 1) if w else slice(None) for w in wide)]
            base = self.stored(self.of_nodes(narrow, x.type))
            strides = tuple(0 if w else s for w, s in zip(wide, base.strides))
            return self.view(base, x.shape, strides, base.offset), self.graph.region
        flat = x.nodes.reshape(-1)
        if all(node.is_const for node in flat):
            return self.in_memory(x.shape, x.type, "constant", [n.detail for n in flat]), self.graph.top
        region = self.graph.outermost(max(node.home.depth for node in flat))
        made = self.in_memory(x.shape, x.type)
        assert made.buffer is not None
        made.buffer.home = region
        for k, node in enumerate(flat):
            self.graph.store(made.buffer, self.graph.integer(k), node, region)
        return made, region

    def computed(self, x: Array) -> Array:
        """A copy in memory of its own, which may be written."""
        made = self.in_memory(x.shape, x.type)
        self.fill(made, x)
        return made

    def fill(self, target: Array, x: Array) -> None:
        """Write an array to memory."""
        if x.size == 0:
            return
        same = x.same
        if same is not None and target.is_contiguous and x.size > 4:
            flat = self.view(target, (x.size,), (1,), target.offset)
            self.each((x.size,), lambda index: self.put(flat, index, same))
        elif x.nodes is not None or x.size <= 4:
            for index in np.ndindex(*x.shape):
                self.put(target, index, self.at(x, index))
        else:
            self.each(x.shape, lambda index: self.put(target, index, self.at(x, index)))

    def fill_in_turn(self, target: Array, nodes: Any) -> None:
        """Write over a whole array, number by number: each is read for the last time before it is written."""
        assert target.buffer is not None
        known = [x for x in target.buffer.pending if x.args[0].is_const]
        target.buffer.pending = [x for x in target.buffer.pending if not x.args[0].is_const]
        self.graph.overwritten(target.buffer)
        reads = {int(x.args[0].detail): x for x in known}
        for place, index in enumerate(np.ndindex(*target.shape)):
            if place in reads:
                self.graph.pin(reads[place])
            self.put(target, index, nodes[index])

    def put(self, target: Array, index: Sequence[Place], node: Node) -> None:
        """Write a number to memory."""
        assert target.buffer is not None
        self.graph.store(target.buffer, self.address(target, index), node)

    def each(self, shape: Sequence[int], act: Callable[[tuple[Place, ...]], None]) -> None:
        """Do something for every index, in loops."""
        index: list[Place] = []
        for n in shape:
            if n == 1:
                index.append(0)
                continue
            region = self.graph.open_loop(indexed=True)
            assert region.index is not None
            index.append(region.index)
        act(tuple(index))
        for n in reversed(shape):
            if n > 1:
                self.graph.close_loop(n)

    def combined(
        self, extents: Sequence[int], term: Callable, first: Node, combine: Callable, most: int = UNROLLED
    ) -> Node:
        """Combine terms over all indices: as a tree if they are few, else in a loop."""
        if math.prod(extents) <= most:
            return self._as_tree([term(index) for index in np.ndindex(*extents)], first, combine)
        index: list[Place] = []
        totals = [first]
        for _ in extents:
            region = self.graph.open_loop(indexed=True)
            assert region.index is not None
            index.append(region.index)
            totals.append(self.graph.carry(totals[-1]))
        new = combine(totals[-1], term(tuple(index)))
        for n, total in zip(reversed(extents), reversed(totals[1:])):
            self.graph.region.carries[-1][2] = new
            self.graph.close_loop(n)
            new = total
        return new

    @staticmethod
    def _as_tree(terms: list[Node], first: Node, combine: Callable) -> Node:
        while len(terms) > 1:
            pairs = [terms[k : k + 2] for k in range(0, len(terms), 2)]
            terms = [combine(*pair) if len(pair) == 2 else pair[0] for pair in pairs]
        return terms[0] if terms else first

    # Shapes

    def reshaped(self, x: Array, shape: Sequence[int]) -> Array:
        """The same numbers in another shape."""
        shape = tuple(shape)
        if x.shape == shape:
            return x
        if x.nodes is not None:
            same = x.same
            return (
                self.filled(same, shape)
                if same is not None
                else self.of_nodes(x.nodes.reshape(shape), x.type)
            )
        if x.compute is not None:
            strides = _restrided(x.shape, contiguous(x.shape), shape)
            later = None if strides is None else self._viewed_later(x, shape, strides, 0)
            if later is not None:
                return later
        x = self.stored(x)
        strides = _restrided(x.shape, x.strides, shape)
        if strides is None:
            x = self.stored(self._again(x))
            strides = contiguous(shape)
        return self.view(x, shape, strides, x.offset)

    def _again(self, x: Array) -> Array:
        made = Array(x.shape, x.type)
        made.compute, made.reads = (lambda index: self.at(x, index)), x.reads
        return made

    def viewed(self, x: Array, change: Callable[[Any], Any]) -> Array:
        """What a function of NumPy that makes views (a slice, a transpose) makes of an array."""
        if x.nodes is not None:
            return self.of_nodes(change(x.nodes), x.type)
        if x.compute is not None:
            later = self._viewed_later(x, *_view(x.shape, contiguous(x.shape), change))
            if later is not None:
                return later
        x = self.stored(x)
        shape, strides, moved = _view(x.shape, x.strides, change)
        return self.view(x, shape, strides, self.plus(x.offset, moved))

    def _viewed_later(
        self, x: Array, shape: Sequence[int], strides: Sequence[int], offset: int
    ) -> Array | None:
        """A view of what is not computed yet, if it is no more work."""
        axes = _axes_of(x.shape, shape, strides)
        if axes is None or (math.prod(shape) > x.size and x.cost > CHEAP):
            return None
        first = np.unravel_index(offset, x.shape) if x.size else [0] * len(x.shape)

        def compute(index: Sequence[Place]) -> Node:
            old: list[Place] = [int(k) for k in first]
            for axis, step, k in axes:
                old[axis] = self.plus(old[axis], self.times(index[k], step))
            return self.at(x, old)

        return self.made(shape, x.type, compute, [x], 0)


_BYTE = np.empty(1, np.int8)
"""What views are made of, without being read, to know their strides."""


def _view(
    shape: Sequence[int], strides: Sequence[int], change: Callable[[Any], Any]
) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """Shape, strides and offset of a view that a function of NumPy makes."""
    base = np.lib.stride_tricks.as_strided(_BYTE, shape, strides)
    found = change(base)
    start = base.__array_interface__["data"][0]
    return found.shape, found.strides, found.__array_interface__["data"][0] - start if found.size else 0


def _axes_of(
    old: Sequence[int], new: Sequence[int], strides: Sequence[int]
) -> list[tuple[int, int, int]] | None:
    """Axes of an array that those of a view run along: (axis, step, axis of the view); None: of several."""
    found, steps = [], contiguous(old)
    for k, (n, stride) in enumerate(zip(new, strides)):
        if n == 1 or not stride:
            continue
        fitting = [
            axis
            for axis, (size, step) in enumerate(zip(old, steps))
            if step and stride % step == 0 and abs(stride) * (n - 1) <= step * (size - 1)
        ]
        if not fitting:
            return None
        found.append((fitting[0], stride // steps[fitting[0]], k))
    return found


def _scalar(node: Node) -> Any:
    made = np.empty((), object)
    made[()] = node
    return made


def _restrided(old: Sequence[int], strides: Sequence[int], new: Sequence[int]) -> tuple[int, ...] | None:
    """Strides of a view of another shape; None where there is none."""
    if math.prod(old) == 0:
        return contiguous(new)
    axes = [(n, s) for n, s in zip(old, strides) if n > 1]
    found, k = [], 0
    remaining: list[tuple[int, int]] = []
    for n in new:
        if n == 1:
            found.append(0)
            continue
        if not remaining:
            if k >= len(axes):
                return None
            remaining = [axes[k]]
            k += 1
        size, step = remaining[0]
        while size < n or size % n:
            if k >= len(axes):
                return None
            more, inner = axes[k]
            if step != more * inner:
                return None
            size, step, k = size * more, inner, k + 1
        found.append(step * (size // n))
        remaining = [(size // n, step)] if size > n else []
    return tuple(found)
