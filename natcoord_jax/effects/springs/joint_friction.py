"""Friction in joints: dry on a coordinate, viscous in spherical joints."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateForce
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import marker_response, place_markers


class JointFriction(CoordinateForce):
    """Dry friction on a joint coordinate, smooth at rest: force f r / sqrt(r^2 + s^2) against the rate r.

    It is f to within half a per cent at ten times the slip rate s; below s it is a stiff damper, so that
    what should stick creeps. A smaller s is nearer to Coulomb's law and takes shorter steps.

    Attributes:
        joint: handle of the joint.
        friction: f [N m or N], not negative.
        slip: s [rad/s or m/s], positive; None: 3e-3 of the speeds of the scene, see `nc.GapConstraint`, of an
            angle over its size.
        coordinate: which coordinate of the joint.

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm))
        >>> friction = scene.add(nc.JointFriction(hinge, friction=0.3))
    """

    friction: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    slip: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "joint friction"
    slips: ClassVar[tuple[str, float] | None] = ("slip", 3e-3)

    def force(self, rate: Array, inputs: Array, t: Array) -> Array:
        """Generalised force against the rate."""
        return -self.friction * rate / jnp.sqrt(rate**2 + self.slip**2)


class SphericalDamper(Force):
    """Viscous damper of a spherical joint: torque c times the relative angular velocity, against it.

    Attributes:
        markers: a direction of each of the two bodies, which say no more than which bodies they are.
        damping: c [N m s/rad], not negative.

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> ends = nc.Direction(nc.ground, (0, 0, 1)), nc.Direction(arm, (0, 0, 1))
        >>> damper = scene.add(nc.SphericalDamper(ends, damping=0.1))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(0, 2)))
    damping: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "spherical damper"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Nothing that follows from the markers alone."""
        return Load(None, jnp.zeros_like(x))

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Equal and opposite torques, from the angular velocities of the bodies."""
        rates = place_markers(place, motion.rates)
        torque = self.damping * (motion.spin[:, 1] - motion.spin[:, 0])
        return marker_response(place, None, jnp.stack([torque, -torque], axis=1), rates, motion)
