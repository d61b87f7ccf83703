"""3-vectors as three arrays, one a component, for many instances at once.

Loops over a last axis of length three hold the compiler up: they are too short to run in lanes. Here the last
axis is that of the instances, and each operation is one long loop over them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Triple:
    """Components of 3-vectors, arrays that broadcast against each other.

    Example:
        >>> import jax.numpy as jnp
        >>> from natcoord_jax.maths.components import Triple
        >>> first = Triple.of(jnp.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
        >>> first.cross(Triple(0.0, 0.0, 1.0)).x
        Array([0., 1.], dtype=float64)
    """

    x: Any
    y: Any
    z: Any

    @classmethod
    def of(cls, rows: Float[Array, "3 *batch"]) -> "Triple":
        """Of an array whose first axis is that of the components."""
        return cls(rows[0], rows[1], rows[2])

    @property
    def parts(self) -> tuple[Any, Any, Any]:
        """The components."""
        return self.x, self.y, self.z

    def __add__(self, other: "Triple") -> "Triple":
        """Sum."""
        return Triple(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Triple") -> "Triple":
        """Difference."""
        return Triple(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Triple":
        """Opposite."""
        return Triple(-self.x, -self.y, -self.z)

    def __mul__(self, factor: Any) -> "Triple":
        """Product with a number for each instance."""
        return Triple(self.x * factor, self.y * factor, self.z * factor)

    __rmul__ = __mul__

    def dot(self, other: "Triple") -> Any:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Triple") -> "Triple":
        """Cross product."""
        return Triple(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )


def combination(factors: Sequence[Any], vectors: Sequence[Triple]) -> Triple:
    """Sum of vectors, each times a number."""
    total = vectors[0] * factors[0]
    for factor, vector in zip(factors[1:], vectors[1:]):
        total = total + vector * factor
    return total


def turned_midway(half_turn: Triple, start: Triple) -> Triple:
    """Mid-point vectors X of Cayley's rotation, X - half_turn x X = start; see `rotate_stages`."""
    scale = 1.0 / (1.0 + half_turn.dot(half_turn))
    return (start + half_turn.cross(start) + half_turn * half_turn.dot(start)) * scale


def rows_of(*vectors: Any) -> Float[Array, "rows *batch"]:
    """Components and scalars as rows of one array."""
    parts: list[Any] = []
    for vector in vectors:
        parts += vector.parts if isinstance(vector, Triple) else [vector]
    return jnp.stack(jnp.broadcast_arrays(*parts))


def products(a: Float[Array, "*n r k"], b: Float[Array, "*n k c"]) -> Float[Array, "*n r c"]:
    """Products of many small matrices, each operation one long loop over them."""
    a, b = jnp.moveaxis(a, (-2, -1), (0, 1)), jnp.moveaxis(b, (-2, -1), (0, 1))
    total = sum(a[:, k, None] * b[None, k] for k in range(a.shape[1]))
    return jnp.moveaxis(total, (0, 1), (-2, -1))
