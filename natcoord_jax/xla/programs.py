"""What a function computes, as a program that can be compared, and the numbers in it apart.

A function of Python is known by what it does when it is traced: whatever it reads (a global, a closure, an
attribute, the content of an array) is in the program then. Two functions are the same if their programs are,
and what differs between them may be numbers only: those are taken out and become arguments.
"""

import importlib.util
import os
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex

from natcoord_jax.xla.tracing import is_concrete, is_numeric

FEW = 1000
"""Integers up to which an array of them, as of indices, is part of the program, and not an argument."""

LIBRARIES = frozenset("natcoord_jax jax jaxlib equinox numpy optax".split())
"""Packages whose functions read nothing that changes."""


class Kind(NamedTuple):
    """An array among arguments."""

    shape: tuple[int, ...]
    dtype: Any


class Fixed(NamedTuple):
    """Something else among arguments or results, which is part of the program."""

    type: type
    value: Hashable


class Signature(NamedTuple):
    """How a callable is called: by which method, with what arguments."""

    method: str
    structure: Any
    kinds: tuple[Kind | Fixed, ...]


class Program:
    """A traced function; equal to another one if both compute the same from arguments and constants.

    Attributes:
        jaxpr: its equations, whose first arguments are the constants.
        kept: constants that are part of it; None for those that are arguments.
        axes: numbers of axes of the others.
        made: structure of its results, and what of them is no array.
        key: what is compared.
    """

    def __init__(self, jaxpr: Any, kept: Sequence[Any], made: tuple[Any, tuple]):
        self.jaxpr, self.kept, self.made = jaxpr, kept, made
        self.axes = tuple(x.aval.ndim for x, k in zip(jaxpr.invars, kept) if k is None)
        values = tuple(None if x is None else _content(x) for x in kept)
        self.key = made, values, _compared(jaxpr)
        self._hash = hash(self.key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Program) and self.key == other.key)

    def __call__(self, constants: Sequence[Any], arguments: Sequence[Any]) -> Any:
        """Its results."""
        given = iter(constants)
        every = [next(given) if x is None else x for x in self.kept]
        found = iter(jex.jaxpr_as_fun(jex.ClosedJaxpr(self.jaxpr, ()))(*every, *arguments))
        structure, fixed = self.made
        return jax.tree.unflatten(structure, [next(found) if x is None else x.value for x in fixed])


def becomes_array(x: Any) -> bool:
    """Whether a result is an array, or a number that becomes one."""
    return isinstance(x, jax.Array | np.ndarray | np.generic | float)


def signature(method: str, arguments: Any) -> tuple[Signature, list[Any]]:
    """How something is called with these arguments (or their shapes), and the arrays among them.

    Raises:
        TypeError: for arguments that are neither arrays nor can be compared.
    """
    leaves, structure = jax.tree.flatten(arguments)
    shown = jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct
    kinds = tuple(
        Kind(tuple(x.shape), np.dtype(x.dtype) if is_numeric(x) else x.dtype)
        if isinstance(x, shown)
        else Fixed(type(x), x)
        for x in leaves
    )
    hash(kinds)
    return Signature(method, structure, kinds), [x for x in leaves if isinstance(x, shown)]


def traced(function: Callable[[Any], Any], of: Signature) -> tuple[Program, list[Any]]:
    """Program of a function that is called as a signature says, and its constants."""
    made: list[Any] = []

    def flat(*arrays: Any) -> list[Any]:
        given = iter(arrays)
        leaves = [next(given) if isinstance(kind, Kind) else kind.value for kind in of.kinds]
        results, structure = jax.tree.flatten(function(jax.tree.unflatten(of.structure, leaves)))
        fixed = tuple(None if becomes_array(x) else Fixed(type(x), x) for x in results)
        made.append((structure, fixed))
        return [jnp.asarray(x) for x in results if becomes_array(x)]

    shapes = [jax.ShapeDtypeStruct(*kind) for kind in of.kinds if isinstance(kind, Kind)]
    closed = jax.make_jaxpr(flat)(*shapes)
    jaxpr, values = _lifted(closed.jaxpr, closed.consts)
    kept = [x if _is_kept(x) else None for x in values]
    return Program(jaxpr, kept, made[0]), [x for x, k in zip(values, kept) if k is None]


