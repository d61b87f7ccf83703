"""From a program to a graph: operation by operation, with loops and branches."""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from natcoord_jax.native import indexing
from natcoord_jax.native.arrays import CHEAP, SMALL, Array, Arrays, Place, type_of
from natcoord_jax.native.graph import Branch, Graph, Node, Test
from natcoord_jax.native.program import Literal, Operation, Program, UncoveredError
from natcoord_jax.native.rules import RULES, as_nodes, elementwise, has_rule, joined

CARRIED = 64
"""Numbers up to which what goes from trip to trip of a loop is nodes: others, which most trips leave as they
are, would be copied in each."""

WRITTEN_OUT = 4000
"""Statements of all trips of a scan together, up to which it is written out."""

IN_PLACE = frozenset(("dynamic_update_slice", *indexing.HOW))
"""Operations that may write into their first operand."""

Values = list[Array]


class Built:
    """A graph and what it reads and writes.

    Attributes:
        graph: of all operations.
        inputs: shapes and types of what is read.
        outputs: of what is written.
    """

    def __init__(self, program: Program, small: int = SMALL):
        self.arrays = Arrays(small)
        self.graph: Graph = self.arrays.graph
        self.inputs = [x.aval for x in program.inputs]
        self.outputs = [x.aval for x in program.outputs]
        values = [self._input(k, aval) for k, aval in enumerate(self.inputs)]
        for k, x in enumerate(run(self.arrays, program, values)):
            self._output(k, x)

    def _input(self, k: int, aval: Any) -> Array:
        x = self.arrays.in_memory(aval.shape, type_of(aval), "input", k)
        return self.arrays.of_nodes(as_nodes(self.arrays, x), x.type) if x.size <= self.arrays.small else x

    def _output(self, k: int, x: Array) -> None:
        """Let a large array be written where it is to be read; write others there.

        Lanes lie side by side in memory, but one after the other outside, where reading takes longer.
        """
        buffer = x.buffer
        large = x.size > self.arrays.most
        if (
            large
            and x.owned
            and buffer is not None
            and buffer.role == "work"
            and buffer.home is self.graph.top
        ):
            if x.is_contiguous and x.size == buffer.size:
                buffer.role, buffer.place = "output", k
                return
        self.arrays.fill(self.arrays.in_memory(x.shape, x.type, "output", k), x)


def run(a: Arrays, program: Program, values: Sequence[Array]) -> Values:
    """Build the operations of a program; from arrays of its inputs to those of its outputs."""
    known = {id(x): value for x, value in zip(program.inputs, values)}
    last: dict[int, int] = {}
    count: dict[int, int] = {}
    for k, operation in enumerate(program.operations):
        for x in operation.operands:
            last[id(x)] = k
            count[id(x)] = count.get(id(x), 0) + 1
    for x in program.outputs:
        last[id(x)] = len(program.operations)

    def value(x: Any) -> Array:
        return a.literal(x.array, type_of(x.aval)) if isinstance(x, Literal) else known[id(x)]

    for k, operation in enumerate(program.operations):
        operands = [value(x) for x in operation.operands]

        def free(number: int, k: int = k, operands: Values = operands) -> bool:
            """Whether nothing reads the memory of an operand after this operation, or beside it.

            What is not computed yet and reads it is computed first.
            """
            buffer = operands[number].buffer
            beside = [j for j, x in enumerate(operands) if j != number and buffer in x.reads]
            after = [j for j, x in known.items() if last.get(j, -1) > k and buffer in x.reads]
            if any(x.compute is None for x in (*(operands[j] for j in beside), *(known[j] for j in after))):
                return False
            operands[:] = [a.stored(x) if j in beside else x for j, x in enumerate(operands)]
            known.update({j: a.stored(known[j]) for j in after})
            return True

        for x, found in zip(operation.results, _applied(a, operation, operands, free)):
            assert found.shape == tuple(x.aval.shape), (operation.name, found.shape, x.aval)
            if found.compute is not None and count.get(id(x), 0) > 1 and found.cost > CHEAP:
                found = a.stored(found)
            known[id(x)] = found
    return [value(x) for x in program.outputs]


