"""The smallest rotation from one subspace to another, without a choice of bases."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import definite_solution

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

    def going(carry: tuple) -> Array:
        return (carry[0] < POLISHING) & (carry[2] > POLISHED)

    def once(carry: tuple) -> tuple:
        return carry[0] + 1, *_polished(carry[1])

    return jax.lax.while_loop(going, once, (0, x, jnp.ones((), x.dtype)))[1]


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
