"""Points of one mesh tied to those of another."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.constraint import Constraint
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Vector


class PointSum(Constraint):
    """A weighted sum of points [m] that vanishes; `nc.Tie` is made of such.

    With weights whose sum is zero it does not see where the points are as a whole, and momentum is kept;
    angular momentum is as well, since the sum itself vanishes, not only its change.

    Attributes:
        markers: points.
        weights: of the points [-].

    Example:
        The second of three points stays in the middle of the others:

        >>> import natcoord_jax as nc
        >>> points = tuple(nc.Point(nc.ground, (k, 0, 0)) for k in range(3))
        >>> middle = nc.PointSum(points, weights=(0.5, -1.0, 0.5))
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    weights: Any = eqx.field(kw_only=True, metadata=is_a(Vector(None)))

    kind: ClassVar[str] = "point sum"
    drawn: ClassVar[bool] = False
    multipliers: ClassVar[int] = 3

    def residual(self, x: Float[Array, "k 3"]) -> Float[Array, "3"]:
        """The sum [m]."""
        return jnp.sum(self.weights[:, None] * x, axis=0)
