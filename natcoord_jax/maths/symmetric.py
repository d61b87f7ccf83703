"""Symmetric tensors of three dimensions by components 11, 22, 33, 12, 23, 13, many of them at once.

The components are the first axis; others that follow are of instances.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Axes of the components."""
COUNT = (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)
"""How often each is in the tensor."""
UNIT = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


def unit_like(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """The unit tensor, as often as another."""
    return jnp.broadcast_to(jnp.reshape(jnp.array(UNIT, a.dtype), (6, *(1,) * (a.ndim - 1))), a.shape)


def trace(a: Float[Array, "6 *n"]) -> Float[Array, "*n"]:
    """Trace."""
    return a[0] + a[1] + a[2]


def contracted(a: Float[Array, "6 *n"], b: Float[Array, "6 *n"]) -> Float[Array, "*n"]:
    """The product A : B = tr(A B)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2 * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])


def tensor_cross(a: Float[Array, "6 *n"], b: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """The tensor cross product A x B, bilinear and symmetric, of which A x A / 2 is the cofactor of A.

    J. Bonet, A. J. Gil, R. Ortigosa, Comput. Methods Appl. Mech. Eng. 283 (2015) 1061-1094, section 2.
    """
    return jnp.stack(
        [
            a[1] * b[2] + a[2] * b[1] - 2 * a[4] * b[4],
            a[0] * b[2] + a[2] * b[0] - 2 * a[5] * b[5],
            a[0] * b[1] + a[1] * b[0] - 2 * a[3] * b[3],
            a[5] * b[4] + a[4] * b[5] - a[3] * b[2] - a[2] * b[3],
            a[3] * b[5] + a[5] * b[3] - a[0] * b[4] - a[4] * b[0],
            a[3] * b[4] + a[4] * b[3] - a[1] * b[5] - a[5] * b[1],
        ]
    )


def cofactor(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """Cofactor: the inverse times the determinant."""
    return 0.5 * tensor_cross(a, a)


def full(a: Float[Array, "6 *n"]) -> Float[Array, "3 3 *n"]:
    """As a matrix."""
    return jnp.stack(
        [jnp.stack([a[0], a[3], a[5]]), jnp.stack([a[3], a[1], a[4]]), jnp.stack([a[5], a[4], a[2]])]
    )
