"""Springs and dampers between two points."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential
from natcoord_jax.maths.vectors import dot, safe_divide, safe_norm

COINCIDENT = 1e-12
"""Distance [m] of points that coincide: what rounding leaves of none."""

STIFFNESS = Number("not negative", instead=" (for a spring that pushes away, nc.NonlinearSpring)")
DAMPING = Number("not negative", instead=" (what drives a motion is an input or a force)")


def energy_of_distance(law: Callable[[Array], Array], square: Float[Array, ""]) -> Float[Array, ""]:
    """Energy [J] as a law of a distance [m], and its derivatives by the squared distance, at zero too.

    A law that is even, such as k d^2 / 2, is a smooth function of the squared distance, though the distance
    is none: where the points coincide its derivative by the square is half the law's second one. Of a law
    with a slope at zero, a spring with an unstretched length, that is the even part: the force on points that
    coincide has no direction, and is zero.
    """
    apart = square > COINCIDENT**2
    still = jnp.maximum(jax.lax.stop_gradient(square), 0.0)
    distance = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), jnp.sqrt(still))
    bend = jax.hessian(law)(jnp.full_like(square, COINCIDENT))
    # The value is that of the law; along paths of several stages the square can fall a little below zero.
    return law(distance) + jnp.where(apart, 0.0, 0.5 * bend * (square - still))


class DistanceSpring(Potential):
    """Base of springs between two points: a subclass gives `energy`."""

    markers: Any = eqx.field(metadata=is_a(Markers(2)))

    couples: ClassVar[bool] = True

    def invariants(self, x: Array) -> Array:
        """Squared distance [m^2]."""
        u = x[1] - x[0]
        return dot(u, u)[None]


class Spring(DistanceSpring):
    """Linear spring between two points: energy k (|u| - L)^2 / 2.

    Smooth where the points coincide if L = 0, as of a mount or a bushing. With an unstretched length the
    force has no direction there: it is taken as zero, its derivatives as those for L = 0.

    Attributes:
        markers: two points.
        stiffness: k [N/m], not negative; a spring that pushes away is a `NonlinearSpring`.
        length: unstretched length L [m].

    Example:
        >>> import natcoord_jax as nc
        >>> ends = (nc.Point(nc.ground), nc.Point(nc.ground, (0, 0, 1)))
        >>> spring = nc.Spring(ends, stiffness=50.0, length=1.0)
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(STIFFNESS))
    length: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "spring"

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return energy_of_distance(lambda d: 0.5 * self.stiffness * (d - self.length) ** 2, invariants[0])


class QuadraticSpring(DistanceSpring):
    """Spring with energy k (|u|^2 - L^2)^2 / 2, a polynomial of the invariant (Gonzalez 1999).

    Attributes:
        markers: two points.
        stiffness: k [N/m^3].
        length: unstretched length L [m].
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(STIFFNESS))
    length: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "quadratic spring"
    degree: ClassVar[int | None] = 2

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * (invariants[0] - self.length**2) ** 2


class NonlinearSpring(DistanceSpring):
    """Spring between two points with any energy of its length.

    A law whose slope is not zero at length zero gives no direction to the force there, see `Spring`.

    Attributes:
        markers: two points.
        law: function of the distance [m] to the energy [J], in jax.numpy.
    """

    law: Any = eqx.field(kw_only=True, metadata=is_a(FunctionOf("of the distance [m] to the energy [J]")))

    kind: ClassVar[str] = "nonlinear spring"

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return energy_of_distance(self.law, invariants[0])


class Damper(Force):
    """Viscous damper along the line between two points: force c d|u|/dt; keeps momentum and angular momentum.

    The line has no direction where the points coincide: there the force is zero and has no derivatives, and
    near there it depends on which side the points pass each other.

    Attributes:
        markers: two points.
        damping: c [N s/m], not negative.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(2)))
    damping: Any = eqx.field(kw_only=True, metadata=is_a(DAMPING))

    kind: ClassVar[str] = "damper"
    couples: ClassVar[bool] = True

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Equal and opposite forces along the mid-point line."""
        u = x[1] - x[0]
        direction = safe_divide(u, safe_norm(u)[None])
        force = self.damping * dot(direction, rate[1] - rate[0]) * direction
        return Load(jnp.stack([force, -force]), None)
