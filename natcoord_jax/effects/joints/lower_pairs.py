"""The joints of the library: lower pairs, universal, screw and distance (44-51)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import positive
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Frame, Joint, frames_at
from natcoord_jax.core.numeric import COMPONENTS, Number
from natcoord_jax.effects.joints.coordinates import Angle, Displacement, Separation, UniversalAngle
from natcoord_jax.effects.joints.relations import Coupling
from natcoord_jax.maths.vectors import dot, safe_norm


def _axis_parallel(parent: Frame, child: Frame) -> list[Array]:
    """Two conditions that keep the child's third axis parallel to the parent's."""
    first, second, _ = jnp.unstack(parent.axes)
    third = jnp.unstack(child.axes)[2]
    return [dot(first, third), dot(second, third)]


def _orientation(parent: Frame, child: Frame) -> list[Array]:
    """Three conditions that keep the two triads parallel."""
    (first, second, _), (_, moving, third) = jnp.unstack(parent.axes), jnp.unstack(child.axes)
    return [dot(first, third), dot(second, third), dot(first, moving)]


def _tilt(parent: Frame, child: Frame) -> tuple[Array, Array]:
    """The sine of the angle between the third axes along `_axis_parallel`, and its cosine."""
    return jnp.stack(_axis_parallel(parent, child)), dot(parent.axes[2], child.axes[2])


def _turn(parent: Frame, child: Frame) -> tuple[Array, Array]:
    """The same of the angle between the triads, along `_orientation`."""
    r = parent.axes @ child.axes.T
    sine = 0.5 * jnp.stack([r[0, 2] - r[2, 0], r[1, 2] - r[2, 1], r[0, 1] - r[1, 0]])
    return sine, 0.5 * (jnp.trace(r) - 1.0)


class Facing(Joint):
    """Base of joints whose axes point the same way, which constraints that are products do not tell.

    Class attributes:
        turn: sine, along the last constraints, and cosine of the angle between the frames.
    """

    turn: ClassVar[Any] = staticmethod(_tilt)

    def opening(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """The residual; beyond 90 degrees the angle instead of its sine, which vanishes at 180 as well.

        There all directions are alike, and one is as good as another.
        """
        parent, child = frames_at(place, rows)
        residual, (sine, cosine) = self.residual(parent, child), self.turn(parent, child)
        beyond, size, count = cosine < 0, safe_norm(sine), sine.shape[0]
        some = size > 0
        along = jnp.where(some, sine / jnp.where(some, size, 1.0), jnp.eye(count)[0])
        angle = jnp.arctan2(size, jnp.where(beyond, cosine, 1.0))
        return residual.at[-count:].set(jnp.where(beyond, angle * along, residual[-count:]))

    def opening_slope(self, place: Array, rows: Array, rates: Array, spin: Array, t: Array) -> Array:
        """That of the opening."""
        return jax.jvp(lambda x: self.opening(place, x, spin, t), (rows,), (rates,))[1]


class Fixed(Facing):
    """Child fixed in the parent at `point` [m]: 6 constraints, no free motion.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.Fixed(nc.ground, nc.ground).multipliers
        6
    """

    kind: ClassVar[str] = "fixed joint"
    turn: ClassVar[Any] = staticmethod(_turn)
    multipliers: ClassVar[int] = 6
    free: ClassVar[bool] = True

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Coincident points [m], parallel triads [-]."""
        return jnp.concatenate([child.point - parent.point, jnp.stack(_orientation(parent, child))])


class Spherical(Joint):
    """Ball joint at `point` [m]: 3 constraints x_c - x_p = 0; all rotations free."""

    kind: ClassVar[str] = "spherical joint"
    multipliers: ClassVar[int] = 3
    rotations: ClassVar[tuple[int, ...]] = (0, 1, 2)
    free: ClassVar[bool] = True

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Coincident points [m]."""
        return child.point - parent.point


class Revolute(Facing):
    """Hinge about `axis` through `point`: 5 constraints; coordinate 0 is the angle [rad].

    Attributes:
        zero: angle from the assembled pose at which the coordinate is zero [rad].

    Example:
        A rod that is compiled hanging, and whose angle counts from where it stands upright:

        >>> import math, jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.01), com=(0, 0, -0.5), name="rod"))
        >>> hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), zero=-math.pi))
        >>> system, state = scene.compile()
        >>> round(float(system.coordinate(state, hinge)), 12) == round(math.pi, 12)
        True
    """

    zero: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))

    assembling: ClassVar[tuple[str, ...]] = (*Joint.assembling, "zero")
    kind: ClassVar[str] = "revolute joint"
    multipliers: ClassVar[int] = 5
    rotations: ClassVar[tuple[int, ...]] = (2,)
    free: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Angle(),)

    def zeroed(self, triad: Array) -> tuple[Array, Array]:
        """The parent's triad turned about the axis."""
        first, second, third = jnp.unstack(triad)
        cosine, sine = jnp.cos(self.zero), jnp.sin(self.zero)
        turned = (cosine * first + sine * second, cosine * second - sine * first, third)
        return jnp.stack(turned), jnp.zeros(3)

    def assembled(self, coordinate: int) -> Any:
        """As far as the coordinate's zero is away."""
        return 0.0 - self.zero

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Coincident points [m], parallel axes [-]."""
        return jnp.concatenate([child.point - parent.point, jnp.stack(_axis_parallel(parent, child))])


class Universal(Joint):
    """Cardan joint: `axis` is fixed in the parent, `second` in the child; 4 constraints.

    Coordinates: 0 the angle about the parent's axis, 1 the angle about the child's axis [rad].
    """

    kind: ClassVar[str] = "universal joint"
    multipliers: ClassVar[int] = 4
    rotations: ClassVar[tuple[int, ...]] = (2,)
    child_rotation: ClassVar[bool] = True
    free: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (UniversalAngle(), UniversalAngle(second=True))

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Coincident points [m], perpendicular axes [-]."""
        angle = dot(parent.axes[2], child.axes[0])
        return jnp.concatenate([child.point - parent.point, angle[None]])


