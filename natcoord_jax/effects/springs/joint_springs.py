"""Springs, dampers, stops, dry friction and rotor inertia in joints."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateForce, CoordinateInertia, CoordinatePotential
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential, marker_response, place_markers
from natcoord_jax.maths.vectors import positive_part

STIFFNESS = Number("not negative", instead=" (for a spring that pushes away, nc.JointPotential)")
DAMPING = Number("not negative", instead=" (what drives a motion is an input)")


class JointSpring(CoordinatePotential):
    """Linear spring on a joint coordinate: energy k (c - rest)^2 / 2, exact over many turns.

    Attributes:
        joint: handle of the joint.
        stiffness: k [N m/rad or N/m], not negative; a spring that pushes away is a `JointPotential`.
        rest: unstretched coordinate [rad or m].
        coordinate: which coordinate of the joint.

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm))
        >>> spring = scene.add(nc.JointSpring(hinge, stiffness=3.0))
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(STIFFNESS))
    rest: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "joint spring"
    on_a_ball: ClassVar[str] = "nc.SphericalSpring"
    degree: ClassVar[int | None] = 2

    def energy(self, coordinate: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * (coordinate - self.rest) ** 2


class JointPotential(CoordinatePotential):
    """Spring on a joint coordinate with any energy.

    Attributes:
        law: function of the coordinate [rad or m] to the energy [J], in jax.numpy.
    """

    law: Any = eqx.field(
        kw_only=True, metadata=is_a(FunctionOf("of the coordinate [rad or m] to the energy [J]"))
    )

    kind: ClassVar[str] = "joint potential"

    def energy(self, coordinate: Array) -> Array:
        """Energy [J]."""
        return self.law(coordinate)


class JointStops(CoordinatePotential):
    """Stiff elastic stops: energy k s^2 / 2 of the excess s beyond `lower` or `upper`; conserves energy.

    The force is continuous, its slope is not: it jumps from 0 to k. At the stop itself second derivatives of
    the energy are those before contact, and derivatives of a motion that rests there hold to that side.

    Attributes:
        lower: lower stop [rad or m].
        upper: upper stop [rad or m].
        stiffness: k [N m/rad or N/m].
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(STIFFNESS))
    lower: Any = eqx.field(default=-jnp.inf, kw_only=True, metadata=is_a(Number(infinite=True)))
    upper: Any = eqx.field(default=jnp.inf, kw_only=True, metadata=is_a(Number(infinite=True)))

    kind: ClassVar[str] = "joint stops"

    def flaws(self) -> dict[str, Any]:
        """No room."""
        said = "has lower [rad or m] not below upper; pass stops with room between them"
        return {said: self.lower >= self.upper}

    def energy(self, coordinate: Array) -> Array:
        """Energy [J]."""
        below, above = positive_part(self.lower - coordinate), positive_part(coordinate - self.upper)
        return 0.5 * self.stiffness * (below**2 + above**2)


class JointDamper(CoordinateForce):
    """Viscous damper on a joint coordinate: dissipates exactly c (increment)^2 / h in a step.

    Attributes:
        joint: handle of the joint.
        damping: c [N m s/rad or N s/m], not negative; what drives a motion is an input.
    """

    damping: Any = eqx.field(kw_only=True, metadata=is_a(DAMPING))

    kind: ClassVar[str] = "joint damper"
    on_a_ball: ClassVar[str] = "nc.SphericalDamper"

    def force(self, rate: Array, inputs: Array, t: Array) -> Array:
        """Generalised force against the rate."""
        return -self.damping * rate


class Armature(CoordinateInertia):
    """Rotor inertia reflected to a joint coordinate, seen by that coordinate only.

    Attributes:
        joint: handle of the joint.
        inertia: [kg m^2 or kg], not negative.
    """

    inertia: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "armature"

    def inertia_of(self) -> Array:
        """The inertia."""
        return jnp.asarray(self.inertia)


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


SMALL = 0.02
"""Below this 1 - cos of the angle its square is summed as a series."""
SERIES = tuple(2.0 * 2.0**n / (n**2 * math.comb(2 * n, n)) for n in range(1, 11))


def squared_angle(cosine: Float[Array, ""]) -> Float[Array, ""]:
    """Square of an angle up to pi [rad^2] from its cosine: smooth where the angle is zero.

    arcsin(x)^2 = sum_n (2 x)^(2 n) / (2 n^2 binomial(2 n, n)) (Borwein and Chamberland 2007), with
    x^2 = sin(angle / 2)^2 = (1 - cosine) / 2.
    """
    below = 1.0 - cosine
    near = below < SMALL
    found = jnp.zeros_like(cosine)
    for factor in reversed(SERIES):
        found = (found + factor) * jnp.where(near, below, 0.0)
    far = jnp.arccos(jnp.clip(jnp.where(near, 0.0, cosine), -1.0 + 1e-15, 1.0))
    return jnp.where(near, found, far**2)


class SphericalSpring(Potential):
    """Spring between two triads: energy k angle^2 / 2 of the rotation that takes one to the other.

    At half a turn the axis of the rotation changes, and the torque with it.

    Attributes:
        markers: two attachments, whose triads are parallel where the spring is not stretched.
        stiffness: k [N m/rad], not negative.

    Example:
        >>> import numpy as np
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> ends = tuple(nc.Attachment(body, (0, 0, 0), np.eye(3)) for body in (nc.ground, arm))
        >>> spring = scene.add(nc.SphericalSpring(ends, stiffness=3.0))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=2)))
    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "spherical spring"

    def invariants(self, x: Array) -> Array:
        """Trace of the relative rotation [-]."""
        return jnp.sum(x[0, 1:] * x[1, 1:])[None]

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * squared_angle(0.5 * (invariants[0] - 1.0))
