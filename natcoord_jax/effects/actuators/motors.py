"""Motors, thrusters and torquers: forces and torques that are inputs of the system."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateForce
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.kinds import JOINT, Choice
from natcoord_jax.core.markers import Marker, Markers
from natcoord_jax.core.numeric import Number


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