class Cylindrical(Facing):
    """Turning and sliding along `axis` (48, 49): 4 constraints.

    Coordinates: 0 the angle [rad], 1 the displacement [m].
    """

    kind: ClassVar[str] = "cylindrical joint"
    multipliers: ClassVar[int] = 4
    rotations: ClassVar[tuple[int, ...]] = (2,)
    translations: ClassVar[tuple[int, ...]] = (2,)
    free: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Angle(), Displacement())

    def residual(self, parent: Frame, child: Frame) -> Array:
        """No offset across the axis [m], parallel axes [-]."""
        u = child.point - parent.point
        return jnp.stack([dot(parent.axes[0], u), dot(parent.axes[1], u), *_axis_parallel(parent, child)])


class Prismatic(Facing):
    """Sliding along `axis`: 5 constraints; coordinate 0 is the displacement [m].

    Attributes:
        zero: displacement from the assembled pose at which the coordinate is zero [m].
    """

    zero: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))

    assembling: ClassVar[tuple[str, ...]] = (*Joint.assembling, "zero")
    kind: ClassVar[str] = "prismatic joint"
    turn: ClassVar[Any] = staticmethod(_turn)
    multipliers: ClassVar[int] = 5
    translations: ClassVar[tuple[int, ...]] = (2,)
    free: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Displacement(),)

    def zeroed(self, triad: Array) -> tuple[Array, Array]:
        """The parent's point, moved along the axis."""
        return triad, self.zero * triad[2]

    def residual(self, parent: Frame, child: Frame) -> Array:
        """No offset across the axis [m], parallel triads [-]."""
        u = child.point - parent.point
        return jnp.stack([dot(parent.axes[0], u), dot(parent.axes[1], u), *_orientation(parent, child)])


class Planar(Facing):
    """Sliding in the plane normal to `axis` and turning about it: 3 constraints.

    Coordinates: 0, 1 displacements along the first and second axis [m], 2 the angle [rad].
    """

    kind: ClassVar[str] = "planar joint"
    multipliers: ClassVar[int] = 3
    rotations: ClassVar[tuple[int, ...]] = (2,)
    translations: ClassVar[tuple[int, ...]] = (0, 1)
    free: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Displacement(axis=0), Displacement(axis=1), Angle())

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Points in the plane [m], parallel normals [-]."""
        u = child.point - parent.point
        return jnp.stack([dot(parent.axes[2], u), *_axis_parallel(parent, child)])


class Screw(Cylindrical):
    """Helical joint: a cylindrical joint that advances by `pitch` [m] per turn; 4 + 1 constraints.

    The pitch relation involves the angle and keeps its multiplier.
    Coordinates: 0 the angle [rad], 1 the displacement [m].
    """

    pitch: Any = eqx.field(default=0.01, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "screw joint"

    def companions(self, handle: Handle) -> list[Effect]:
        """The pitch relation: displacement - pitch / (2 pi) angle = 0."""
        factors = jnp.stack([-jnp.asarray(self.pitch, float) / (2 * jnp.pi), jnp.asarray(1.0)])
        return [Coupling((handle, handle), factors=factors, coordinate=(0, 1), name=f"{handle.name} pitch")]


class Distance(Joint):
    """Massless rod between two points: 1 constraint, |x_c - x_p|^2 = length^2; keeps its multiplier.

    Attributes:
        point: point of the child, world coordinates of the assembled pose [m]; default its reference point.
        parent_point: the same of the parent [m].
        length: length [m]; default that of the assembled pose; not zero, for which there is `Spherical`.

    Coordinate 0 is the distance [m].
    """

    parent_point: Any = eqx.field(default=None, kw_only=True, metadata=is_a(COMPONENTS))
    length: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "distance joint"
    multipliers: ClassVar[int] = 1
    assembling: ClassVar[tuple[str, ...]] = (*Joint.assembling, "parent_point")
    apart: ClassVar[bool] = True
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Separation(),)

    def anchors(self) -> tuple[Any, Any]:
        """Points of parent and child, which are not the same here."""
        return self.parent_point, self.point

    def initialise(self, parent: Frame, child: Frame) -> "Distance":
        """With the length of the assembled pose where none was given.

        Raises:
            ValueError: for a length that is not positive: a rod without length has no direction.
        """
        length = safe_norm(child.point - parent.point) if self.length is None else self.length
        positive(length, f"distance joint {self.name!r}: length", "m")
        return replace_fields(self, length=length)

    def residual(self, parent: Frame, child: Frame) -> Array:
        """Half the difference of the squared lengths over the length [m]: scaled like a length."""
        u = child.point - parent.point
        return ((dot(u, u) - self.length**2) / (2.0 * self.length))[None]
