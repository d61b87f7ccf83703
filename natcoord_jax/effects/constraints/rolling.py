"""Rolling without slip."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.constraint import VelocityConstraint
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import place_markers
from natcoord_jax.maths.vectors import cross, dot


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
