"""Small calculations in NumPy: what is done once costs no compilation.

An operation of JAX that is called from Python is a program of its own, which takes tens of milliseconds to
compile for every new shape, and setting up a scene needs hundreds of them. What `eager_numpy` wraps is traced
instead, and its operations are evaluated by NumPy one after the other, those of all lanes of `jax.vmap` at
once. Where a derivative is taken it is compiled as a whole. Inside of a program it is the function itself, so
that there is one formulation only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import as_array, at_top_level
from natcoord_jax.core.closures import with_callables
from natcoord_jax.xla.evaluation import ClosedJaxpr, evaluate, numbers_made
from natcoord_jax.xla.tracing import at_once, in_lanes, in_program, is_concrete, is_numeric, jaxpr_as_fun

REMEMBERED = 256
"""Programs of one function that are kept."""

LARGE = 1_000_000
"""Numbers from which on the time of NumPy is more than that of the compiler: one million, some 0.3 s."""

MUCH = 100_000_000
"""Numbers that are made from which on the same holds, in loops over many states, say."""

F = TypeVar("F", bound=Callable[..., Any])


def eager_numpy(function: F) -> F:
    """The function, evaluated by NumPy outside of programs, and compiled where arrays are large.

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
    run = _evaluated(function)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return with_callables(function, run, arguments)

    return call  # pyright: ignore[reportReturnType]


def _evaluated(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, of arguments without callables."""
    known: dict[Any, Traced] = {}
    compiled = eqx.filter_jit(function)

    def run(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        given, rest = [x for x in leaves if _is_array(x)], [x for x in leaves if not _is_array(x)]
        if in_program(leaves) or not all(map(is_numeric, given)):
            return function(*arguments)
        # What is no array and no plain value may have changed since: a function by what it reads.
        lasting, concrete = all(isinstance(x, PLAIN) for x in rest), is_concrete(given)
        if not concrete and not in_lanes(given):
            return compiled(*arguments) if lasting else function(*arguments)
        if lasting and concrete and sum(x.size for x in given) > LARGE:
            return compiled(*arguments)
        # The representation tells 0.0 from -0.0, and 1 from True.
        key = structure, *((x.shape, x.dtype) if _is_array(x) else repr(x) for x in leaves)
        traced = known.get(key) if lasting else None
        if traced is None:
            traced = _traced(function, leaves, structure)
            if not is_concrete(traced.program.consts):  # (What it closes over is being traced.)
                return function(*arguments)
            if len(known) >= REMEMBERED:
                known.clear()
            if lasting:
                known[key] = traced
        if not concrete:
            return jax.tree.unflatten(traced.structure, at_once(traced.in_lanes, given))
        if lasting and numbers_made(traced.program) > MUCH:
            return compiled(*arguments)
        with np.errstate(all="ignore"):
            found = evaluate(traced.program, [np.asarray(x) for x in given])
        return jax.tree.unflatten(traced.structure, [as_array(x) for x in found])

    return run


@dataclass
class Traced:
    """The program of a function.

    Attributes:
        program: of the arrays among the arguments.
        structure: of what the function gives.
        of_lanes: functions of all lanes, by the axis that these are along in each array.
    """

    program: ClosedJaxpr
    structure: Any
    of_lanes: dict[tuple, Callable[..., Any]] = field(default_factory=dict)

    def in_lanes(self, arrays: Sequence[Any], axes: tuple) -> list[Any]:
        """What it gives in all lanes of `jax.vmap`."""
        if axes not in self.of_lanes:
            self.of_lanes[axes] = _evaluated(jax.vmap(jaxpr_as_fun(self.program), in_axes=axes))
        return self.of_lanes[axes](*arrays)


def stacked(items: Sequence[Any]) -> Any:
    """`jnp.stack`, without a program where nothing is being traced."""
    if at_top_level(*items):
        return as_array(np.stack([np.asarray(x) for x in items]))
    return jnp.stack(items)


broadcast = eager_numpy(jnp.broadcast_to)
"""The same of `jnp.broadcast_to`."""

PLAIN = (bool, int, float, complex, str, bytes, np.generic)
"""Values that cannot change."""


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray))


def _traced(function: Callable[..., Any], leaves: list[Any], structure: Any) -> Traced:
    def of_arrays(*given: Any) -> Any:
        rest = iter(given)
        every = [next(rest) if _is_array(x) else x for x in leaves]
        return function(*jax.tree.unflatten(structure, every))

    arrays = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves if _is_array(x)]
    program, shapes = jax.make_jaxpr(of_arrays, return_shape=True)(*arrays)
    return Traced(program, jax.tree.structure(shapes))
