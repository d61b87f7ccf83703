"""Relations between joint coordinates: prescribed motion and couplings (gears, pitch of a screw)."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.coordinate import CoordinateConstraint
from natcoord_jax.core.kinds import JOINT, FunctionOf, Several
from natcoord_jax.core.numeric import Number, Vector, Whole

MOTION = FunctionOf("of time [s] to the coordinate [rad or m] (lambda t: value for one that stands still)")


class Drive(CoordinateConstraint):
    """Joint coordinate prescribed as a function of time; the drive's work is in the work account.

    Attributes:
        joint: handle of the joint.
        function: function of time [s] to the coordinate [rad or m], in jax.numpy. An `eqx.Module` with
            array fields has its numbers as leaves; what a plain function reads is seen at each call.
        coordinate: which coordinate of the joint.
    """

    joint: Any = eqx.field(metadata=is_a(JOINT))
    coordinate: Any = eqx.field(default=0, kw_only=True, metadata=is_a(Whole(0)))
    function: Any = eqx.field(kw_only=True, metadata=is_a(MOTION))

    kind: ClassVar[str] = "drive"

    def coefficients(self) -> Array:
        """One."""
        return jnp.ones(1)

    def target(self, t: Array) -> Array:
        """The prescribed value."""
        return jnp.asarray(self.function(t), float)


class Coupling(CoordinateConstraint):
    """Linear relation sum_k factor_k coordinate_k = offset between joint coordinates, as gears give.

    Attributes:
        joint: tuple of joint handles.
        factors: shape (c,), one a coordinate.
        coordinate: which coordinate of each joint, a tuple of indices or one index for all (default: 0).
        offset: right-hand side, in the unit of factor times coordinate [rad or m].
    """

    joint: Any = eqx.field(metadata=is_a(Several(JOINT, 1)))
    factors: Any = eqx.field(default=(1.0, -1.0), kw_only=True, metadata=is_a(Vector(None)))
    offset: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))

    kind: ClassVar[str] = "coupling"
    works: ClassVar[bool] = False

    def coefficients(self) -> Array:
        """The factors."""
        return jnp.asarray(self.factors, float)

    def target(self, t: Array) -> Array:
        """The constant offset."""
        return jnp.asarray(self.offset, float)
