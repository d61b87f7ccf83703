"""Projection onto the range of a matrix of known rank, differentiable as long as the rank holds."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.vectors import safe_divide, safe_norm

LEAST = 1e-14
"""Square of a singular value in terms of the others below which it counts as none."""


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def range_projector(
    matrix: Float[Array, "m n"], rank: int, least: Float[Array, ""] | float = 0.0
) -> Float[Array, "m m"]:
    """Orthogonal projector on the range, by Gram-Schmidt orthogonalisation of the columns, largest first.

    Unlike singular vectors it compiles into one kernel. Its derivative is that of the projector on the range
    of a matrix of constant rank, N + N^T with N = (1 - P) dA A^+ (Golub & Pereyra 1973); single basis
    vectors, which need not be differentiable, do not enter.

    Args:
        matrix: A.
        rank: its rank, or more than that.
        least: length of a column, less all before it, that is none: it decides where the rank is not known.
    """

    def with_column(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, projector = carry
        sizes = jnp.sum(rest**2, axis=0)
        vector = jnp.where(jnp.max(sizes) > least**2, rest[:, jnp.argmax(sizes)], 0.0)
        # Twice is enough: what is left is orthogonal to round-off.
        vector = safe_divide(vector, safe_norm(vector))
        vector = vector - projector @ vector
        vector = safe_divide(vector, safe_norm(vector))
        rest = rest - vector[:, None] * (vector @ rest)[None, :]
        return rest, projector + vector[:, None] * vector[None, :]

    nothing = jnp.zeros((matrix.shape[0], matrix.shape[0]), matrix.dtype)
    return jax.lax.fori_loop(0, rank, with_column, (matrix, nothing))[1]


@range_projector.defjvp
def _range_projector_jvp(rank: int, primals: tuple, tangents: tuple):
    (matrix, least), (change, _) = primals, tangents
    projector = range_projector(matrix, rank, least)
    half = (jnp.eye(matrix.shape[0], dtype=matrix.dtype) - projector) @ change
    half = half @ pseudo_inverse(matrix, projector, rank)
    return projector, half + half.T


def pseudo_inverse(
    matrix: Float[Array, "m n"], projector: Float[Array, "m m"], rank: int
) -> Float[Array, "n m"]:
    """Pseudo-inverse from the projector on the range: A^T (A A^T + 1 - P)^-1, polished.

    Like the projector it compiles into one kernel, which singular values would not.

    Args:
        matrix: A.
        projector: P.
        rank: of the matrix.
    """
    gram = matrix @ matrix.T
    mean = jnp.trace(gram) / max(rank, 1)
    mean = jnp.where(mean > 0, mean, 1.0)
    unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    inverse = matrix.T @ definite_inverse(gram + mean * ((1.0 + LEAST) * unit - projector))
    for _ in range(2):
        inverse = inverse + inverse @ (projector - matrix @ inverse)
    return inverse
