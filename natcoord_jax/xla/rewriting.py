"""Programs rewritten operation by operation, so that nothing in them is handed to a library.

Small products become sums, scatters updates of slices, long reductions loops; see `one_kernel` for what for.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from natcoord_jax.xla.evaluation import loop_parts
from natcoord_jax.xla.expansions import written_out
from natcoord_jax.xla.numpy_operations import OPERATIONS
from natcoord_jax.xla.tracing import is_concrete

KNOWN = frozenset(
    "abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh bitcast_convert_type "
    "broadcast_in_dim cbrt ceil clamp concatenate cond convert_element_type copy copy_p cos cosh "
    "cumsum custom_vmap_call div dynamic_slice dynamic_update_slice eq erf erf_inv erfc exp exp2 "
    "expand_dims expm1 floor gather ge gt integer_pow iota is_finite jit le log log1p logistic lt max "
    "min mul ne neg nextafter not optimization_barrier or pad pjit platform_index pow reduce_and "
    "reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt scan select_n "
    "shift_left shift_right_arithmetic shift_right_logical sign sin sinh slice split sqrt square "
    "squeeze stack stop_gradient sub tan tanh tile transpose unstack while xla_metadata_call xor".split()
)
"""Primitives that are compiled in place, without a call into a library."""

INLINED = {
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "closed_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}
"""Calls that are written out, as their names and rules for derivatives are of no use here: where their
programs are."""

REWRITTEN = frozenset(("dot_general", "scatter", "scatter-add", *INLINED))
"""Primitives that may be rewritten in terms of those."""


AS_AN_OPERAND = {"broadcast_in_dim": 0, "dynamic_update_slice": 1, "scatter": 2, "scatter-add": 2}
"""Operations that find no more numbers than an operand has: that is repeated, or put into an array."""


def inner_programs(equation: Any) -> list[Any]:
    """Programs among the parameters of an equation."""
    found = []
    for value in equation.params.values():
        for x in value if isinstance(value, tuple | list) else (value,):
            if isinstance(x, jex.ClosedJaxpr):
                found.append(x.jaxpr)
            elif isinstance(x, jex.Jaxpr):
                found.append(x)
    return found


def operations(program: Any) -> int:
    """Number of operations of a program and of all programs in it that its outputs need."""
    return sum(1 + sum(map(operations, inner_programs(equation))) for equation in _needed(program))


def mean_size(program: Any) -> float:
    """Numbers that an operation of a program finds on average.

    The record of all steps, which each step updates in place, says nothing about the size of one.
    """
    count, numbers = _sizes(program)
    return numbers / max(count, 1)


def _sizes(program: Any) -> tuple[int, int]:
    """Operations without programs in them, and the numbers that they find."""
    count, numbers = 0, 0
    for equation in _needed(program):
        for a, b in [_sizes(x) for x in inner_programs(equation)] or [(1, _changed(equation))]:
            count, numbers = count + a, numbers + b
    return count, numbers


def _changed(equation: Any) -> int:
    """Numbers that an operation finds."""
    place = AS_AN_OPERAND.get(equation.primitive.name)
    arrays = equation.outvars if place is None else [equation.invars[place]]
    return sum(math.prod(x.aval.shape) for x in arrays)


def _needed(program: Any) -> list[Any]:
    """Equations of a program that its outputs need."""
    wanted, found = set(map(id, program.outvars)), []
    for equation in reversed(program.eqns):
        if equation.effects or any(id(x) in wanted for x in equation.outvars):
            wanted.update(map(id, equation.invars))
            found.append(equation)
    return found[::-1]


def known(program: Any, names: frozenset[str] | None = None) -> bool:
    """Whether a program holds nothing but the operations of these names, by default `KNOWN`."""
    names = KNOWN if names is None else names
    return all(
        equation.primitive.name in names and all(known(inner, names) for inner in inner_programs(equation))
        for equation in program.eqns
    )


FEW = 1000
"""Numbers of an array up to which it is part of a program, if they are known whole numbers or truths."""


def _is_whole(x: Any) -> bool:
    """Whether something is a small array of these."""
    return isinstance(x.dtype, np.dtype) and x.dtype.kind in "iub" and math.prod(x.shape) <= FEW


class Flat:
    """A program as a function of its constants and arguments, in one list.

    Attributes:
        program: closed.
        known: constants that are part of it, as indices are; None for others.
        consts: these.
    """

    def __init__(self, program: Any):
        self.program, every = program, program.consts
        self.known = [np.asarray(x) if is_concrete(x) and _is_whole(x) else None for x in every]
        self.consts = [x for x, known in zip(every, self.known) if known is None]

    def _parts(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        given = iter(values)
        return [next(given) if x is None else x for x in self.known], list(given)

    def __call__(self, *values: Any) -> list[Any]:
        """Its outputs."""
        consts, arguments = self._parts(values)
        return jex.jaxpr_as_fun(jex.ClosedJaxpr(self.program.jaxpr, consts))(*arguments)

    def rewritten(self, *values: Any) -> list[Any]:
        """Its outputs, rewritten on the way."""
        return _evaluate(self.program.jaxpr, *self._parts(values))


def _evaluate(program: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    values: dict[Any, Any] = dict(zip(program.constvars, consts)) | dict(zip(program.invars, arguments))

    def read(x: Any) -> Any:
        return x.val if isinstance(x, jex.Literal) else values[x]

    for equation in _needed(program):
        given = [read(x) for x in equation.invars]
        found = _worked_out(equation, given)
        if found is not None:
            values[equation.outvars[0]] = found
            continue
        scope = str(equation.source_info.name_stack)
        if scope:
            with jax.named_scope(scope):
                found = _apply(equation, given)
        else:
            found = _apply(equation, given)
        values.update(zip(equation.outvars, found))
    return [read(x) for x in program.outvars]


def _worked_out(equation: Any, given: list[Any]) -> np.ndarray | None:
    """The output of an operation of known whole numbers or truths; None: it is none."""
    operation = OPERATIONS.get(equation.primitive.name)
    out: Any = equation.outvars[0].aval
    if operation is None or not _is_whole(out):
        return None
    at: list[Any] = equation.invars
    literal = [isinstance(x, jex.Literal) for x in at]
    given = [np.asarray(x, v.aval.dtype) if fixed else x for v, x, fixed in zip(at, given, literal)]
    if not all(isinstance(x, np.ndarray) for x in given):
        return None
    found = operation(*given, **equation.params)
    return None if found is NotImplemented else np.asarray(found, out.dtype)


def _apply(equation: Any, given: list[Any]) -> list[Any]:
    """Outputs of one equation."""
    name, params = equation.primitive.name, equation.params
    found = written_out(equation, given)
    if found is not None:
        return [found]
    if name in INLINED and isinstance(params.get(INLINED[name]), jex.ClosedJaxpr):
        inner = params[INLINED[name]]
        return _evaluate(inner.jaxpr, inner.consts, given)
    if name != "custom_vmap_call":
        constant = partial(_constant, name, given, params)
        params = {key: _inside(value, constant(key)) for key, value in params.items()}
    found = equation.primitive.bind(*given, **params)
    return list(found) if equation.primitive.multiple_results else [found]


def _constant(name: str, given: Sequence[Any], params: dict[str, Any], key: str) -> Sequence[Any]:
    """What the first arguments of a program in a branch or a loop are in all turns, by its parameter."""
    if name == "cond":
        return given[1:]
    if name == "scan":
        return given[: loop_parts(params)[0]]
    if name == "while":
        of_test = params["cond_nconsts"]
        return given[:of_test] if key == "cond_jaxpr" else given[of_test:][: params["body_nconsts"]]
    return ()


def _inside(value: Any, constant: Sequence[Any]) -> Any:
    """A parameter with the programs it holds rewritten, with what is known of their arguments in them."""
    if isinstance(value, tuple) and value and all(isinstance(x, jex.ClosedJaxpr) for x in value):
        return tuple(_inside(x, constant) for x in value)
    if not isinstance(value, jex.ClosedJaxpr):
        return value
    flat = Flat(value)

    def run(*arguments: Any) -> list[Any]:
        known = [k if isinstance(k, np.ndarray) else x for k, x in zip(constant, arguments)]
        return flat.rewritten(*flat.consts, *known, *arguments[len(known) :])

    return jax.make_jaxpr(run)(*value.in_avals)
