"""Intermediate results that are computed once.

The CPU compiler merges chains of elementwise operations into the loops of all their results: what many of
them share is then computed again for each, and the program grows accordingly.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

try:
    from jax.experimental.scheduling_groups import xla_metadata_call as _attributed
except ImportError:  # an experimental module of JAX: without it everything runs, only slower
    _attributed = None

T = TypeVar("T")


def settled(x: T) -> T:
    """The same arrays, which the compiler finishes before it goes on.

    They are the results of a call that is not inlined; differentiable in every mode.
    """
    if _attributed is None or jax.default_backend() != "cpu":
        return x
    leaves, structure = jax.tree.flatten(x)
    call: Callable = _attributed(lambda *leaves: leaves, inlineable="false")  # pyright: ignore[reportAssignmentType]
    return jax.tree.unflatten(structure, call(*leaves))
