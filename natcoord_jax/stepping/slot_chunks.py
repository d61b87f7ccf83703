"""Functions of all slots, a few at a time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

CHUNK = 32
"""Slots whose Jacobians are formed together."""


def in_chunks(function: Callable, slots: tuple, length: int, summed: bool = False) -> Any:
    """The function of every slot, vmapped in chunks whose temporaries stay in the cache.

    If summed, its first output is added up, so that not all of them are there at once.
    """
    every = jax.vmap(lambda x: function(*x))
    if length <= CHUNK:
        found = every(slots)
        return (_total(found[0]), *found[1:]) if summed else found
    chunks = -(-length // CHUNK)
    padding = jnp.minimum(jnp.arange(chunks * CHUNK), length - 1)

    def chunked(x: Array) -> Array:
        return x[padding].reshape(chunks, CHUNK, *x.shape[1:])

    def adding(x: tuple) -> tuple:
        chunk, slots = x
        first, *others = every(slots)
        real = chunk * CHUNK + jnp.arange(CHUNK) < length
        first = jax.tree.map(lambda x: jnp.where(real.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0), first)
        return _total(first), *others

    if summed:
        first, *found = jax.lax.map(adding, (jnp.arange(chunks), jax.tree.map(chunked, slots)))
    else:
        first, found = (), jax.lax.map(every, jax.tree.map(chunked, slots))
    found = jax.tree.map(lambda x: x.reshape(chunks * CHUNK, *x.shape[2:])[:length], found)
    return (_total(first), *found) if summed else found


def _total(parts: Any) -> Any:
    """The sum along the first axis."""
    return jax.tree.map(lambda x: jnp.sum(x, axis=0), parts)
