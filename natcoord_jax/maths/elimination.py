"""Inverses and factors of small dense matrices by elimination, in loops that compile into one kernel."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LOOPED = 48
"""Largest size for elimination written as a loop of rank-one updates, which compiles into one kernel and runs
in lanes when batched; a call of LAPACK does neither, but wins for large matrices."""


def definite_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a matrix whose symmetric part is positive definite, or of a quasi-definite one."""
    size = matrix.shape[-1]
    if size > LOOPED:
        return jnp.linalg.inv(matrix)
    number = jnp.arange(size)

    def eliminate(k: Array, matrix: Array) -> Array:
        row, column = matrix[k], matrix[:, k]
        pivot = 1.0 / row[k]
        on = number == k
        scaled = jnp.where(on, pivot, row * pivot)
        kept = jnp.where(on[None, :], 0.0, matrix)
        return jnp.where(on[:, None], scaled[None, :], kept - column[:, None] * scaled[None, :])

    return jax.lax.fori_loop(0, size, eliminate, matrix)


def inverse_cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower triangular X with X A X^T = 1, for a symmetric positive definite A."""
    size = matrix.shape[-1]
    unit = jnp.eye(size, dtype=matrix.dtype)
    if size > LOOPED:
        return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(matrix), unit, lower=True)
    number = jnp.arange(size)

    def eliminate(k: Array, both: Array) -> Array:
        row = both[k] / jnp.sqrt(both[k, k])
        column = jnp.where(number > k, row[:size], 0.0)
        return jnp.where((number == k)[:, None], row[None, :], both - column[:, None] * row[None, :])

    return jax.lax.fori_loop(0, size, eliminate, jnp.concatenate([matrix, unit], axis=1))[:, size:]


def pivoted_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of any regular matrix, by elimination with row pivoting."""
    size = matrix.shape[-1]
    if size > LOOPED:
        return jnp.linalg.inv(matrix)
    number = jnp.arange(size)

    def eliminate(k: Array, both: Array) -> Array:
        column = jnp.where(number < k, 0.0, jnp.abs(both[:, k]))
        best = jnp.argmax(column)
        mine, other = both[k], both[best]
        row = other / other[k]
        both = jnp.where((number == best)[:, None], mine[None, :], both)
        column = jnp.where(number == k, 0.0, both[:, k])
        return jnp.where((number == k)[:, None], row[None, :], both - column[:, None] * row[None, :])

    unit = jnp.eye(size, dtype=matrix.dtype)
    return jax.lax.fori_loop(0, size, eliminate, jnp.concatenate([matrix, unit], axis=1))[:, size:]