def _applied(a: Arrays, operation: Operation, operands: Values, free: Callable[[int], bool]) -> Values:
    name = operation.name
    if name in CONTROL:
        return CONTROL[name](a, operation, operands, free)
    if name == "dynamic_update_slice":
        return [indexing.update_slice(a, operation, operands, free(0))]
    if name in indexing.HOW:
        return [indexing.scatter(a, operation, operands, free(0))]
    found = RULES.get(name, elementwise)(a, operation, operands)
    return found if isinstance(found, list) else [found]


def borrowed(a: Arrays, x: Array) -> Array:
    """An array for a program inside: computed, and not to be written."""
    x = a.stored(x) if x.compute is not None else x
    return x if x.buffer is None else a.view(x, x.shape, x.strides, x.offset)


# Carries


def _in_memory(body: Program, x: Any, size: int, small: int) -> bool:
    """Whether a carry is in memory: large, or indexed by what is found on the way."""
    if size <= 1 or size > small:
        return size > small
    for operation in body.operations:
        if (
            operation.operands
            and operation.operands[0] is x
            and operation.name in (*IN_PLACE, "dynamic_slice")
        ):
            first = 3 if operation.name in indexing.HOW else 2 if operation.name != "dynamic_slice" else 1
            places = operation.operands[1:2] if first == 3 else operation.operands[first:]
            if not all(isinstance(place, Literal) for place in places):
                return True
    return False


class Carries:
    """What goes from trip to trip of a loop: nodes, or memory that is written.

    Args:
        a: arrays.
        starts: of all carries.
        body: of the loop, and its inputs for them.
        unchanged: which of them are the same in every trip.
        free: whether memory of a carry may be written.
    """

    def __init__(
        self,
        a: Arrays,
        starts: Values,
        body: Program,
        inputs: Sequence[Any],
        unchanged: Sequence[bool],
        free: Any,
    ):
        self.a, self.unchanged = a, unchanged
        self.starts = [
            borrowed(a, x)
            if same or x.size == 0
            else self._memory(x, free(k))
            if _in_memory(body, y, x.size, min(a.most, CARRIED))
            else a.of_nodes(as_nodes(a, x), x.type)
            for k, (x, y, same) in enumerate(zip(starts, inputs, unchanged))
        ]

    def _memory(self, x: Array, free: bool) -> Array:
        owned = x.owned and free and x.buffer is not None and x.is_contiguous and x.size == x.buffer.size
        return x if owned else self.a.computed(x)

    def begun(self) -> Values:
        """The carries, in the body, which is open."""
        a = self.a
        region = a.graph.region
        self.now: Values = []
        for x, same in zip(self.starts, self.unchanged):
            if same or x.size == 0:
                self.now.append(x)
            elif x.buffer is not None:
                self.now.append(x)
                x.buffer.home = region
            else:
                nodes = np.empty(x.shape, object)
                for index in np.ndindex(*x.shape):
                    nodes[index] = a.graph.carry(x.nodes[index])
                self.now.append(a.of_nodes(nodes, x.type))
        return list(self.now)

    def prepare(self) -> None:
        """Before the body is opened: what was read of memory so far stays what it was."""
        for x, same in zip(self.starts, self.unchanged):
            if x.buffer is not None and not same and x.size:
                self.a.graph.overwritten(x.buffer)

    def settle(self, new: Values) -> None:
        """At the end of the body: what the next trip begins with."""
        a = self.a
        carries = {id(entry[0]): entry for entry in a.graph.region.carries}
        changing = {
            x.buffer for x, same in zip(self.now, self.unchanged) if x.buffer is not None and not same
        }
        late: list[tuple[Array, Array]] = []
        for x, y, same in zip(self.now, new, self.unchanged):
            if same or x.size == 0:
                continue
            if x.nodes is not None:
                for node, following in zip(x.nodes.flat, as_nodes(a, y).flat):
                    carries[id(node)][2] = following
            elif y.buffer is not x.buffer or not (y.is_contiguous and y.offset == 0):
                late.append((x, a.computed(y) if changing & y.reads else y))
        for x, y in late:
            assert x.buffer is not None
            if y.nodes is None or y.same is not None:
                a.graph.overwritten(x.buffer)
                a.fill(x, y)
            else:
                a.fill_in_turn(x, y.nodes)

    def ended(self) -> Values:
        """The carries after the loop, whose body is closed."""
        for x, same in zip(self.now, self.unchanged):
            if x.buffer is not None and not same and x.size:
                x.buffer.home = self.a.graph.region
                self.a.graph.overwritten(x.buffer)
        return self.now


