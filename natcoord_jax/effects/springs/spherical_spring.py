"""Spring of a spherical joint."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential

SMALL = 0.02
"""Below this 1 - cos of the angle its square is summed as a series."""
SERIES = tuple(2.0 * 2.0**n / (n**2 * math.comb(2 * n, n)) for n in range(1, 11))


def squared_angle(cosine: Float[Array, ""]) -> Float[Array, ""]:
    """Square of an angle up to pi [rad^2] from its cosine: smooth where the angle is zero.

    arcsin(x)^2 = sum_n (2 x)^(2 n) / (2 n^2 binomial(2 n, n)) (Borwein and Chamberland 2007), with
    x^2 = sin(angle / 2)^2 = (1 - cosine) / 2.
    """
    below = 1.0 - cosine
    near = below < SMALL
    found = jnp.zeros_like(cosine)
    for factor in reversed(SERIES):
        found = (found + factor) * jnp.where(near, below, 0.0)
    far = jnp.arccos(jnp.clip(jnp.where(near, 0.0, cosine), -1.0 + 1e-15, 1.0))
    return jnp.where(near, found, far**2)


class SphericalSpring(Potential):
    """Spring between two triads: energy k angle^2 / 2 of the rotation that takes one to the other.

    At half a turn the axis of the rotation changes, and the torque with it.

    Attributes:
        markers: two attachments, whose triads are parallel where the spring is not stretched.
        stiffness: k [N m/rad], not negative.

    Example:
        >>> import numpy as np
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> ends = tuple(nc.Attachment(body, (0, 0, 0), np.eye(3)) for body in (nc.ground, arm))
        >>> spring = scene.add(nc.SphericalSpring(ends, stiffness=3.0))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=2)))
    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "spherical spring"

    def invariants(self, x: Array) -> Array:
        """Trace of the relative rotation [-]."""
        return jnp.sum(x[0, 1:] * x[1, 1:])[None]

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * squared_angle(0.5 * (invariants[0] - 1.0))
