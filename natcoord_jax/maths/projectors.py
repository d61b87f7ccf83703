"""Projection onto the range of a matrix of known rank, differentiable as long as the rank holds."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def range_projector(matrix: Float[Array, "m n"], rank: int) -> Float[Array, "m m"]:
    """Orthogonal projector U U^T on the `rank` leading left singular vectors.

    Its derivative is that of the projector on the range of a matrix of constant rank,
    N + N^T with N = (1 - P) dA A^+ (Golub & Pereyra 1973); single singular vectors, which need not be
    differentiable, do not enter.

    Args:
        matrix: A.
        rank: its rank.
    """
    vectors = jnp.linalg.svd(matrix, full_matrices=False)[0][:, :rank]
    return vectors @ vectors.T


@range_projector.defjvp
def _range_projector_jvp(rank: int, primals: tuple, tangents: tuple):
    (matrix,), (change,) = primals, tangents
    projector = range_projector(matrix, rank)
    inverse = jnp.linalg.pinv(matrix, rtol=1e-7)
    half = (jnp.eye(matrix.shape[0], dtype=matrix.dtype) - projector) @ change @ inverse
    return projector, half + half.T
