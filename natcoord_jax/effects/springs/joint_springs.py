"""Springs, dampers, stops and rotor inertia on joint coordinates."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateForce, CoordinateInertia, CoordinatePotential
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.numeric import Number
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
