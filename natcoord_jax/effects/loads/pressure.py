"""Pressure on the surfaces of shells and solids, as it follows them."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.maths.vectors import cross

XI, ETA = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the corners."""


def follower_loads(x: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Integrals of the shape functions times the normal of a quadrilateral [m^2], exact for a bilinear one.

    With phi_xi = a + c eta and phi_eta = b + c xi the normal is a x b + xi a x c + eta c x b, and the shape
    functions are (1 + xi_A xi) (1 + eta_A eta) / 4.
    """
    a, b, c = (0.25 * jnp.asarray(signs) @ x for signs in (XI, ETA, XI * ETA))
    across, one, other = cross(a, b), cross(a, c), cross(c, b)
    return across + (jnp.asarray(XI)[:, None] * one + jnp.asarray(ETA)[:, None] * other) / 3.0


class FacePressure(Force):
    """A pressure on a quadrilateral between four points, normal to it wherever it moves.

    Of a closed surface the forces and their moments cancel, at every step (the forces are those of the
    middle of the step).

    Attributes:
        markers: the corners in turn; the pressure pushes to the side from which they are seen clockwise, that
            is against the normal of a face of a solid, and against the directors of a shell.
        pressure: [N/m^2], or a function of time [s] to it.

    Example:
        >>> import natcoord_jax as nc
        >>> corners = tuple(nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)))
        >>> wind = nc.FacePressure(corners, pressure=500.0)
    """

    markers: Any = eqx.field(metadata=is_a(Markers(4)))
    pressure: Any = eqx.field(
        kw_only=True, metadata=is_a(Number() | FunctionOf("of time [s] to the pressure"))
    )

    kind: ClassVar[str] = "face pressure"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Against the normal."""
        pressure: Any = self.pressure(t) if callable(self.pressure) else self.pressure
        return Load(-pressure * follower_loads(x), None)
