"""Gaps between pairs of shapes."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.effects.contact.gap import Gap
from natcoord_jax.maths.vectors import dot, safe_sqrt

RADIUS = Number("not negative")
FLAT = 1e-6  # [rad] tilt of a disc below which friction is nearer to its centre than to its rim
TOWARDS_MIDDLE = 1e-3
"""How much nearest points of two segments are drawn to their middles: those of parallel ones are so told."""


def direction(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Its direction; of nothing nothing."""
    size = safe_sqrt(dot(vector, vector))
    return vector / jnp.where(size > 0, size, 1.0)


def _between(
    one: Float[Array, "3"], other: Float[Array, "3"], radii: Float[Array, "2"]
) -> tuple[Array, Array]:
    """The middle of the gap between two spheres, and the direction from the first to the second."""
    normal = direction(other - one)
    return 0.5 * (one + other + (radii[0] - radii[1]) * normal), normal


class SphereOnPlane(Gap):
    """A sphere, or a point, above a plane.

    Markers: a point of the plane, its normal as a direction of the same body, and the centre.

    Attributes:
        radius: of the sphere [m].

    Example:
        >>> import natcoord_jax as nc
        >>> floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> gap = nc.SphereOnPlane(radius=0.1)
        >>> contact = nc.GapPotential((*floor, nc.Point(nc.ground, (0, 0, 1))), gap, stiffness=1e5)
    """

    radius: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(RADIUS))

    markers: ClassVar[Markers] = Markers(1, 1, more=True)
    degree: ClassVar[int] = 1
    sides: ClassVar[tuple[int, int]] = (0, 2)

    def invariants(self, x: Float[Array, "3 3"]) -> Float[Array, "1"]:
        """Height of the centre [m]."""
        return dot(x[1], x[2] - x[0])[None]

    def distance(self, invariants: Float[Array, "1"]) -> Float[Array, ""]:
        """Height less radius."""
        return invariants[0] - self.radius

    def contact(self, x: Float[Array, "3 3"]) -> tuple[Array, Array]:
        """The lowest point of the sphere."""
        normal = direction(x[1])
        return x[2] - self.radius * normal, normal


class SphereOnSphere(Gap):
    """Two spheres.

    Markers: their centres.

    Attributes:
        radii: of both (2,) [m].
    """

    radii: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((2,), "not negative")))

    markers: ClassVar[Markers] = Markers(2)

    def invariants(self, x: Float[Array, "2 3"]) -> Float[Array, "1"]:
        """Square of the distance [m^2]."""
        apart = x[1] - x[0]
        return dot(apart, apart)[None]

    def distance(self, invariants: Float[Array, "1"]) -> Float[Array, ""]:
        """Distance less radii."""
        return safe_sqrt(invariants[0]) - jnp.sum(self.radii)

    def contact(self, x: Float[Array, "2 3"]) -> tuple[Array, Array]:
        """On the line of centres, in the middle of the gap."""
        return _between(x[0], x[1], self.radii)


class CapsuleOnCapsule(Gap):
    """Two capsules: all that is within a radius of a segment. With a segment of no length, a sphere.

    Markers: both ends of the first segment, and of the second.

    Attributes:
        radii: of both (2,) [m].
    """

    radii: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((2,), "not negative")))

    markers: ClassVar[Markers] = Markers(4)
    sides: ClassVar[tuple[int, int]] = (0, 2)

    def invariants(self, x: Float[Array, "4 3"]) -> Float[Array, "6"]:
        """Products of the segments and of what is between their first ends [m^2]."""
        one, other, apart = x[1] - x[0], x[3] - x[2], x[0] - x[2]
        pairs = (one, one), (other, other), (one, other), (one, apart), (other, apart), (apart, apart)
        return jnp.stack([dot(u, v) for u, v in pairs])

    def distance(self, invariants: Float[Array, "6"]) -> Float[Array, ""]:
        """Distance of the nearest points less radii."""
        return safe_sqrt(segment_distance_square(invariants)) - jnp.sum(self.radii)

    def contact(self, x: Float[Array, "4 3"]) -> tuple[Array, Array]:
        """On the line between the nearest points, in the middle of the gap."""
        s, t = nearest_points(self.invariants(x))
        return _between(x[0] + s * (x[1] - x[0]), x[2] + t * (x[3] - x[2]), self.radii)


