"""Intermediate results that are computed once.

The CPU compiler merges chains of elementwise operations into the loops of all their results: what many of
them share is then computed again for each, and the program grows accordingly.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

try:
    from jax.experimental.scheduling_groups import xla_metadata_call as _attributed
except ImportError:  # an experimental module of JAX: without it everything runs, only slower
    _attributed = None

T = TypeVar("T")


def materialised(x: T) -> T:
    """The same arrays, which the compiler finishes before it goes on; differentiable in every mode."""
    if _attributed is None or jax.default_backend() != "cpu":
        return x
    leaves, structure = jax.tree.flatten(x)
    return jax.tree.unflatten(structure, _finished(*leaves))


def _call(*leaves: Array) -> tuple[Array, ...]:
    """The results of a call that is not inlined."""
    call: Callable = _attributed(lambda *leaves: leaves, inlineable="false")  # pyright: ignore
    return call(*leaves)


@jax.custom_jvp
def _finished(*leaves: Array) -> tuple[Array, ...]:
    return _call(*leaves)


@partial(_finished.defjvp, symbolic_zeros=True)
def _finished_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Tangents in a call of their own: one that took values as well could not be transposed."""
    zero = [isinstance(t, SymbolicZero) for t in tangents]
    moving = iter(_call(*(t for t, none in zip(tangents, zero) if not none)) if not all(zero) else ())
    return _finished(*primals), tuple(t if none else next(moving) for t, none in zip(tangents, zero))
