"""The coordinates of joints: angles counted over many turns, displacements, lengths."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.joint import Frame
from natcoord_jax.core.unit_loads import PairMotion, UnitLoad, unit_load_of
from natcoord_jax.maths.rotations import arctan_quotient
from natcoord_jax.maths.vectors import cross, dot, safe_divide, safe_norm, safe_sqrt


def _pair(torque: Array) -> Array:
    """A torque on the child and its opposite on the parent, for the one stage there is."""
    return jnp.stack([-torque, torque])[None]


def _turn(carrier_spin: Array, axis: Array, rate: Array, h: Array) -> tuple[Array, Array]:
    """Mean rate of an angle over a mid-point step, and its quotient by the rate along the mid-point axis.

    The carrier of the axis turns by Cayley's vector g = h carrier_spin / 2, the other body by g + h rate/2
    times the mid-point axis. Composing the two, the tangent of half the angle turned is
    t = (h rate/2) / (1 + |g|^2 + (h rate/2) g.a), a the unit axis at the start.

    Args:
        carrier_spin: angular velocity of the carrier, shape (3,) [rad/s].
        axis: unit axis at the start of the step.
        rate: relative angular velocity along the mid-point axis, in units of that axis.
        h: step [s]; zero is allowed.

    Returns:
        Angle turned over h [rad/s], and the same over (|mid-point axis|^2 rate), smooth at zero.
    """
    g = 0.5 * h * carrier_spin
    along = dot(g, axis)
    square = 1.0 + dot(g, g)
    denominator = square + 0.5 * h * rate * along
    quotient = arctan_quotient(0.5 * h * rate / denominator) / denominator
    return quotient * rate, quotient * square / (1.0 + along**2)


def _stages(pair: PairMotion) -> int:
    return pair.parent_spin.shape[0]


def _turned(invariants: Callable[[Frame, Frame], Array], pair: PairMotion, h: Array) -> UnitLoad:
    """Unit load of an angle with the given (cosine, sine), for several stages; at most half a turn a step."""
    c, s = invariants(pair.parent_start, pair.child_start)

    def angle(x: Array) -> Array:
        # From the start on, so that the angle never jumps.
        cosine, sine = jnp.unstack(x)
        return jnp.arctan2(c * sine - s * cosine, c * cosine + s * sine)

    return unit_load_of(invariants, angle, pair, h)


@dataclass(frozen=True)
class Angle(Coordinate):
    """Rotation of the child relative to the parent about the parent's axis number `axis` [rad]."""

    axis: int = 2

    def unit_load(self, pair: PairMotion, h: Array) -> UnitLoad:
        """Torque along the mid-point axis, scaled so that its work per radian turned is one."""
        if _stages(pair) > 1:
            return _turned(self._cosine_sine, pair, h)
        start, middle = pair.parent_start.axes[self.axis], pair.parent.axes[0, self.axis]
        relative = pair.child_spin[0] - pair.parent_spin[0]
        along = dot(middle, relative) / dot(middle, middle)
        rate, quotient = _turn(pair.parent_spin[0], start, along, h)
        return UnitLoad(rate[None], None, _pair(quotient * middle))

    def _cosine_sine(self, parent: Frame, child: Frame) -> Array:
        axes, k = jnp.unstack(parent.axes), self.axis
        first, second = axes[(k + 1) % 3], axes[(k + 2) % 3]
        moving = jnp.unstack(child.axes)[(k + 1) % 3]
        return jnp.stack([dot(first, moving), dot(second, moving)])

    def value(self, parent: Frame, child: Frame) -> Array:
        """Angle in (-pi, pi]."""
        cosine, sine = self._cosine_sine(parent, child)
        return jnp.arctan2(sine, cosine)

    def rate(
        self, parent: Frame, child: Frame, parent_rate: Frame, child_rate: Frame, relative_spin: Array
    ) -> Array:
        """Relative angular velocity along the axis."""
        return dot(parent.axes[self.axis], relative_spin)


