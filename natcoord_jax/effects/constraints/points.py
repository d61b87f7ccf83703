"""Constraints between points: on a plane, on a line, at a distance, of meshes, and of bodies that roll."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array, positive
from natcoord_jax.core.constraint import Constraint, VelocityConstraint
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.markers import Attachment, Direction, Marker, Markers
from natcoord_jax.core.numeric import Number, Vector
from natcoord_jax.core.potential import place_markers
from natcoord_jax.maths.rotations import frame_from_axis
from natcoord_jax.maths.vectors import cross, dot

_triad = eager_numpy(frame_from_axis)


def perpendicular(along: Marker) -> tuple[Marker, Marker]:
    """Two directions of the same body at right angles to one and to each other."""
    across = _triad(as_array(along.vector, float), None)[:2]
    return tuple(Direction(along.body, a, local=along.local) for a in across)  # pyright: ignore


class PointOnPoint(Constraint):
    """Two points that stay together, as a ball joint keeps them; of bodies, nodes, or between nodes.

    Attributes:
        markers: two points [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.PointOnPoint((nc.Point(nc.ground), nc.Point(nc.ground))).multipliers
        3
    """

    markers: Any = eqx.field(metadata=is_a(Markers(2)))

    kind: ClassVar[str] = "point on point"
    multipliers: ClassVar[int] = 3

    def residual(self, x: Array) -> Array:
        """The gap [m]."""
        return x[1] - x[0]


class PointOnPlane(Constraint):
    """A point that stays in a plane, or at a distance from it.

    Attributes:
        markers: a point of the plane, its normal as a direction of the same body, and the point.
        distance: of the point from the plane along the normal [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> table = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> nc.PointOnPlane((*table, nc.Point(nc.ground))).multipliers
        1
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, 1, more=True)))
    distance: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "point on plane"
    unit_directions: ClassVar[bool] = True
    multipliers: ClassVar[int] = 1

    def residual(self, x: Array) -> Array:
        """How far the point is from where it should be [m]."""
        return (dot(x[1], x[2] - x[0]) - self.distance)[None]


class PointOnLine(Constraint):
    """A point that stays on a straight line of another body.

    Attributes:
        markers: a point of the line, its direction in the same body, and the point, in [m] as all points.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> wire = nc.Point(nc.ground), nc.Direction(nc.ground, (1, 0, 0))
        >>> nc.PointOnLine((*wire, nc.Point(nc.ground))).multipliers
        2
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, 1, more=True)))

    kind: ClassVar[str] = "point on line"
    multipliers: ClassVar[int] = 2

    def attach(self, find: Callable[[Handle], tuple[Joint, Array]]) -> Sequence[Marker | Attachment]:
        """A point of the line, two directions across it, and the point."""
        origin, along, point = self.markers
        return origin, *perpendicular(along), point

    def residual(self, x: Array) -> Array:
        """How far the point is from the line [m]."""
        return jnp.stack([dot(x[1], x[3] - x[0]), dot(x[2], x[3] - x[0])])


class Rod(Constraint):
    """A rigid rod without mass between two points.

    Attributes:
        markers: two points.
        length: [m]; None: as in the assembled pose.

    Example:
        A double pendulum of point masses:

        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> upper = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0)))
        >>> lower = scene.add(nc.PointMass(mass=1.0, position=(2, 0, 0)))
        >>> first = scene.add(nc.Rod((nc.Point(nc.ground), nc.Point(upper))))
        >>> second = scene.add(nc.Rod((nc.Point(upper), nc.Point(lower))))
        >>> system, state = scene.compile()
        >>> system.structure.dofs
        4
    """

    markers: Any = eqx.field(metadata=is_a(Markers(2)))
    length: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "rod"
    multipliers: ClassVar[int] = 1
    couples: ClassVar[bool] = True

    def assembled_at(self, x: Array) -> "Rod":
        """With its length.

        Raises:
            ValueError: for points that coincide.
        """
        if self.length is not None:
            return self
        found = jnp.sqrt(jnp.sum((x[1] - x[0]) ** 2))
        return replace_fields(self, length=positive(found, "rod: the distance of its points", "m"))

    def residual(self, x: Array) -> Array:
        """Half the square of its stretch, by its length, to first order [m]."""
        along = x[1] - x[0]
        return (0.5 * (dot(along, along) / self.length - self.length))[None]


class PointSum(Constraint):
    """A weighted sum of points [m] that vanishes; `nc.Tie` is made of such.

    With weights whose sum is zero it does not see where the points are as a whole, and momentum is kept;
    angular momentum is as well, since the sum itself vanishes, not only its change.

    Attributes:
        markers: points.
        weights: of the points [-].

    Example:
        The second of three points stays in the middle of the others:

        >>> import natcoord_jax as nc
        >>> points = tuple(nc.Point(nc.ground, (k, 0, 0)) for k in range(3))
        >>> middle = nc.PointSum(points, weights=(0.5, -1.0, 0.5))
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    weights: Any = eqx.field(kw_only=True, metadata=is_a(Vector(None)))

    kind: ClassVar[str] = "point sum"
    drawn: ClassVar[bool] = False
    multipliers: ClassVar[int] = 3

    def residual(self, x: Float[Array, "k 3"]) -> Float[Array, "3"]:
        """The sum [m]."""
        return jnp.sum(self.weights[:, None] * x, axis=0)


class Rolling(VelocityConstraint):
    """A ball, or a thin disc, that rolls on a plane without slip: its point of contact is at rest there.

    The contact is kept, whatever it takes, and nothing is lost to friction. A ball stays at its height
    exactly; a disc, whose contact moves along its rim, to the order of the scheme.

    Attributes:
        markers: a point of the plane, its normal (pointing to the body) as a direction of the same body, and
            the centre of the ball; of a disc also its axis, as a direction of the disc.
        radius: [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity(vector=(1.0, 0.0, -9.81)))
        >>> ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1000.0, position=(0, 0, 0.1)))
        >>> table = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> contact = scene.add(nc.Rolling((*table, nc.Point(ball)), radius=0.1))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.01, steps=100)
        >>> round(float(trajectory.q[-1, 0, 0]), 5), round(0.5 * 5 / 7, 5)
        (0.35714, 0.35714)
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, 1, more=True)))
    radius: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "rolling"
    unit_directions: ClassVar[bool] = True
    multipliers: ClassVar[int] = 3

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """How far a ball is from its plane [m]; a disc is where it is to the order of the scheme only."""
        x = place_markers(place, rows)
        if len(x) > 3:
            return super().violation(place, rows, coordinates, t)
        return (dot(x[1], x[2] - x[0]) - self.radius) * x[1]

    def rate(self, x: Array, velocity: Array, spin: Array) -> Array:
        """Velocity of the body's point of contact relative to the plane [m/s]."""
        down = -x[1]
        if len(x) > 3:
            # From the centre to the lowest point of the rim; a disc that lies flat has none.
            axis = x[3]
            down = down - dot(down, axis) * axis
            size = dot(down, down)
            down = down / jnp.sqrt(jnp.where(size > 0, size, 1.0))
        arm = self.radius * down
        at_rim = velocity[2] + cross(spin[2], arm)
        on_plane = velocity[0] + cross(spin[0], x[2] + arm - x[0])
        return at_rim - on_plane