def nearest_points(
    products: Float[Array, "6 *n"], towards_middle: float = TOWARDS_MIDDLE
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Where on two segments r + s d_1 - t d_2 with s and t from 0 to 1 they are nearest, nearly.

    The nearest points of parallel segments are no points: they jump from end to end as these turn. So what is
    least here is the square of the distance and a little of how far the points are from the middles of the
    segments, in terms of the squares of their lengths.

    Source: C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9, for the limits; here with
    derivatives, of the nearest points too.

    Args:
        products: d_1.d_1, d_2.d_2, d_1.d_2, d_1.r, d_2.r and r.r, of any number of pairs.
        towards_middle: how much of that.
    """
    a, e, b, c, f, _ = products
    little = towards_middle * (a + e)
    stiff_s, stiff_t = a + little, e + little
    some = little > 0
    determinant = jnp.where(some, stiff_s * stiff_t - b * b, 1.0)
    # Least of a s^2 + e t^2 - 2 b s t + 2 c s - 2 f t + little ((s - 1/2)^2 + (t - 1/2)^2).
    pull_s, pull_t = 0.5 * little - c, 0.5 * little + f
    s = jnp.clip((stiff_t * pull_s + b * pull_t) / determinant, 0.0, 1.0)
    t = jnp.clip((b * s + pull_t) / jnp.where(some, stiff_t, 1.0), 0.0, 1.0)
    s = jnp.clip((b * t + pull_s) / jnp.where(some, stiff_s, 1.0), 0.0, 1.0)
    return s, t


def segment_distance_square(products: Float[Array, "6"]) -> Float[Array, ""]:
    """Square of the distance of the nearest points of two segments, see `nearest_points`."""
    a, e, b, c, f, square = products
    s, t = nearest_points(products)
    return square + a * s * s + e * t * t + 2 * (c * s - f * t - b * s * t)


class EllipsoidOnPlane(Gap):
    """An ellipsoid above a plane.

    Markers: a point of the plane and its normal, the centre, and the directions of the axes.

    Attributes:
        semi_axes: (3,) [m].
    """

    semi_axes: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((3,), "positive")))

    markers: ClassVar[Markers] = Markers(1, 1, more=True)
    sides: ClassVar[tuple[int, int]] = (0, 2)

    def invariants(self, x: Float[Array, "6 3"]) -> Float[Array, "4"]:
        """Height of the centre [m], and cosines of the axes with the normal [-]."""
        return jnp.stack([dot(x[1], x[2] - x[0]), *(dot(x[1], axis) for axis in x[3:6])])

    def distance(self, invariants: Float[Array, "4"]) -> Float[Array, ""]:
        """Height less what the ellipsoid reaches along the normal (its support function)."""
        return invariants[0] - safe_sqrt(jnp.sum((self.semi_axes * invariants[1:]) ** 2))

    def contact(self, x: Float[Array, "6 3"]) -> tuple[Array, Array]:
        """The lowest point of the ellipsoid."""
        normal = direction(x[1])
        cosines = x[3:6] @ normal
        size = safe_sqrt(jnp.sum((self.semi_axes * cosines) ** 2))
        return x[2] - (self.semi_axes**2 * cosines / jnp.where(size > 0, size, 1.0)) @ x[3:6], normal


class DiscOnPlane(Gap):
    """The lowest point of the rim of a disc above a plane; two of them make a cylinder.

    Where the disc lies flat, every point of the rim is the lowest, and the gap has a corner as a function of
    its tilt, with a derivative that is that of the centre there. What stands needs points of the rim besides.

    Markers: a point of the plane and its normal, the centre, and the direction of the axis.

    Attributes:
        radius: of the disc [m].
    """

    radius: Any = eqx.field(kw_only=True, metadata=is_a(RADIUS))

    markers: ClassVar[Markers] = Markers(1, 1, more=True)
    sides: ClassVar[tuple[int, int]] = (0, 2)

    def invariants(self, x: Float[Array, "4 3"]) -> Float[Array, "2"]:
        """Height of the centre [m], and the cosine of the axis with the normal [-]."""
        return jnp.stack([dot(x[1], x[2] - x[0]), dot(x[1], x[3])])

    def distance(self, invariants: Float[Array, "2"]) -> Float[Array, ""]:
        """Height less what the rim reaches below the centre."""
        return invariants[0] - self.radius * safe_sqrt(1.0 - invariants[1] ** 2)

    def contact(self, x: Float[Array, "4 3"]) -> tuple[Array, Array]:
        """The lowest point of the rim; of a disc that lies flat its centre, lest rounding choose a point."""
        normal = direction(x[1])
        down = dot(normal, x[3]) * x[3] - normal
        return x[2] + self.radius * down / jnp.sqrt(dot(down, down) + FLAT**2), normal
