"""What a scene needs to know of a body."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Body(eqx.Module):
    """Rows and mass of a body in its assembled pose.

    Attributes:
        mass_block: m (4, 4) = [[M, e^T], [e, E]] (15).
        position: reference point phi [m].
        rotation: directors as columns [-].
        velocity: of the reference point [m/s].
        angular_velocity: world components [rad/s].
        oriented: False for a point mass, which has no orientation and no free rotations.
        shape: what to draw, or None.
        name: name, or None.
    """

    mass_block: Float[Array, "4 4"]
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    angular_velocity: Float[Array, "3"]
    oriented: bool = eqx.field(static=True)
    shape: Any
    name: str | None = eqx.field(static=True)

    def rows(self) -> Float[Array, "4 3"]:
        """Reference point and directors."""
        return jnp.concatenate([self.position[None], self.rotation.T])

    def row_velocities(self) -> Float[Array, "4 3"]:
        """Velocities of the rows."""
        turning = jnp.cross(self.angular_velocity[None], self.rotation.T)
        return jnp.concatenate([self.velocity[None], turning])
