"""Rotation matrices, quaternions, axis-angle, the polar factor and the series of the arc tangent.

A rotation matrix R maps body components to world components: its columns are the directors d_1, d_2, d_3.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.components import Triple
from natcoord_jax.maths.vectors import dot, quotient, safe_divide, skew, unit


def from_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z), scalar first; it is normalised first."""
    w, x, y, z = unit(quaternion)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_quaternion(rotation: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    """Quaternion (w, x, y, z) of a rotation matrix, with w >= 0; differentiable away from half turns.

    The four candidates of Shepperd's method are formed and the one with the largest pivot is taken.
    """
    r = rotation
    r00, r11, r22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    s01, s02, s12 = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    a0, a1, a2 = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    pivots = [1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22]
    rows = [
        [pivots[0], a0, a1, a2],
        [a0, pivots[1], s01, s02],
        [a1, s01, pivots[2], s12],
        [a2, s02, s12, pivots[3]],
    ]
    candidates = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    best = jnp.argmax(jnp.stack(pivots, axis=-1), axis=-1)
    chosen = jnp.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    chosen = unit(chosen)
    return jnp.where(chosen[..., :1] < 0, -chosen, chosen)


def to_rotation_vector(rotation: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Rotation vector [rad] of a rotation matrix, no longer than pi; at half a turn one of the two there are.

    Smooth but at half turns, where it goes from one of them to the other; its slope is nowhere zero.
    """
    quaternion = to_quaternion(rotation)
    # Tangent of a quarter of the angle times the axis.
    k = quaternion[..., 1:] / (1.0 + quaternion[..., :1])
    return 4.0 * arctan_coefficients(jnp.sum(k * k, axis=-1, keepdims=True))[0] * k


def from_axis_angle(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation matrix of a turn by `angle` [rad] about `axis` (any length but zero)."""
    k = skew(unit(axis))
    return jnp.eye(3) + jnp.sin(angle) * k + (1 - jnp.cos(angle)) * (k @ k)


def from_rotation_vector(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a rotation vector [rad], smooth at zero."""
    # Functions of the square: the angle itself has no derivatives at zero.
    square = dot(vector, vector)[..., None, None]
    small = square < 1e-3
    x, guarded = jnp.where(small, square, 0.0), jnp.sqrt(jnp.where(small, 1.0, square))
    series = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    first = jnp.where(small, series, jnp.sin(guarded) / guarded)
    series = 0.5 - x / 24 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90 * (1 - x / 132))))
    second = jnp.where(small, series, 2 * (jnp.sin(0.5 * guarded) / guarded) ** 2)
    k = skew(vector)
    return jnp.eye(3) + first * k + second * (k @ k)


def frame_from_axis(axis, second=None) -> Float[Array, "3 3"]:
    """Right-handed orthonormal triad, one vector a row, whose third vector points along `axis`.

    The first points along `second` as far as it is perpendicular to `axis`; without `second`, along the
    world axis that is least aligned with `axis` (chosen on concrete numbers when there are any).
    """
    axis = jnp.asarray(axis, float)
    third = unit(axis)
    if second is None:
        helper = jnp.asarray(np.eye(3))[jnp.argmin(jnp.abs(third))]
    else:
        helper = jnp.asarray(second, float)
    first = unit(helper - dot(helper, third) * third)
    return jnp.stack([first, jnp.cross(third, first), third])


def orthonormalise(directors: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Nearest orthonormal triad (polar factor) of a triad close to one, by Newton-Schulz iteration."""
    for _ in range(6):
        gram = jnp.einsum("...ik,...jk->...ij", directors, directors)
        directors = 1.5 * directors - 0.5 * jnp.einsum("...ij,...jk->...ik", gram, directors)
    return directors


def arctan_quotient(t: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """atan(t) / t, smooth at zero, where it is 1."""
    small = jnp.abs(t) < 1e-2
    square = jnp.where(small, t, 0.0) ** 2
    series = 1 - square * (1 / 3 - square * (1 / 5 - square * (1 / 7 - square * (1 / 9 - square / 11))))
    return jnp.where(small, series, safe_divide(jnp.arctan(t), jnp.where(small, 1.0, t)))


def angular_velocity(
    directors: Float[Array, "*batch 3 3"], rates: Float[Array, "*batch 3 3"]
) -> Float[Array, "*batch 3"]:
    """World angular velocity [rad/s] of orthonormal directors (rows) with rates: 1/2 sum d_i x v_i (39)."""
    return 0.5 * jnp.sum(jnp.cross(directors, rates), axis=-2)


HALVINGS = 3
"""Of the angle, before the series: what is left is below 11.25 degrees a quarter turn."""

TERMS = 12
"""Of the series of `arctan_coefficients`: the next is below 1e-17 then."""


def arctan_coefficients(x: Float[Array, "*shape"]) -> tuple[Array, Array, Array]:
    """f_0 = atan(t) / t, f_1 = (1 - f_0) / x and f_2 = (1/3 - f_1) / x of x = t^2.

    That is f_n = sum over k of (-x)^k / (2 k + 2 n + 1), continued to all x > -1; smooth at zero, where they
    are 1, 1/3 and 1/5, without branches and without loss of digits. With c = 2 / (1 + sqrt(1 + x)), halving
    the angle takes x to c^2 x / 4, and all functions to positive sums of those at half the angle:

        f_0 = c f_0',  f_1 = c^2 (1 + c f_1') / 4,  f_2 = c^2 (2 + c)^2 / 48 + c^5 f_2' / 16.

    Their derivatives by x are ((2 n + 1) f_(n+1) - 1 / (1 + x)) / 2.
    """
    factors = []
    for _ in range(HALVINGS):
        c = 2.0 / (1.0 + jnp.sqrt(1.0 + x))
        factors.append(c)
        x = 0.25 * c * c * x
    last = jnp.zeros_like(x)
    for k in range(TERMS, -1, -1):
        last = 1.0 / (2 * k + 5) - x * last
    middle = 1.0 / 3.0 - x * last
    first = 1.0 - x * middle
    for c in reversed(factors):
        square = 0.25 * c * c
        last = square * ((2.0 + c) ** 2 / 12.0 + c * square * last)
        middle = square * (1.0 + c * middle)
        first = c * first
    return first, middle, last


def logarithm_of_motion(axial: Triple, trace: Any, place: Triple) -> tuple[Triple, Triple]:
    """Logarithm of rigid motions: rotation vectors psi [rad] and T(psi)^-1 place [m].

    Smooth for rotations of less than half a turn, at zero too. Defined for matrices near rotations as well:
    through k = 2 tan(angle/2) n = 2 axial / (1 + trace), without square roots near zero. Half a turn has no
    logarithm: not a number. Beyond, it is that of the rest of a turn, the other way round.

    Args:
        axial: (R_32 - R_23, R_13 - R_31, R_21 - R_12) of the rotation R.
        trace: of R.
        place: in the frame that R turns from.
    """
    k = axial * quotient(2.0 * jnp.ones_like(trace), 1.0 + trace)
    a, b, _ = arctan_coefficients(0.25 * k.dot(k))
    across = k.cross(place)
    return k * a, place - across * (0.5 * a) + k.cross(across) * (0.25 * b)
