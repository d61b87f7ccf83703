"""Inverses of small and medium matrices, of many at once."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.xla.rows import part, with_part

UNBLOCKED = 16
SMALL = 8
LARGE = 32
MANY = 24  # matrices that fill the vector registers when they are stored side by side


def inverses(matrices: Float[Array, "count n n"]) -> Float[Array, "count n n"]:
    """Inverses by Gauss-Jordan elimination in place; large matrices by blocks, with n a multiple of 8.

    Loops instead of unrolled code: it takes a tenth of the time to compile, and runs as fast.
    """
    count, n = matrices.shape[:2]
    if n > 3 * LARGE and n % LARGE == 0:
        return _blocked(matrices, LARGE)
    if n > UNBLOCKED:
        return _blocked(matrices, SMALL)
    if count < MANY:
        return jax.vmap(definite_inverse)(matrices)
    return jnp.moveaxis(_side_by_side(jnp.moveaxis(matrices, 0, -1)), -1, 0)


def _side_by_side(matrices: Array) -> Array:
    """The same with the matrices along the last axis."""
    n = matrices.shape[0]
    number = jnp.arange(n)

    def step(k: Array, left: Array) -> Array:
        row, column, on = left[k], left[:, k], (number == k)[:, None]
        pivot = 1.0 / row[k]
        scaled = jnp.where(on, pivot, row * pivot)
        kept = jnp.where(on, 0.0, left)
        return jnp.where(on[:, None], scaled[None], kept - column[:, None] * scaled[None])

    return jax.lax.fori_loop(0, n, step, matrices)


def _blocked(matrices: Array, size: int) -> Array:
    """The same by blocks: rows and columns of a block at once, as products."""

    def step(k: Array, left: Array) -> Array:
        first = k * size
        rows = part(left, first, size, 1)
        pivot = inverses(part(rows, first, size, 2))
        columns = part(left, first, size, 2)
        scaled = with_part(pivot @ rows, first, pivot, 2)
        left = with_part(left, first, jnp.zeros_like(columns), 2)
        return with_part(left - columns @ scaled, first, scaled, 1)

    return jax.lax.fori_loop(0, matrices.shape[-1] // size, step, matrices)
