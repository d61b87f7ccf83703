"""Traced programs evaluated by NumPy, one operation after the other, without a compilation."""

import math
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr as ClosedJaxpr
from jax.extend.core import Jaxpr
from jax.extend.core import Literal as Literal

from natcoord_jax.xla.numpy_operations import OPERATIONS


def evaluate(program: ClosedJaxpr, arguments: Sequence[Any]) -> list[np.ndarray]:
    """Values of a traced program for given arrays."""
    return _run(program.jaxpr, program.consts, arguments)


def _run(jaxpr: Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    known: dict[Any, np.ndarray] = {}

    def know(variables: Sequence[Any], values: Sequence[Any]) -> None:
        for variable, value in zip(variables, values, strict=True):
            known[variable] = np.asarray(value, variable.aval.dtype)

    def value_of(atom: Any) -> np.ndarray:
        if isinstance(atom, Literal):
            literal: Any = atom
            return np.asarray(literal.val, literal.aval.dtype)
        return known[atom]

    know([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments])
    for equation, done in zip(jaxpr.eqns, _last_uses(jaxpr)):
        know(equation.outvars, apply(equation, [value_of(atom) for atom in equation.invars]))
        for variable in done:
            del known[variable]
    return [value_of(atom) for atom in jaxpr.outvars]


def numbers_made(program: ClosedJaxpr) -> int:
    """How many numbers its evaluation makes, those of loops of known length as often as they are made."""
    found = 0
    for equation in program.jaxpr.eqns:
        inner = [equation.params[key] for key in INNER if isinstance(equation.params.get(key), ClosedJaxpr)]
        found += equation.params.get("length", 1) * sum(map(numbers_made, inner))
        found += sum(math.prod(x.aval.shape) for x in equation.outvars) if not inner else 0
    return found


_LAST_USES: WeakKeyDictionary[Jaxpr, list[list[Any]]] = WeakKeyDictionary()


def _last_uses(jaxpr: Jaxpr) -> list[list[Any]]:
    """Variables that are not needed beyond each equation: long trajectories make large arrays."""
    if jaxpr not in _LAST_USES:
        needed = {id(atom) for atom in jaxpr.outvars}
        done: list[list[Any]] = []
        for equation in reversed(jaxpr.eqns):
            last = {id(x): x for x in (*equation.outvars, *equation.invars) if not isinstance(x, Literal)}
            done.append([x for key, x in last.items() if key not in needed])
            needed.update(last)
        _LAST_USES[jaxpr] = done[::-1]
    return _LAST_USES[jaxpr]


def apply(equation: Any, operands: list[np.ndarray]) -> Sequence[Any]:
    """What one operation of a program gives."""
    name, given = equation.primitive.name, equation.params
    inner = next((given[key] for key in INNER if isinstance(given.get(key), ClosedJaxpr)), None)
    if name in CALLS and inner is not None:
        return evaluate(inner, operands)
    if name in FLOWS:
        return FLOWS[name](given, operands)
    known = OPERATIONS.get(name)
    result = NotImplemented if known is None else known(*operands, **given)
    if result is not NotImplemented:
        return [result]
    found = equation.primitive.bind(*map(jnp.asarray, operands), **given)
    return found if equation.primitive.multiple_results else [found]


CALLS = frozenset("jit pjit custom_jvp_call custom_vjp_call custom_vmap_call closed_call".split())
"""Operations that are programs with a name."""

INNER = "jaxpr", "call_jaxpr", "call"
"""Where they keep them."""


def loop_parts(given: dict[str, Any]) -> tuple[int, int]:
    """Of the operands of a scan, how many are constants and how many are carried."""
    if "ft_in" in given:  # since JAX 0.11
        fixed, carried, _ = (len(list(part)) for part in given["ft_in"].unpack())
        return fixed, carried
    return given["num_consts"], given["num_carry"]


def _scan(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    fixed, carried = loop_parts(given)
    constants, state = operands[:fixed], operands[fixed : fixed + carried]
    listed, body = operands[fixed + carried :], given["jaxpr"]
    order = range(given["length"])
    made: list[list[Any]] = []
    for k in reversed(order) if given["reverse"] else order:
        results = evaluate(body, [*constants, *state, *(x[k] for x in listed)])
        state = results[:carried]
        made.append(results[carried:])
    if given["reverse"]:
        made.reverse()
    empty = [np.zeros((0, *v.aval.shape), v.aval.dtype) for v in body.jaxpr.outvars[carried:]]
    return [*state, *([np.stack(x) for x in zip(*made)] if made else empty)]


def _while(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    of_test, of_body = given["cond_nconsts"], given["body_nconsts"]
    test, body = operands[:of_test], operands[of_test : of_test + of_body]
    state = operands[of_test + of_body :]
    while True:
        (going,) = evaluate(given["cond_jaxpr"], [*test, *state])
        if not np.any(going):
            return state
        found = evaluate(given["body_jaxpr"], [*body, *state])
        # Of many loops at once those that have ended stay as they are.
        lanes = (np.reshape(going, going.shape + (1,) * (x.ndim - going.ndim)) for x in found)
        state = [np.where(on, x, old) if going.ndim else x for on, x, old in zip(lanes, found, state)]


def _cond(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    branches = given["branches"]
    return evaluate(branches[int(np.clip(operands[0], 0, len(branches) - 1))], operands[1:])


FLOWS = {
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "split": lambda given, x: np.split(x[0], np.cumsum(given["sizes"])[:-1], given["axis"]),
    # Of a vector these are numbers of NumPy, which are no arrays.
    "unstack": lambda given, x: [np.asarray(row) for row in np.moveaxis(x[0], given["axis"], 0)],
}
"""Operations with several results, by name."""
