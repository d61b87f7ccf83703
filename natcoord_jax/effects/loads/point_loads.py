"""Gravity, and forces at points and torques on bodies: constant, following, or functions of time."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a, require
from natcoord_jax.core.force import Field, Force, Load
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import COMPONENTS, Number

VECTOR_OR_FUNCTION = COMPONENTS | FunctionOf("of time [s] to three numbers")


def _at(value: Any, t: Array) -> Array:
    return jnp.asarray(value(t) if callable(value) else value, float)


class PointForce(Force):
    """Force at a point, dead (world components) or following (components along given directions).

    Attributes:
        markers: the point, and for a following force three directions of the body.
        force: shape (3,) [N], or a function of time [s] to it.
        following: take the components along the three directions.

    Example:
        >>> import natcoord_jax as nc
        >>> load = nc.PointForce((nc.Point(nc.ground),), force=(0.0, 0.0, -1.0))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(1, more=True)))
    force: Any = eqx.field(kw_only=True, metadata=is_a(VECTOR_OR_FUNCTION))
    following: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))

    kind: ClassVar[str] = "point force"
    unit_directions: ClassVar[bool] = True

    def __check_init__(self) -> None:
        if self.following:
            require(self, "markers", Markers(1, 3))

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """The force on the first marker."""
        force = _at(self.force, t)
        if self.following:
            force = force @ x[1:4]
        forces = jnp.zeros_like(x).at[0].set(force)
        return Load(forces, None)


class BodyTorque(Force):
    """Torque on a body, through the contravariant directors (61): momentum balance exact at any step.

    Attributes:
        markers: one direction of the body, or three for a following torque.
        torque: shape (3,) [N m], or a function of time [s] to it.
        following: take the components along the three directions.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(0, 1, more=True)))
    torque: Any = eqx.field(kw_only=True, metadata=is_a(VECTOR_OR_FUNCTION))
    following: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))

    kind: ClassVar[str] = "body torque"
    unit_directions: ClassVar[bool] = True

    def __check_init__(self) -> None:
        if self.following:
            require(self, "markers", Markers(0, 3))

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """The torque on the body of the first marker."""
        torque = _at(self.torque, t)
        if self.following:
            torque = torque @ x[0:3]
        torques = jnp.zeros_like(x).at[0].set(torque)
        return Load(None, torques)


class PairTorque(Force):
    """Torque on the body of the second marker, its opposite on that of the first (68).

    Attributes:
        markers: two directions; the torque is along the first, fixed in the first body.
        torque: [N m], scalar or a function of time [s] to it.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(0, 2)))
    torque: Any = eqx.field(kw_only=True, metadata=is_a(Number() | FunctionOf("of time [s] to a number")))

    kind: ClassVar[str] = "pair torque"
    unit_directions: ClassVar[bool] = True

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Torque along the mid-point direction of the first body."""
        torque = _at(self.torque, t) * x[0]
        return Load(None, jnp.stack([-torque, torque]))


class Gravity(Field):
    """Uniform gravity on every body of the scene.

    Attributes:
        vector: acceleration [m/s^2], shape (3,).

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    """

    vector: Any = eqx.field(default=(0.0, 0.0, -9.81), kw_only=True, metadata=is_a(COMPONENTS))

    kind: ClassVar[str] = "gravity"

    def acceleration(self) -> Array:
        """The vector."""
        return jnp.asarray(self.vector, float)
