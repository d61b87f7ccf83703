"""Motors, thrusters, torquers and affine actuators: forces and torques that are inputs of the system."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateEffect, CoordinateForce
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.kinds import JOINT, Choice, Several
from natcoord_jax.core.markers import Marker, Markers
from natcoord_jax.core.motion import StepContext
from natcoord_jax.core.numeric import Number, Numbers, Vector


class JointTorque(Force):
    """Motor torque on a joint; one input u [N m].

    u times the parent's mid-point axis acts on the child, its opposite on the parent (67, 68), through the
    contravariant directors (61).

    Attributes:
        joint: handle of a joint with an axis.
        gear: factor on the input.
        axis: which axis of the joint's frame, 0, 1 or 2.

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm))
        >>> motor = scene.add(nc.JointTorque(hinge, name="motor"))
    """

    markers: Any = eqx.field(default=None, init=False)
    joint: Any = eqx.field(metadata=is_a(JOINT))
    gear: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number()))
    axis: int = eqx.field(default=2, kw_only=True, static=True, metadata=is_a(Choice((0, 1, 2))))

    kind: ClassVar[str] = "joint torque"
    inputs: ClassVar[int] = 1

    def attach(self, find: Callable[[Handle], tuple[Joint, Array]]) -> tuple[Marker, ...]:
        """The joint's axis as carried by parent and child."""
        joint, triad = find(self.joint)
        axis = triad[self.axis]
        return (Marker(joint.parent, axis, False), Marker(joint.child, axis, False))

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Torque along the parent's mid-point axis."""
        torque = self.gear * inputs[0] * x[0]
        return Load(None, jnp.stack([-torque, torque]))


class JointForce(CoordinateForce):
    """Motor on a joint coordinate; one input u [N on displacements, N m on angles].

    Its work is exactly u times the increment of the coordinate.

    Attributes:
        joint: handle of the joint.
        coordinate: which coordinate of the joint.
        gear: factor on the input.
    """

    gear: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "joint force"
    on_a_ball: ClassVar[str] = "nc.SphericalTorque"
    inputs: ClassVar[int] = 1

    def force(self, rate: Array, inputs: Array, t: Array) -> Array:
        """The input times the gear."""
        return self.gear * inputs[0]


