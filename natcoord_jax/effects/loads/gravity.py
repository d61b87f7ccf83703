"""Uniform gravity."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.force import Field
from natcoord_jax.core.numeric import COMPONENTS


class Gravity(Field):
    """Uniform gravity on every body of the scene.

    Attributes:
        vector: acceleration [m/s^2], shape (3,).

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    """

    vector: Any = eqx.field(default=(0.0, 0.0, -9.81), kw_only=True, metadata=is_a(COMPONENTS))

    kind: ClassVar[str] = "gravity"

    def acceleration(self) -> Array:
        """The vector."""
        return jnp.asarray(self.vector, float)
