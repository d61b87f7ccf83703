"""Projection onto the range of a matrix of known rank, and the smallest rotation between two subspaces."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import definite_inverse, definite_solution
from natcoord_jax.maths.vectors import safe_divide, safe_norm

LEAST = 1e-14
"""Square of a singular value in terms of the others below which it counts as none."""


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def range_projector(
    matrix: Float[Array, "m n"], rank: int, least: Float[Array, ""] | None = None
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
        vector = rest[:, jnp.argmax(sizes)]
        if least is not None:
            vector = jnp.where(jnp.max(sizes) > least**2, vector, 0.0)
        # Twice is enough: what is left is orthogonal to round-off.
        vector = safe_divide(vector, safe_norm(vector))
        vector = vector - projector @ vector
        vector = safe_divide(vector, safe_norm(vector))
        rest = rest - vector[:, None] * (vector @ rest)[None, :]
        return rest, projector + vector[:, None] * vector[None, :]

    nothing = jnp.zeros((matrix.shape[0], matrix.shape[0]), matrix.dtype)
    projector = jax.lax.fori_loop(0, rank, with_column, (matrix, nothing))[1]
    if least is None or rank < matrix.shape[0]:
        return projector
    # Of rows that are all independent nothing is mixed, not even by rounding.
    unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return jnp.where(jnp.trace(projector) > rank - 0.5, unit, projector)


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


POLISHING = 9
"""Newton-Schulz iterations for the direct rotation of subspaces: enough for cosines from 0.4 on."""

POLISHED = 1e-9
"""Error of X^T X from which one iteration more is the last: it squares it."""


def direct_rotation(start: Float[Array, "u u"], end: Float[Array, "u u"]) -> Float[Array, "u u"]:
    """The smallest rotation that takes one subspace to another (C. Davis and W. M. Kahan 1970).

    Args:
        start: orthogonal projector on the one.
        end: the same on the other.

    Returns:
        Rotation, orthogonal to round-off as long as all angles between the subspaces are below 66 degrees,
        whose cosine is 0.4. Beyond, the iterations end too soon.
    """
    unit = jnp.eye(start.shape[0], dtype=start.dtype)
    return nearest_orthogonal(end @ start + (unit - end) @ (unit - start))


def _polished(x: Float[Array, "u u"]) -> tuple[Float[Array, "u u"], Float[Array, ""]]:
    """One Newton-Schulz iteration, and how far from orthogonal the matrix was before it."""
    square = x.T @ x
    return 1.5 * x - 0.5 * x @ square, jnp.max(jnp.abs(square - jnp.eye(x.shape[0], dtype=x.dtype)))


@jax.custom_jvp
def nearest_orthogonal(x: Float[Array, "u u"]) -> Float[Array, "u u"]:
    """The nearest orthogonal matrix. Over short steps subspaces turn little, and few iterations do."""
    return jax.lax.while_loop(
        lambda carry: (carry[0] < POLISHING) & (carry[2] > POLISHED),
        lambda carry: (carry[0] + 1, *_polished(carry[1])),
        (0, x, jnp.ones((), x.dtype)),
    )[1]


@nearest_orthogonal.defjvp
def _nearest_orthogonal_jvp(primals: tuple, tangents: tuple) -> tuple:
    # Derivatives have to go through all iterations, in a loop that can be transposed.
    def every(x: Array) -> Array:
        return jax.lax.fori_loop(0, POLISHING, lambda _, x: _polished(x)[0], x)

    return nearest_orthogonal(*primals), jax.jvp(every, primals, tangents)[1]


def isometric(
    cosines: Float[Array, "u u"], b0: Float[Array, " u"], b1: Float[Array, " u"]
) -> tuple[Float[Array, " u"], Float[Array, " u"]]:
    """U and b_1 - 2 u - K^T u of the isometric kick, see `natcoord_jax.mechanics.kick`."""
    matrix = jnp.eye(b0.shape[0], dtype=b0.dtype) + 2.0 * cosines + cosines @ cosines.T
    u = definite_solution(matrix, cosines @ b1 - b0)
    return u, b1 - 2.0 * u - cosines.T @ u