def _while(a: Arrays, operation: Operation, operands: Values, free: Callable[[int], bool]) -> Values:
    condition, body = operation.programs
    c, b = operation.params["cond_nconsts"], operation.params["body_nconsts"]
    of_test, of_body = ([borrowed(a, x) for x in part] for part in (operands[:c], operands[c : c + b]))
    unchanged = [x is y for x, y in zip(body.outputs, body.inputs[b:])]
    carries = Carries(a, operands[c + b :], body, body.inputs[b:], unchanged, lambda k: free(c + b + k))
    carries.prepare()
    a.graph.open_loop(indexed=False)
    now = carries.begun()
    (test,) = run(a, condition, [*of_test, *now])
    going = as_nodes(a, test)
    either = partial(a.graph.op, "or", "b")
    a.graph.region.items.append(Test(reduce(either, going.flat)))
    if going.shape:
        # Loops side by side go on as long as any does, and those that have ended keep what they have.
        new = run(a, body, [*of_body, *(borrowed(a, x) for x in now)])
        new = [x if same else _where(a, going, x, y) for x, y, same in zip(new, now, unchanged)]
    else:
        new = run(a, body, [*of_body, *now])
    carries.settle(new)
    a.graph.close_loop(None)
    return carries.ended()


def _where(a: Arrays, going: Any, new: Array, old: Array) -> Array:
    """The new array where loops go on, along its first axes, and the old one elsewhere."""
    test, axes = a.of_nodes(going, "b"), len(going.shape)

    def compute(index: Sequence[Place]) -> Node:
        return a.graph.op("select", new.type, a.at(test, index[:axes]), a.at(new, index), a.at(old, index))

    return a.made(new.shape, new.type, compute, [test, new, old])


def _scan(a: Arrays, operation: Operation, operands: Values, free: Callable[[int], bool]) -> Values:
    p, (body,) = operation.params, operation.programs
    c, n, length, backwards = p["num_consts"], p["num_carry"], p["length"], p["reverse"]
    consts, starts, rows = operands[:c], operands[c : c + n], [borrowed(a, x) for x in operands[c + n :]]
    consts = [borrowed(a, x) for x in consts]
    shapes = [x.aval for x in operation.results[n:]]
    largest = max((x.size for x in starts), default=0)
    if length * statements_of(body, a.most) <= WRITTEN_OUT and largest <= a.most:
        return _written_out(a, body, length, backwards, consts, starts, rows, shapes)
    unchanged = [x is y for x, y in zip(body.outputs, body.inputs[c : c + n])]
    carries = Carries(a, starts, body, body.inputs[c : c + n], unchanged, lambda k: free(c + k))
    found = [a.in_memory(x.shape, type_of(x), "work") for x in shapes]
    rows = [a.stored(x) for x in rows]
    carries.prepare()
    region = a.graph.open_loop(indexed=True)
    now = carries.begun()
    trip: Place = region.index  # pyright: ignore[reportAssignmentType]
    if backwards:
        trip = a.place(a.graph.op("sub", "i64", a.graph.integer(length - 1), a.node(trip)))
    new = run(a, body, [*consts, *now, *(_row(a, x, trip) for x in rows)])
    for x, y in zip(found, new[n:]):
        a.fill(_row(a, x, trip), y)
    carries.settle(new[:n])
    a.graph.close_loop(length)
    return [*carries.ended(), *found]


def _row(a: Arrays, x: Array, k: Place) -> Array:
    if x.nodes is not None:
        assert isinstance(k, int)
        return a.reshaped(a.of_nodes(x.nodes[k : k + 1], x.type), x.shape[1:])
    return a.view(x, x.shape[1:], x.strides[1:], a.plus(x.offset, a.times(k, x.strides[0])))


