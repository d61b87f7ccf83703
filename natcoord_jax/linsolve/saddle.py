"""Sparse saddle-point matrices: inertias of the unknowns, and a small diagonal in the rows of constraints."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.linsolve.blocks import BlockMatrix

SHIFT = 1e-10  # diagonal of the constraint rows in units of the matrix, one for all of them


def inertias_of(matrix: BlockMatrix, balances: int) -> Float[Array, " n"]:
    """Inertias of the unknowns, 0 for multipliers."""
    return jnp.abs(matrix.diagonal()).at[balances:].set(0.0)


def regularised(matrix: BlockMatrix, inertias: Float[Array, " n"]) -> BlockMatrix:
    """The matrix with a small diagonal in the rows of the constraints, so that dependent ones do no harm.

    Args:
        matrix: with balances first.
        inertias: of the unknowns, 0 for multipliers.
    """
    pattern = matrix.pattern
    extended = jnp.append(inertias, 0.0)
    balance, row = extended[pattern.columns] > 0, extended[pattern.rows] > 0
    inverse = jnp.where(balance, 1.0 / jnp.where(balance, extended[pattern.columns], 1.0), 0.0)
    size = jnp.where(row[:, :, None], 0.0, matrix.tiles**2 * inverse[:, None, :])
    shift = SHIFT * jnp.maximum(jnp.max(size), jnp.finfo(inertias.dtype).tiny)
    return matrix.with_diagonal(jnp.where(inertias > 0, 0.0, shift))
