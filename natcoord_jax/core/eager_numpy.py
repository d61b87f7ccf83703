"""Small calculations in NumPy: what is done once costs no compilation.

An operation of JAX that is called from Python is a program of its own, which takes tens of milliseconds to
compile for every new shape, and setting up a scene needs hundreds of them. What `eager_numpy` wraps is traced
instead, and its operations are evaluated by NumPy one after the other. Inside of a transformation
it is the function itself, so that there is one formulation only.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from natcoord_jax.core.checks import as_array, at_top_level
from natcoord_jax.core.closures import with_callables
from natcoord_jax.core.numpy_operations import OPERATIONS

REMEMBERED = 256
"""Programs of one function that are kept."""

LARGE = 1_000_000
"""Numbers from which on the time of NumPy is more than that of the compiler: one million, some 0.3 s."""

F = TypeVar("F", bound=Callable[..., Any])


def eager_numpy(function: F) -> F:
    """The function, evaluated by NumPy where nothing is being traced, and compiled for large arrays.

    Args:
        function: of pytrees, pure and without checks of values (traced, it sees none). Arrays are numbers
            of the program; all else, numbers of Python too, is part of it, as with `equinox.filter_jit`.
            Operations that have no counterpart here are called as they would be without this.

    Returns:
        A function with the same results up to round-off, arrays of JAX.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> from natcoord_jax.core.eager_numpy import eager_numpy
        >>> float(eager_numpy(lambda x: jnp.sum(x**2))(jnp.array([3.0, 4.0])))
        25.0
    """
    programs: dict[Any, tuple[ClosedJaxpr, Any]] = {}
    compiled = eqx.filter_jit(function)

    def run(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        given, rest = [x for x in leaves if _is_array(x)], [x for x in leaves if not _is_array(x)]
        if not at_top_level(leaves) or not all(map(_is_numeric, given)):
            return function(*arguments)
        # What is no array and no plain value may have changed since: a function by what it reads.
        lasting = all(isinstance(x, PLAIN) for x in rest)
        if lasting and sum(x.size for x in given) > LARGE:
            return compiled(*arguments)
        arrays = [np.asarray(x) for x in given]
        # The representation tells 0.0 from -0.0, and 1 from True.
        key = structure, *((x.shape, x.dtype) if _is_array(x) else repr(x) for x in leaves)
        traced = programs.get(key) if lasting else None
        if traced is None:
            traced = _traced(function, leaves, structure)
            if len(programs) >= REMEMBERED:
                programs.clear()
            if lasting:
                programs[key] = traced
        program, made = traced
        with np.errstate(all="ignore"):
            found = evaluate(program, arrays)
        return jax.tree.unflatten(made, [as_array(x) for x in found])

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return with_callables(function, run, arguments)

    return call  # pyright: ignore[reportReturnType]


def stacked(items: Sequence[Any]) -> Any:
    """`jnp.stack`, without a program where nothing is being traced."""
    if at_top_level(*items):
        return as_array(np.stack([np.asarray(x) for x in items]))
    return jnp.stack(items)


PLAIN = (bool, int, float, complex, str, bytes, np.generic)
"""Values that cannot change."""


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray))


def _is_numeric(array: Any) -> bool:
    """Not so are keys of random numbers."""
    return jnp.issubdtype(array.dtype, np.number) or jnp.issubdtype(array.dtype, np.bool_)


def _traced(function: Callable[..., Any], leaves: list[Any], structure: Any) -> tuple[ClosedJaxpr, Any]:
    """Program of the arrays among the leaves, and the structure of what it gives."""

    def of_arrays(*given: Any) -> Any:
        rest = iter(given)
        every = [next(rest) if _is_array(x) else x for x in leaves]
        return function(*jax.tree.unflatten(structure, every))

    arrays = [np.asarray(x) for x in leaves if _is_array(x)]
    program, shapes = jax.make_jaxpr(of_arrays, return_shape=True)(*arrays)
    return program, jax.tree.structure(shapes)


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
        know(equation.outvars, _apply(equation, [value_of(atom) for atom in equation.invars]))
        for variable in done:
            del known[variable]
    return [value_of(atom) for atom in jaxpr.outvars]


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


def _apply(equation: Any, operands: list[np.ndarray]) -> Sequence[Any]:
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


def _scan(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    if "ft_in" in given:  # since JAX 0.11
        fixed, carried, _ = (len(list(part)) for part in given["ft_in"].unpack())
    else:
        fixed, carried = given["num_consts"], given["num_carry"]
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
    while evaluate(given["cond_jaxpr"], [*test, *state])[0]:
        state = evaluate(given["body_jaxpr"], [*body, *state])
    return state


def _cond(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    branches = given["branches"]
    return evaluate(branches[int(np.clip(operands[0], 0, len(branches) - 1))], operands[1:])


def _split(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    return np.split(operands[0], np.cumsum(given["sizes"])[:-1], given["axis"])


def _unstack(given: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    # Of a vector these are numbers of NumPy, which are no arrays.
    return [np.asarray(x) for x in np.moveaxis(operands[0], given["axis"], 0)]


FLOWS = {"scan": _scan, "while": _while, "cond": _cond, "split": _split, "unstack": _unstack}
"""Operations with several results, by name."""
