"""Springs and dampers between two points."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.markers import require_markers
from natcoord_jax.core.potential import Potential
from natcoord_jax.maths.vectors import dot, safe_divide, safe_norm, safe_sqrt


def _square(x: Array) -> Array:
    u = x[1] - x[0]
    return dot(u, u)[None]


class Spring(Potential):
    """Linear spring between two points: energy k (|u| - L)^2 / 2.

    Attributes:
        markers: two points.
        stiffness: k [N/m].
        length: unstretched length L [m].

    Example:
        >>> import natcoord_jax as nc
        >>> ends = (nc.Point(nc.ground), nc.Point(nc.ground, (0, 0, 1)))
        >>> spring = nc.Spring(ends, stiffness=50.0, length=1.0)
    """

    stiffness: Any = eqx.field(kw_only=True)
    length: Any = eqx.field(default=0.0, kw_only=True)

    kind: ClassVar[str] = "spring"
    couples: ClassVar[bool] = True

    def __check_init__(self) -> None:
        require_markers(self.kind, self.markers, 2, 0)

    def invariants(self, x: Array) -> Array:
        """Squared distance [m^2]."""
        return _square(x)

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * (safe_sqrt(invariants[0]) - self.length) ** 2


class QuadraticSpring(Potential):
    """Spring with energy k (|u|^2 - L^2)^2 / 2, a polynomial of the invariant (Gonzalez 1999).

    Attributes:
        markers: two points.
        stiffness: k [N/m^3].
        length: unstretched length L [m].
    """

    stiffness: Any = eqx.field(kw_only=True)
    length: Any = eqx.field(default=0.0, kw_only=True)

    kind: ClassVar[str] = "quadratic spring"
    couples: ClassVar[bool] = True
    degree: ClassVar[int | None] = 2

    def __check_init__(self) -> None:
        require_markers(self.kind, self.markers, 2, 0)

    def invariants(self, x: Array) -> Array:
        """Squared distance [m^2]."""
        return _square(x)

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return 0.5 * self.stiffness * (invariants[0] - self.length**2) ** 2


class NonlinearSpring(Potential):
    """Spring between two points with any energy of its length.

    Attributes:
        markers: two points.
        law: function of the distance [m] to the energy [J], in jax.numpy.
    """

    law: Any = eqx.field(kw_only=True)

    kind: ClassVar[str] = "nonlinear spring"
    couples: ClassVar[bool] = True

    def __check_init__(self) -> None:
        require_markers(self.kind, self.markers, 2, 0)

    def invariants(self, x: Array) -> Array:
        """Squared distance [m^2]."""
        return _square(x)

    def energy(self, invariants: Array) -> Array:
        """Energy [J]."""
        return self.law(safe_sqrt(invariants[0]))


class Damper(Force):
    """Viscous damper along the line between two points: force c d|u|/dt; keeps momentum and angular momentum.

    Attributes:
        markers: two points.
        damping: c [N s/m].
    """

    damping: Any = eqx.field(kw_only=True)

    kind: ClassVar[str] = "damper"
    couples: ClassVar[bool] = True

    def __check_init__(self) -> None:
        require_markers(self.kind, self.markers, 2, 0)

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Equal and opposite forces along the mid-point line."""
        u = x[1] - x[0]
        direction = safe_divide(u, safe_norm(u)[None])
        force = self.damping * dot(direction, rate[1] - rate[0]) * direction
        return Load(jnp.stack([force, -force]), None)