class BodyTorqueInput(Force):
    """Torque on a body with three inputs, its components [N m] along three directions of the body (61).

    Attributes:
        markers: three directions of the body (for example its principal axes).
    """

    markers: Any = eqx.field(metadata=is_a(Markers(0, 3)))

    kind: ClassVar[str] = "body torque input"
    unit_directions: ClassVar[bool] = True
    inputs: ClassVar[int] = 3

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Components along the mid-point directions."""
        return Load(None, jnp.zeros_like(x).at[0].set(inputs @ x))


class BodyForceInput(Force):
    """Thruster: one input [N] along a direction of the body, at a point of it.

    Attributes:
        markers: the point and the direction.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, 1)))

    kind: ClassVar[str] = "body force input"
    unit_directions: ClassVar[bool] = True
    inputs: ClassVar[int] = 1

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Force along the mid-point direction."""
        return Load(jnp.zeros_like(x).at[0].set(inputs[0] * x[1]), None)


UNBOUNDED = Number(infinite=True)


class Ranged(Effect):
    """Base of motors whose one input is cut off at a range."""

    lower: Any = eqx.field(default=-jnp.inf, kw_only=True, metadata=is_a(UNBOUNDED))
    upper: Any = eqx.field(default=jnp.inf, kw_only=True, metadata=is_a(UNBOUNDED))

    inputs: ClassVar[int] = 1

    def flaws(self) -> dict[str, Any]:
        """A range without anything in it."""
        return {"has lower [-] above upper; exchange them": self.lower > self.upper}


class AffineActuator(Ranged, CoordinateEffect):
    """Motor, position servo, damper that is switched: a force affine in length, velocity and one input.

    With the length l = sum_k gear_k c_k of joint coordinates the force along it is

        f = (gain_0 + gain_1 l + gain_2 l') u + bias_0 + bias_1 l + bias_2 l',

    the general actuator of MuJoCo (documentation, "Actuation model"). A position servo of stiffness k and
    damping d has the gain (k, 0, 0) and the bias (0, -k, -d). Input and force are cut off at their ranges,
    beyond which derivatives vanish. Its work is booked as that of an input, springs in it included.

    Attributes:
        joint: handles of the joints, in a tuple.
        coordinate: which coordinate of each joint, a tuple of indices or one index for all (default: 0).
        gear: shape (c,), length [rad or m] per unit of each coordinate.
        gain: shape (3,), of the input, input times length, input times velocity [N or N m, each by the unit
            of what it is multiplied with].
        bias: shape (3,), constant, of the length, of the velocity [N or N m, likewise].
        lower: least input [-].
        upper: largest input [-].
        least: least force [N or N m].
        most: largest force [N or N m].

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm))
        >>> servo = nc.AffineActuator((hinge,), gain=(50.0, 0.0, 0.0), bias=(0.0, -50.0, -2.0), name="servo")
        >>> added = scene.add(servo)
    """

    joint: Any = eqx.field(metadata=is_a(Several(JOINT, 1)))
    gear: Any = eqx.field(default=(1.0,), kw_only=True, metadata=is_a(Vector(None)))
    gain: Any = eqx.field(default=(1.0, 0.0, 0.0), kw_only=True, metadata=is_a(Vector()))
    bias: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(Vector()))
    least: Any = eqx.field(default=-jnp.inf, kw_only=True, metadata=is_a(UNBOUNDED))
    most: Any = eqx.field(default=jnp.inf, kw_only=True, metadata=is_a(UNBOUNDED))

    kind: ClassVar[str] = "affine actuator"
    on_a_ball: ClassVar[str] = "nc.SphericalTorque"
    works: ClassVar[bool] = True

    def flaws(self) -> dict[str, Any]:
        """Ranges without anything in them."""
        said = "has least [N or N m] above most; exchange them"
        return {**super().flaws(), said: self.least > self.most}

    def generalised(self, rates: Array, now: StepContext, lam: Array) -> tuple[Array, Array, Array]:
        """The force at every stage, along the gear; its power is force times velocity, exactly."""
        gear = jnp.asarray(self.gear, float)
        gain, bias = jnp.unstack(jnp.asarray(self.gain)), jnp.unstack(jnp.asarray(self.bias))
        begun, velocity = now.coordinates @ gear, rates @ gear
        length = begun + now.h * jnp.asarray(now.tableau.a) @ velocity
        u = jnp.clip(now.stage_inputs[:, 0], self.lower, self.upper)
        force = (gain[0] + gain[1] * length + gain[2] * velocity) * u
        force = force + bias[0] + bias[1] * length + bias[2] * velocity
        force = jnp.clip(force, self.least, self.most)
        return force[:, None] * gear, jnp.zeros((len(now.tableau.b), 0)), force * velocity


class WrenchInput(Ranged, Force):
    """Thruster with a torque about its axis, as of a propeller: one input, a force and a torque on a body.

    Attributes:
        markers: the point where the force takes hold, and three directions of its body.
        force: shape (3,), along the three directions, per unit of the input [N].
        torque: shape (3,), about the three directions, per unit of the input [N m].
        lower: least input [-].
        upper: largest input [-].

    Example:
        >>> import numpy as np
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> axes = tuple(nc.Direction(body, axis) for axis in np.eye(3))
        >>> rotor = nc.WrenchInput((nc.Point(body, (1, 0, 0)), *axes), force=(0, 0, 1), torque=(0, 0, 0.02))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, 3)))
    force: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(Numbers((3,))))
    torque: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(Numbers((3,))))

    kind: ClassVar[str] = "wrench input"
    unit_directions: ClassVar[bool] = True

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Force and torque along the mid-point directions."""
        u = jnp.clip(inputs[0], self.lower, self.upper)
        force, torque = (u * jnp.asarray(v) @ x[1:] for v in (self.force, self.torque))
        nothing = jnp.zeros_like(x)
        return Load(nothing.at[0].set(force), nothing.at[0].set(torque))


class SphericalTorque(Ranged, Force):
    """Motor in a spherical joint: one input, a torque [N m] about a direction of one of its bodies.

    Attributes:
        markers: the direction, of the body that the torque acts on, whose length is a factor, too, and any
            direction of the other body, which takes the opposite torque.
        gear: factor on the input.
        lower: least input [N m / gear].
        upper: largest input [N m / gear].
    """

    markers: Any = eqx.field(metadata=is_a(Markers(0, 2)))
    gear: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "spherical torque"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Torque along the mid-point direction, and its opposite."""
        torque = self.gear * jnp.clip(inputs[0], self.lower, self.upper) * x[0]
        return Load(None, jnp.stack([torque, -torque]))
