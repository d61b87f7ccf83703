"""What a scene needs to know of a body."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.eager_numpy import eager_numpy

TRIAD, DIRECTOR, POINT = (0, 1, 2), (1, 2), ()
"""Axes about which nodes turn."""


class Body(eqx.Module):
    """Rows and mass of a body in its assembled pose.

    Attributes:
        mass_block: m (4, 4) = [[M, e^T], [e, E]] (15).
        position: reference point phi [m].
        rotation: directors as columns [-].
        velocity: of the reference point [m/s].
        angular_velocity: world components [rad/s].
        rotations: axes of its own about which it turns: all of a body, none of a point mass, and those normal
            to the first of a director.
        shape: what to draw: something with a `surface`, or None.
        name: name, or None.
    """

    mass_block: Float[Array, "4 4"]
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    angular_velocity: Float[Array, "3"]
    rotations: tuple[int, ...] = eqx.field(static=True)
    shape: Any
    name: str | None = eqx.field(static=True)

    @property
    def oriented(self) -> bool:
        """Whether it is a body that turns about all axes."""
        return self.rotations == TRIAD


@eager_numpy
def mass_block(mass: Float[Array, ""], centre: Float[Array, " k"], moment: Float[Array, "k k"]) -> Array:
    """Mass block (15) of a body, k = 3, or of a section of a beam, k = 2.

    Args:
        mass: or mass per length [kg or kg/m].
        centre: centre of mass from the reference point [m].
        moment: second moment about the reference point [kg m^2 or kg m].
    """
    first = mass * centre
    return jnp.block([[mass[None, None], first[None]], [first[:, None], moment]])
