"""Scalar operations in nested regions: folded, numbered by value, and moved out of loops.

A node is one number, in each lane of a batch. Regions are straight pieces of code: the whole program, bodies
of loops and branches. What happens in order (stores, loops, branches) are the items of a region; a node is
computed where an item first needs it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

TYPES = {
    "float64": "f64", "float32": "f32", "int64": "i64", "int32": "i32", "int16": "i16", "int8": "i8",
    "uint64": "u64", "uint32": "u32", "uint16": "u16", "uint8": "u8", "bool": "b",
}  # fmt: skip
"""Names of the types of numbers."""

DTYPES = {short: np.dtype(name) for name, short in TYPES.items()}


class Node:
    """A number.

    Attributes:
        op: what computes it: "const", "load", "phi" (a carry of a loop), "index", "merge", or an operation.
        type: of the number, see `TYPES`.
        args: operands.
        detail: value of a constant, buffer of a load, or None.
        home: region it belongs to.
        number: in the order of creation.
    """

    __slots__ = ("args", "detail", "home", "number", "op", "type")

    def __init__(
        self, op: str, type: str, args: tuple["Node", ...], detail: Any, home: "Region", number: int
    ):
        self.op, self.type, self.args, self.detail, self.home, self.number = (
            op,
            type,
            args,
            detail,
            home,
            number,
        )

    @property
    def is_const(self) -> bool:
        """Whether its value is known."""
        return self.op == "const"


@dataclass(eq=False)
class Buffer:
    """Memory for an array.

    Attributes:
        number: of the buffer.
        size: numbers in it.
        type: of these.
        home: region in which it is written.
        role: "work", "constant", "input" or "output".
        place: which input or output it is; the numbers of a constant.
        version: how often it was written in place.
        pending: loads since then.
    """

    number: int
    size: int
    type: str
    home: "Region"
    role: str = "work"
    place: Any = None
    version: int = 0
    pending: list[Node] = field(default_factory=list)


@dataclass(eq=False)
class Store:
    """A number that is written."""

    buffer: Buffer
    address: Node
    value: Node


@dataclass(eq=False)
class Pin:
    """A load that has to be made here at the latest."""

    node: Node


@dataclass(eq=False)
class Test:
    """Where a loop ends if this does not hold."""

    node: Node


@dataclass(eq=False)
class Loop:
    """A loop: over an index, or while its test holds."""

    region: "Region"
    count: int | None


@dataclass(eq=False)
class Branch:
    """Branches, one of which runs, and what they result in: merges, by branch."""

    chosen: Node
    regions: list["Region"]
    merges: list[Node]
    values: list[list[Node]]


class Region:
    """A straight piece of code.

    Attributes:
        kind: "top", "loop" or "branch".
        parent: around it.
        items: what happens in it, in order.
        loops: how many it is in.
        known: nodes by value.
        index: of a loop over an index.
        carries: (carry, first value, next value) of a loop.
    """

    def __init__(self, kind: str, parent: "Region | None", number: int):
        self.kind, self.parent, self.number = kind, parent, number
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.loops: int = 0 if parent is None else parent.loops + (kind == "loop")
        self.items: list[Any] = []
        self.known: dict[Any, Node] = {}
        self.index: Node | None = None
        self.carries: list[list[Any]] = []

    def within(self, other: "Region") -> bool:
        """Whether it is another region or inside of it."""
        region: Region | None = self
        while region is not None and region.depth > other.depth:
            region = region.parent
        return region is other


def _quotient(a: Any, b: Any) -> Any:
    if isinstance(a, np.floating):
        return a / b
    return type(a)(abs(int(a)) // abs(int(b)) * (1 if (a < 0) == (b < 0) else -1)) if b != 0 else type(a)(-1)


def _remainder(a: Any, b: Any) -> Any:
    return a if b == 0 and not isinstance(a, np.floating) else np.fmod(a, b)


FOLDED: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _quotient, "rem": _remainder,
    "max": np.maximum, "min": np.minimum, "neg": np.negative, "abs": np.abs, "sqrt": np.sqrt,
    "floor": np.floor, "ceil": np.ceil, "isfinite": np.isfinite,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "shra": np.right_shift, "select": lambda p, a, b: a if p else b,
}  # fmt: skip
"""Operations on known numbers; other functions are left to the compiler."""

COMPARISONS = frozenset(("eq", "ne", "lt", "le", "gt", "ge"))
COMMUTATIVE = frozenset(("add", "mul", "and", "or", "xor", "eq", "ne"))


class Graph:
    """Nodes as they are made, in the region that is open.

    Attributes:
        region: the open one.
        top: the whole program.
        statements: number of nodes and stores.
        nodes: all of them, in the order of creation.
        buffers: all memory.
    """

    def __init__(self):
        self.top = self.region = Region("top", None, 0)
        self.regions, self.statements = 1, 0
        self.buffers: list[Buffer] = []
        self.nodes: list[Node] = []
        self._consts: dict[Any, Node] = {}

    # Regions

    def open(self, kind: str) -> Region:
        """A region inside of the open one."""
        self.region = Region(kind, self.region, self.regions)
        self.regions += 1
        return self.region

    def close(self) -> Region:
        """Go back to the region around."""
        region = self.region
        assert region.parent is not None
        self.region = region.parent
        return region

    def open_loop(self, indexed: bool) -> Region:
        """The body of a loop; its item is appended when it is closed."""
        region = self.open("loop")
        if indexed:
            region.index = self._node("index", "i64", (), None, region)
        return region

    def close_loop(self, count: int | None) -> None:
        """End the body; its carries are values of the region around from now on."""
        region = self.close()
        for carry, *_ in region.carries:
            carry.home = self.region
        self.region.items.append(Loop(region, count))

    def carry(self, first: Node) -> Node:
        """A number that goes from trip to trip of the loop whose body is open; see `carried_on`."""
        node = self._node("phi", first.type, (), None, self.region)
        self.region.carries.append([node, first, node])
        return node

    def merge(self, type: str) -> Node:
        """What branches result in, which are the next item."""
        return self._node("merge", type, (), None, self.region)

    # Numbers

    def constant(self, value: Any, type: str) -> Node:
        """A number that is known."""
        value = DTYPES[type].type(value)
        key = type, value.tobytes()
        if key not in self._consts:
            self._consts[key] = self._node("const", type, (), value, self.top)
        return self._consts[key]

    def integer(self, value: int) -> Node:
        """A place that is known."""
        return self.constant(value, "i64")

    def _node(self, op: str, type: str, args: tuple[Node, ...], detail: Any, home: Region) -> Node:
        self.statements += 1
        node = Node(op, type, args, detail, home, self.statements)
        self.nodes.append(node)
        return node

    def op(self, name: str, type: str, *args: Node) -> Node:
        """The number that an operation finds."""
        if name in FOLDED and all(x.op == "const" for x in args):
            with np.errstate(all="ignore"):
                return self.constant(FOLDED[name](*(x.detail for x in args)), type)
        simple = self._simplified(name, args)
        if simple is not None:
            return simple
        if name in COMMUTATIVE and args[0].number > args[1].number:
            args = args[::-1]
        return self._numbered(name, type, args, None, max(x.home.depth for x in args))

    def _numbered(self, op: str, type: str, args: tuple[Node, ...], detail: Any, depth: int) -> Node:
        """The node of this value, outside of loops (but not of branches) that do not change its operands."""
        key = op, type, detail if op != "load" else (id(detail), detail.version), *args
        region: Region | None = self.region
        while region is not None:
            if key in region.known:
                return region.known[key]
            region = region.parent
        home = self.outermost(depth)
        node = home.known[key] = self._node(op, type, args, detail, home)
        return node

    def outermost(self, depth: int) -> Region:
        """The region of a depth at least that is left by leaving loops only."""
        region = self.region
        while region.kind == "loop" and region.depth > depth:
            assert region.parent is not None
            region = region.parent
        return region

    def _simplified(self, name: str, args: Sequence[Node]) -> Node | None:
        """The operand that an operation leaves as it is, where there is one."""

        def holds(k: int, number: Any) -> bool:
            return args[k].op == "const" and bool(args[k].detail == number)

        if name in ("add", "or", "xor") and holds(0, 0):
            return args[1]
        if name in ("add", "sub", "or", "xor") and holds(1, 0):
            return args[0]
        if name == "mul" and holds(0, 1):
            return args[1]
        if name in ("mul", "div") and holds(1, 1):
            return args[0]
        if name == "select":
            if args[0].op == "const":
                return args[1] if args[0].detail else args[2]
            return args[1] if args[1] is args[2] else None
        if name in ("and", "or", "max", "min") and args[0] is args[1]:
            return args[0]
        if args[0].type == "b" and name in ("and", "or"):
            for x, other in (args, args[::-1]):
                if x.op == "const":
                    return other if bool(x.detail) == (name == "and") else x
        if name in ("mul", "and") and args[0].type not in ("f64", "f32") and (holds(0, 0) or holds(1, 0)):
            return args[0] if holds(0, 0) else args[1]
        return None

    def convert(self, x: Node, type: str) -> Node:
        """The same number of another type."""
        if x.type == type:
            return x
        if x.op == "const":
            integral = type not in ("f64", "f32")
            if type == "b":
                return self.constant(x.detail != 0, type)
            if not integral or x.type not in ("f64", "f32") or abs(x.detail) < 2**31:
                return self.constant(np.array(x.detail).astype(DTYPES[type])[()], type)
        return self._numbered("convert", type, (x,), None, x.home.depth)

    # Memory

    def buffer(self, size: int, type: str, role: str = "work", place: Any = None) -> Buffer:
        """Memory that is written in the open region; that of constants and inputs is there at once."""
        made = Buffer(len(self.buffers), size, type, self.region if role == "work" else self.top, role, place)
        self.buffers.append(made)
        return made

    def load(self, buffer: Buffer, address: Node) -> Node:
        """A number of a buffer."""
        depth = max(address.home.depth, buffer.home.depth)
        before = self.statements
        node = self._numbered("load", buffer.type, (address,), buffer, depth)
        if self.statements > before and buffer.role == "work":
            buffer.pending.append(node)
        return node

    def store(self, buffer: Buffer, address: Node, value: Node, region: Region | None = None) -> None:
        """Write a number."""
        self.statements += 1
        (region or self.region).items.append(Store(buffer, address, value))

    def overwritten(self, buffer: Buffer) -> None:
        """Say that a buffer is written in place from here on: what was read of it stays what it was."""
        for node in buffer.pending:
            self.pin(node)
        buffer.version += 1
        buffer.pending = []

    def pin(self, node: Node) -> None:
        """Make a load here, if not before."""
        if node.home is self.region:
            self.region.items.append(Pin(node))
