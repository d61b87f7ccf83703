"""Gravity, forces at points and along edges of shells, torques on bodies, also as functions of time."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a, require
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.force import Field, Force, Load
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import COMPONENTS, Number
from natcoord_jax.maths.vectors import cross, safe_norm, unit

LOAD = COMPONENTS | FunctionOf("of time [s] to three numbers")


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
    force: Any = eqx.field(kw_only=True, metadata=is_a(LOAD))
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
    torque: Any = eqx.field(kw_only=True, metadata=is_a(LOAD))
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


def edge_axes(x: Float[Array, "2 m 3"]) -> Float[Array, "3 3"]:
    """Along an edge, outwards in the surface, and normal to it, in rows, of two points with directors."""
    along = unit(x[1, 0] - x[0, 0])
    outwards = unit(cross(along, x[0, 1] + x[1, 1]))
    return jnp.stack([along, outwards, cross(outwards, along)])


class EdgeSegment(Force):
    """Force and moment per length on the edge of a shell between two nodes, half of them on each.

    Attributes:
        markers: the two nodes, a point and a director of each, in turn round the element.
        force: shape (3,) [N/m], or a function of time [s] to it.
        moment: shape (3,) [N m/m], or a function of time [s] to it; of it directors carry what is normal to
            them.
        following: take components along the edge, outwards in the surface and normal to it, of the middle of
            the step, instead of the world's axes.
        length: [m]; None: as in the assembled pose.

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> ends = tuple(nc.Attachment(nc.ground, (x, 0, 0), np.eye(3)) for x in (0, 1))
        >>> load = nc.EdgeSegment(ends, force=(0.0, 0.0, -20.0), moment=(5.0, 0.0, 0.0), following=True)
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=2)))
    force: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(LOAD))
    moment: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(LOAD))
    following: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    length: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "edge load"
    vectors: ClassVar[int] = 2

    def assembled_at(self, x: Float[Array, "2 m 3"]) -> "EdgeSegment":
        """With its length."""
        return self if self.length is not None else replace_fields(self, length=safe_norm(x[1, 0] - x[0, 0]))

    def load(self, x: Float[Array, "2 m 3"], rate: Array, inputs: Array, t: Array) -> Load:
        """Half of it on each node."""
        axes = edge_axes(x) if self.following else jnp.eye(3)
        force, moment = (0.5 * self.length * _at(v, t) @ axes for v in (self.force, self.moment))
        return Load(jnp.zeros_like(x).at[:, 0].set(force), jnp.stack([moment, moment]))
