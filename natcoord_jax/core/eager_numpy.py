"""Small calculations in NumPy: what is done once costs no compilation.

An operation of JAX that is called from Python is a program of its own, which takes tens of milliseconds to
compile for every new shape, and setting up a scene needs hundreds of them. What `eager_numpy` wraps is traced
instead, and its operations are evaluated by NumPy one after the other. Inside of a transformation
it is the function itself, so that there is one formulation only.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import as_array, at_top_level
from natcoord_jax.core.closures import with_callables
from natcoord_jax.xla.evaluation import ClosedJaxpr, evaluate, numbers_made

REMEMBERED = 256
"""Programs of one function that are kept."""

LARGE = 1_000_000
"""Numbers from which on the time of NumPy is more than that of the compiler: one million, some 0.3 s."""

MUCH = 100_000_000
"""Numbers that are made from which on the same holds, in loops over many states, say."""

F = TypeVar("F", bound=Callable[..., Any])


def eager_numpy(function: F) -> F:
    """The function, evaluated by NumPy where nothing is being traced, and compiled where they are large.

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
        if lasting and numbers_made(program) > MUCH:
            return compiled(*arguments)
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
