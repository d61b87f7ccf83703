"""A jaxpr as a flat program: calls written out, what nobody needs left out.

Operations keep the names and the parameters of JAX. Loops and branches hold programs of their own.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

CALLS = {
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat": "jaxpr",
    "checkpoint": "jaxpr",
    "xla_metadata_call": "jaxpr",
}
"""Calls that are written out: where their programs are."""

IDENTITIES = frozenset(("stop_gradient", "optimization_barrier", "copy", "copy_p", "passage"))
"""Operations whose results are their operands."""

LOOPS = frozenset(("while", "scan", "cond"))
"""Operations with programs of their own."""


class UncoveredError(Exception):
    """What a program holds that no machine code is made of here."""


class Value:
    """The result of an operation, or an input."""

    __slots__ = ("aval",)

    def __init__(self, aval: Any):
        self.aval = aval


class Literal:
    """An array that is known."""

    __slots__ = ("array", "aval")

    def __init__(self, array: Any, aval: Any):
        self.array, self.aval = np.asarray(array), aval


@dataclass(eq=False)
class Operation:
    """An operation: its name, operands, results and parameters, and the programs in it."""

    name: str
    operands: list[Any]
    results: list[Value]
    params: dict[str, Any]
    programs: list["Program"] = field(default_factory=list)


@dataclass(eq=False)
class Program:
    """Operations in order, from inputs to outputs."""

    inputs: list[Value]
    outputs: list[Any]
    operations: list[Operation]


def flattened(closed: Any) -> Program:
    """The program of a closed jaxpr, whose constants are known."""
    return without_dead_code(_program(closed.jaxpr, closed.consts))


def _program(jaxpr: Any, consts: Sequence[Any]) -> Program:
    values: dict[Any, Any] = {v: Literal(x, v.aval) for v, x in zip(jaxpr.constvars, consts)}
    inputs = []
    for variable in jaxpr.invars:
        values[variable] = Value(variable.aval)
        inputs.append(values[variable])
    operations: list[Operation] = []
    return Program(inputs, _written_out(jaxpr, values, operations), operations)


def _written_out(jaxpr: Any, values: dict[Any, Any], operations: list[Operation]) -> list[Any]:
    """Append the operations of a jaxpr; returns its outputs."""

    def read(x: Any) -> Any:
        return Literal(x.val, x.aval) if isinstance(x, jex.Literal) else values[x]

    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        operands = [read(x) for x in equation.invars]
        if name in IDENTITIES:
            results = operands
        elif name in CALLS:
            results = _called(params[CALLS[name]], operands, operations)
        elif name == "linear_pair":
            value = params["sides"][0].value
            shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in operands]
            results = _called(jax.make_jaxpr(value)(*shapes), operands, operations)
        elif name == "native":
            results = _called(_lanes_of(params, equation.invars), operands, operations)
        else:
            results = [Value(x.aval) for x in equation.outvars]
            inner = [_program(x.jaxpr, x.consts) for x in _programs_in(name, params)]
            operations.append(Operation(name, operands, results, dict(params), inner))
        values.update(zip(equation.outvars, results))
    return [read(x) for x in jaxpr.outvars]


def _called(inner: Any, operands: Sequence[Any], operations: list[Operation]) -> list[Any]:
    closed = isinstance(inner, jex.ClosedJaxpr)
    jaxpr, consts = (inner.jaxpr, inner.consts) if closed else (inner, ())
    values = {x: Literal(c, x.aval) for x, c in zip(jaxpr.constvars, consts)}
    return _written_out(jaxpr, values | dict(zip(jaxpr.invars, operands)), operations)


def _lanes_of(params: dict[str, Any], given: Sequence[Any]) -> Any:
    """The program of such an operation within another one, for all its lanes."""
    closed = params["code"].closed
    if params["lanes"] is None:
        return closed
    axes = [0 if batched else None for batched in params["varies"]]
    lanes = jax.vmap(jex.jaxpr_as_fun(closed), in_axes=axes, axis_size=params["lanes"])
    return jax.make_jaxpr(lanes)(*(jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in given))


def _programs_in(name: str, params: dict[str, Any]) -> list[Any]:
    if name == "while":
        return [params["cond_jaxpr"], params["body_jaxpr"]]
    if name == "scan":
        return [params["jaxpr"]]
    return list(params["branches"]) if name == "cond" else []


def without_dead_code(program: Program) -> Program:
    """Drop what the outputs do not need, carries of loops included; changes the program."""
    needed = {id(x) for x in program.outputs}
    kept = []
    for operation in reversed(program.operations):
        if not any(id(x) in needed for x in operation.results):
            continue
        if operation.name in LOOPS:
            _SHORTENED[operation.name](operation, needed)
        needed.update(id(x) for x in operation.operands)
        kept.append(operation)
    program.operations = kept[::-1]
    return program


def _picked(items: Iterable[Any], kept: Iterable[bool]) -> list[Any]:
    return [x for x, keep in zip(items, kept) if keep]


def _are_used(program: Program, inputs: Sequence[Any]) -> list[bool]:
    read = {id(x) for x in program.outputs} | {id(x) for o in program.operations for x in o.operands}
    return [id(x) in read for x in inputs]


def _inputs_needed(program: Program, wanted: Sequence[bool]) -> list[bool]:
    """Which inputs some of the outputs depend on."""
    needed = {id(x) for x, want in zip(program.outputs, wanted) if want}
    for operation in reversed(program.operations):
        if any(id(x) in needed for x in operation.results):
            needed.update(id(x) for x in operation.operands)
    return [id(x) in needed for x in program.inputs]


def _fixed_point(flags: list[bool], more: Callable[[list[bool]], list[bool]]) -> list[bool]:
    """The least set that holds these and all that it asks for."""
    while True:
        grown = [a or b for a, b in zip(flags, more(flags))]
        if grown == flags:
            return flags
        flags = grown


def _shorten_while(operation: Operation, needed: set[int]) -> None:
    condition, body = operation.programs
    c, b = operation.params["cond_nconsts"], operation.params["body_nconsts"]
    tested = _inputs_needed(condition, [True])[c:]
    used = [id(x) in needed or test for x, test in zip(operation.results, tested)]
    used = _fixed_point(used, lambda flags: _inputs_needed(body, flags)[b:])
    body.outputs = _picked(body.outputs, used)
    without_dead_code(body)
    without_dead_code(condition)
    of_test, of_body = _are_used(condition, condition.inputs[:c]), _are_used(body, body.inputs[:b])
    kept = [*of_test, *of_body, *used]
    operation.operands = _picked(operation.operands, kept)
    condition.inputs = _picked(condition.inputs, [*of_test, *used])
    body.inputs = _picked(body.inputs, [*of_body, *used])
    operation.results = _picked(operation.results, used)
    operation.params |= {"cond_nconsts": sum(of_test), "body_nconsts": sum(of_body)}


def _shorten_scan(operation: Operation, needed: set[int]) -> None:
    (body,) = operation.programs
    c, n = operation.params["num_consts"], operation.params["num_carry"]
    used = [id(x) in needed for x in operation.results]

    def more(flags: list[bool]) -> list[bool]:
        return _inputs_needed(body, flags)[c : c + n] + flags[n:]

    used = _fixed_point(used, more)
    body.outputs = _picked(body.outputs, used)
    without_dead_code(body)
    consts, rows = _are_used(body, body.inputs[:c]), _are_used(body, body.inputs[c + n :])
    kept = [*consts, *used[:n], *rows]
    operation.operands, body.inputs = (_picked(x, kept) for x in (operation.operands, body.inputs))
    operation.results = _picked(operation.results, used)
    operation.params |= {"num_consts": sum(consts), "num_carry": sum(used[:n])}


def _shorten_cond(operation: Operation, needed: set[int]) -> None:
    used = [id(x) in needed for x in operation.results]
    for branch in operation.programs:
        branch.outputs = _picked(branch.outputs, used)
        without_dead_code(branch)
    operation.results = _picked(operation.results, used)
    read = [_are_used(branch, branch.inputs) for branch in operation.programs]
    kept = [any(flags) for flags in zip(*read)]
    for branch in operation.programs:
        branch.inputs = _picked(branch.inputs, kept)
    operation.operands = operation.operands[:1] + _picked(operation.operands[1:], kept)


_SHORTENED = {"while": _shorten_while, "scan": _shorten_scan, "cond": _shorten_cond}