@dataclass(frozen=True)
class UniversalAngle(Coordinate):
    """One of the two angles of a universal joint [rad].

    The cross turns by the first angle about the parent's third axis a, the child by the second about its
    own first axis b relative to the cross.
    """

    second: bool = False

    def unit_load(self, pair: PairMotion, h: Array) -> UnitLoad:
        """Torque along the reciprocal of the mid-point axis, scaled to unit work."""
        if _stages(pair) > 1:
            return _turned(self._cosine_sine, pair, h)
        a0, a = pair.parent_start.axes[2], pair.parent.axes[0, 2]
        b0, b = pair.child_start.axes[0], pair.child.axes[0, 0]
        relative = pair.child_spin[0] - pair.parent_spin[0]
        n = cross(a, b)
        reciprocal_a, reciprocal_b = cross(b, n) / dot(n, n), cross(n, a) / dot(n, n)
        if self.second:
            cross_spin = pair.parent_spin[0] + dot(reciprocal_a, relative) * a
            rate, quotient = _turn(cross_spin, b0, dot(reciprocal_b, relative), h)
            torque = quotient * dot(b, b) * reciprocal_b
        else:
            rate, quotient = _turn(pair.parent_spin[0], a0, dot(reciprocal_a, relative), h)
            torque = quotient * dot(a, a) * reciprocal_a
        return UnitLoad(rate[None], None, _pair(torque))

    def _cosine_sine(self, parent: Frame, child: Frame) -> Array:
        if self.second:
            along = parent.axes[2]
            return jnp.stack([dot(child.axes[2], along), dot(child.axes[1], along)])
        moving = child.axes[0]
        return jnp.stack([dot(parent.axes[0], moving), dot(parent.axes[1], moving)])

    def value(self, parent: Frame, child: Frame) -> Array:
        """Angle in (-pi, pi]."""
        cosine, sine = self._cosine_sine(parent, child)
        return jnp.arctan2(sine, cosine)

    def rate(
        self, parent: Frame, child: Frame, parent_rate: Frame, child_rate: Frame, relative_spin: Array
    ) -> Array:
        """Component of the relative angular velocity along the axis."""
        a, b = parent.axes[2], child.axes[0]
        n = cross(a, b)
        reciprocal = cross(n, a) if self.second else cross(b, n)
        return safe_divide(dot(reciprocal, relative_spin), dot(n, n))


@dataclass(frozen=True)
class Displacement(Coordinate):
    """Displacement of the child's point along the parent's axis number `axis` [m]: quadratic, hence exact."""

    axis: int = 2

    unit: ClassVar[str] = "m"

    def unit_load(self, pair: PairMotion, h: Array) -> UnitLoad:
        """Unit force along the axis, and the arm on the parent's axis."""
        u = pair.child.point - pair.parent.point
        rate_u = pair.child_rate.point - pair.parent_rate.point
        a, rate_a = pair.parent.axes[:, self.axis], pair.parent_rate.axes[:, self.axis]
        forces = jnp.zeros((a.shape[0], 2, *NODE), a.dtype)
        forces = forces.at[:, 0, 0].set(-a).at[:, 1, 0].set(a).at[:, 0, 1 + self.axis].set(u)
        return UnitLoad(dot(a, rate_u) + dot(rate_a, u), forces, None)

    def value(self, parent: Frame, child: Frame) -> Array:
        """Displacement [m]."""
        return dot(parent.axes[self.axis], child.point - parent.point)

    def rate(
        self, parent: Frame, child: Frame, parent_rate: Frame, child_rate: Frame, relative_spin: Array
    ) -> Array:
        """Rate of the displacement [m/s]."""
        u, rate_u = child.point - parent.point, child_rate.point - parent_rate.point
        return dot(parent.axes[self.axis], rate_u) + dot(parent_rate.axes[self.axis], u)


def _squared_length(parent: Frame, child: Frame) -> Array:
    u = child.point - parent.point
    return dot(u, u)[None]


@dataclass(frozen=True)
class Separation(Coordinate):
    """Distance between the two points of a joint [m], from the exact discrete gradient of the root."""

    unit: ClassVar[str] = "m"

    def unit_load(self, pair: PairMotion, h: Array) -> UnitLoad:
        """Forces along the mid-point line, divided by the mean of the two lengths."""
        if _stages(pair) > 1:
            return unit_load_of(_squared_length, lambda x: safe_sqrt(x[0]), pair, h)
        start = safe_norm(pair.child_start.point - pair.parent_start.point)
        u = (pair.child.point - pair.parent.point)[0]
        rate_u = (pair.child_rate.point - pair.parent_rate.point)[0]
        end = safe_norm(u + 0.5 * h * rate_u)
        direction = 2.0 * safe_divide(u, (start + end)[None])
        forces = jnp.zeros((1, 2, *NODE), direction.dtype)
        forces = forces.at[0, 0, 0].set(-direction).at[0, 1, 0].set(direction)
        return UnitLoad(dot(direction, rate_u)[None], forces, None)

    def value(self, parent: Frame, child: Frame) -> Array:
        """Distance [m]."""
        return safe_norm(child.point - parent.point)

    def rate(
        self, parent: Frame, child: Frame, parent_rate: Frame, child_rate: Frame, relative_spin: Array
    ) -> Array:
        """Rate of the distance [m/s]."""
        u = child.point - parent.point
        return safe_divide(dot(u, child_rate.point - parent_rate.point), safe_norm(u))