def _lifted(program: Any, consts: Sequence[Any]) -> tuple[Any, list[Any]]:
    """The program of its constants and its arguments, and the constants, with the numbers written in it."""
    variables, values = list(program.constvars), list(consts)

    def lift(x: Any) -> Any:
        aval: Any = getattr(x, "aval", None)
        if not isinstance(x, jex.Literal) or aval.dtype != jnp.float64:
            return x
        variables.append(jex.Var(aval))
        values.append(np.asarray(x.val, aval.dtype))
        return variables[-1]

    def lifted(equation: Any) -> Any:
        # Zeros that are made into an array are places for something else.
        place = equation.primitive.name == "broadcast_in_dim"
        noughts = [place and isinstance(x, jex.Literal) and not np.any(x.val) for x in equation.invars]
        given = [x if nought else lift(x) for x, nought in zip(equation.invars, noughts)]
        return equation.replace(invars=given)

    equations = [lifted(equation) for equation in program.eqns]
    results = [lift(x) for x in program.outvars]
    given = [*variables, *program.invars]
    return program.replace(constvars=[], invars=given, eqns=equations, outvars=results), values


def _is_kept(value: Any) -> bool:
    """Whether a constant is part of the program: short lists of integers, as indices are."""
    if not is_concrete(value) or not is_numeric(value) or value.size > FEW:
        return False
    return not jnp.issubdtype(value.dtype, np.inexact)


def _content(value: Any) -> Hashable:
    array = np.asarray(value)
    return array.shape, array.dtype.str, array.tobytes()


def _compared(program: Any) -> Hashable:
    """What two programs have in common that compute the same."""
    numbers: dict[Any, int] = {}

    def named(variables: Sequence[Any]) -> tuple:
        return tuple((numbers.setdefault(x, len(numbers)), _type(x)) for x in variables)

    def read(x: Any) -> Hashable:
        return (_content(x.val), _type(x)) if isinstance(x, jex.Literal) else numbers[x]

    given = named([*program.constvars, *program.invars])
    steps = tuple(
        (
            e.primitive.name,
            tuple(map(read, e.invars)),
            tuple((name, _parameter(x, e)) for name, x in sorted(e.params.items())),
            named(e.outvars),
        )
        for e in program.eqns
    )
    return given, steps, tuple(map(read, program.outvars))


def _type(x: Any) -> Hashable:
    return x.aval.shape, str(x.aval.dtype)


def _parameter(x: Any, equation: Any) -> Hashable:
    if isinstance(x, jex.ClosedJaxpr):
        return _compared(x.jaxpr), tuple(_constant(value) for value in x.consts)
    if isinstance(x, jex.Jaxpr):
        return _compared(x)
    if isinstance(x, tuple | list):
        return tuple(_parameter(y, equation) for y in x)
    if isinstance(x, dict):
        return tuple((key, _parameter(y, equation)) for key, y in sorted(x.items()))
    if isinstance(x, np.ndarray | np.generic):
        return _content(x)
    if getattr(x, "call_wrapped", None) is not None:
        return _rule(x, equation)
    if callable(x) and not isinstance(x, type):
        return _written(x)
    return type(x), x


def _constant(value: Any) -> Hashable:
    return _content(value) if is_concrete(value) and is_numeric(value) else id(value)


def _rule(rule: Any, equation: Any) -> Hashable:
    """A rule for derivatives: of a library by its place, of others by what it computes.

    Raises:
        ValueError: for one that cannot be looked into.
    """
    place = rule.debug_info.func_src_info
    if any(folder in place for folder in _folders()):
        return place
    if equation.primitive.name == "custom_jvp_call":
        program, consts, zeros = rule.call_wrapped(*[False] * len(equation.invars))
        return _compared(program), tuple(map(_constant, consts)), tuple(zeros)
    raise ValueError(
        f"the rule for derivatives {place} cannot be looked into, and a number changed in it would not be "
        "seen: use jax.custom_jvp instead of jax.custom_vjp"
    )


@cache
def _folders() -> tuple[str, ...]:
    found = (importlib.util.find_spec(name) for name in LIBRARIES)
    return tuple(folder + os.sep for x in found if x for folder in x.submodule_search_locations or ())


def _written(function: Any, depth: int = 3) -> Hashable:
    """A function that is not traced but called (by `jax.debug.print`): its code and what it closes over."""
    function = getattr(function, "__func__", function)
    code = getattr(function, "__code__", None)
    if code is None or depth == 0:
        try:
            hash(function)
        except TypeError:
            return id(function)
        return function
    cells = (cell.cell_contents for cell in function.__closure__ or ())
    return code, tuple(_written(x, depth - 1) for x in cells)
