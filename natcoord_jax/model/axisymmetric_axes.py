"""Axes along which the rates of balls are taken, and bodies for which these need not spin with them.

The rates of a body that turns freely are components along its own axes at the start of the step: there its
inertia is always the same. A body that is round about an axis has the same inertia along all axes that follow
this one, however fast it spins about it; H. Resal used such axes for gyroscopes. Along them nothing changes
but by nutation and precession. So rates of the last steps extrapolate, and factors of the Jacobian go on
serving, where along axes of the body both would turn with the spin.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.eager_numpy import eager_numpy

POLE = np.array([0.48, 0.6, 0.64])
"""The axes are those at the pole, turned to the axis of symmetry the shortest way: which is undetermined, and
changes fast around it, only where an axis points to the opposite. Nothing in a usual scene does."""

AT_POLE = np.stack([np.array([0.6, -0.48, 0.0]), np.cross(POLE, [0.6, -0.48, 0.0])]) / np.hypot(0.6, 0.48)
"""The other two axes there."""

NEAREST = 1e-4
"""One more than the cosine between axis and pole down to which the axes are well determined."""

ROUND = 1e-3
"""Differences of second moments in terms of their sum that count as none."""


def frame_axes(coefficients: Float[Array, "n k 3"], directors: Float[Array, "s n 3 3"]) -> Array:
    """Axes of frames from the directors of the bodies that they are fixed to."""
    return jnp.sum(coefficients[..., None] * directors[:, :, None], axis=-2)


def ball_axes(
    frames: Float[Array, "n 2 4 4"], symmetry: Float[Array, "n 4"] | None, directors: Float[Array, "s n 3 3"]
) -> Float[Array, "s n 3 3"]:
    """Axes of the rates of bodies that turn freely.

    Args:
        frames: weights of the frames of the joints.
        symmetry: see `symmetries`; None: no body is round.
        directors: of the bodies.
    """
    own = frame_axes(frames[:, 1, 1:, 1:], directors)
    if symmetry is None:
        return own
    axis = symmetry[:, :1] * POLE + jnp.sum(symmetry[:, 1:, None] * directors, axis=-2)
    above = 1.0 + jnp.sum(axis * POLE, axis=-1)
    found = jnp.any(symmetry != 0, axis=1) & (above > NEAREST)
    along = jnp.sum(axis[..., None, :] * AT_POLE, axis=-1) / jnp.where(found, above, 1.0)[..., None]
    others = AT_POLE - along[..., None] * (axis + POLE)[..., None, :]
    following = jnp.concatenate([others, axis[..., None, :]], axis=-2)
    return jnp.where(found[..., None, None], following, own)


@eager_numpy
def symmetries(
    mass: Float[Array, "bodies 4 4"],
    frames: Float[Array, "bodies 2 4 4"],
    rows: Float[Array, "bodies 4 3"],
    single: Bool[Array, " bodies"],
) -> Float[Array, "bodies 4"]:
    """Axes about which bodies are round, as weights of the pole and of their directors.

    Those of a sphere are of the pole: all axes are alike, and stay where they are. Bodies that are not round
    about an axis through their joint have zeros.

    Args:
        mass: of the bodies.
        frames: of their joints.
        rows: of the bodies at first. Axes point to the side of the pole there.
        single: which bodies turn freely and carry nothing.
    """
    point = frames[:, 1, 0, 1:]
    moment = point[:, :, None] * mass[:, 0, None, 1:]
    about = mass[:, 1:, 1:] - moment - jnp.swapaxes(moment, 1, 2)
    about = about + mass[:, 0, 0, None, None] * point[:, :, None] * point[:, None, :]
    x, y, z = (about[:, k, k] for k in range(3))
    whole = x + y + z
    unit = jnp.eye(3)
    rest = about - whole[:, None, None] / 3.0 * unit
    square = jnp.sum(rest * rest, axis=(1, 2))
    times = jnp.sum(rest[:, :, :, None] * rest[:, None, :, :], axis=2)
    cube = jnp.sum(times * rest, axis=(1, 2))
    sphere = square <= (ROUND * whole) ** 2
    # Round about an axis a, the rest is s (a a^T - 1/3), with tr rest^2 = 2/3 s^2 and tr rest^3 = 2/9 s^3.
    excess = 3.0 * cube / jnp.where(sphere, 1.0, square)
    excess = jnp.where(excess == 0, 1.0, excess)
    outer = rest / excess[:, None, None] + unit / 3.0
    largest = jnp.argmax(jnp.stack([outer[:, k, k] for k in range(3)], axis=1), axis=1)
    axis = jnp.sum(jnp.where((jnp.arange(3) == largest[:, None])[:, :, None], outer, 0.0), axis=1)
    length = jnp.sqrt(jnp.sum(axis * axis, axis=1, keepdims=True))
    axis = axis / jnp.where(length > 0, length, 1.0)
    wrong = rest - excess[:, None, None] * (axis[:, :, None] * axis[:, None, :] - unit / 3.0)
    uniaxial = jnp.sum(wrong * wrong, axis=(1, 2)) <= (ROUND * whole) ** 2
    side = jnp.sum(jnp.sum(axis[:, :, None] * rows[:, 1:], axis=1) * POLE, axis=1, keepdims=True)
    axis = jnp.where(side < 0, -axis, axis)
    found = jnp.concatenate([jnp.zeros_like(side), axis], axis=1)
    found = jnp.where(sphere[:, None], jnp.array([1.0, 0.0, 0.0, 0.0]), found)
    return jnp.where((single & (whole > 0) & (sphere | uniaxial))[:, None], found, 0.0)