def _written_out(
    a: Arrays,
    body: Program,
    length: int,
    backwards: bool,
    consts: Values,
    carry: Values,
    rows: Values,
    shapes: Any,
) -> Values:
    """All trips of a scan, one after the other."""
    found: list[Values] = [[] for _ in range(length)]
    n = len(carry)
    for k in reversed(range(length)) if backwards else range(length):
        carry = [borrowed(a, x) for x in carry]
        new = run(a, body, [*consts, *carry, *(_row(a, x, k) for x in rows)])
        carry, found[k] = new[:n], new[n:]
    stacked = []
    for j, aval in enumerate(shapes):
        parts = [a.reshaped(row[j], (1, *row[j].shape)) for row in found]
        stacked.append(_joined(a, parts, aval))
    return [*carry, *stacked]


def _joined(a: Arrays, parts: Values, aval: Any) -> Array:
    return joined(a, parts, 0, aval) if parts else a.literal(np.zeros(aval.shape), type_of(aval))


LOOP = 8
"""Statements of an operation of a large array, which is a loop."""

FREE = frozenset(
    "broadcast_in_dim reshape squeeze expand_dims transpose slice concatenate iota stack unstack split rev "
    "tile pad".split()
)
"""Operations that only say where numbers are."""


def statements_of(program: Program, small: int = SMALL) -> int:
    """Statements that a program becomes, about; those of loops once, whatever the number of their trips."""
    total = 0
    for operation in program.operations:
        if operation.programs:
            total += sum(statements_of(x, small) for x in operation.programs)
        elif operation.name not in FREE:
            size, terms = _work_of(operation)
            total += size * terms if size <= small else LOOP * min(terms, small)
    return total


def _work_of(operation: Operation) -> tuple[int, int]:
    """How many numbers an operation finds, and of how many terms each."""
    found = sum(math.prod(x.aval.shape) for x in operation.results)
    if operation.name in IN_PLACE:
        return math.prod(operation.operands[2 if operation.name in indexing.HOW else 1].aval.shape), 1
    if operation.name == "dot_general":
        (left, _), _ = operation.params["dimension_numbers"]
        return found, 2 * math.prod(operation.operands[0].aval.shape[k] for k in left)
    if operation.name.startswith("reduce_"):
        return found, math.prod(operation.operands[0].aval.shape) // max(found, 1)
    return found, 1


def _cond(a: Arrays, operation: Operation, operands: Values, free: Callable[[int], bool]) -> Values:
    g, programs = a.graph, operation.programs
    chosen = a.at(operands[0], ())
    last = len(programs) - 1
    if chosen.is_const:
        return run(a, programs[min(max(int(chosen.detail), 0), last)], [borrowed(a, x) for x in operands[1:]])
    inputs = [borrowed(a, x) for x in operands[1:]]
    avals = [x.aval for x in operation.results]
    targets = [
        a.in_memory(aval.shape, type_of(aval)) if math.prod(aval.shape) > a.small else None for aval in avals
    ]
    regions, values = [], []
    for program in programs:
        regions.append(g.open("branch"))
        found = run(a, program, inputs)
        numbers: list[Node] = []
        for x, target in zip(found, targets):
            if target is None:
                numbers += list(as_nodes(a, x).flat)
            else:
                a.fill(target, x)
        values.append(numbers)
        g.close()
    merges = [g.merge(x.type) for x in values[0]]
    if chosen.type == "b":
        chosen = g.convert(chosen, "i32")
    chosen = g.op("min", chosen.type, g.op("max", chosen.type, chosen, g.constant(0, chosen.type)),
                  g.constant(last, chosen.type))  # fmt: skip
    g.region.items.append(Branch(chosen, regions, merges, values))
    results, k = [], 0
    for aval, target in zip(avals, targets):
        size = math.prod(aval.shape)
        if target is not None:
            results.append(target)
            continue
        nodes = np.empty(size, object)
        nodes[:] = merges[k : k + size]
        results.append(a.of_nodes(nodes.reshape(aval.shape), type_of(aval)))
        k += size
    return results


CONTROL: dict[str, Callable[..., Values]] = {"while": _while, "scan": _scan, "cond": _cond}
"""Operations with programs of their own."""


def covered(program: Program) -> None:
    """Look whether there are rules for all operations.

    Raises:
        UncoveredError: for one without.
    """
    for operation in program.operations:
        if operation.name in CONTROL:
            for inner in operation.programs:
                covered(inner)
        elif operation.name not in IN_PLACE and not has_rule(operation):
            raise UncoveredError(f"the operation {operation.name}")
