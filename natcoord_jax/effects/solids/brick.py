"""A solid element of eight points, of a Saint Venant-Kirchhoff material.

The strains of Green and Lagrange at the eight Gauss points are quadratic in the coordinates of the nodes, and
the energy is a quadratic function of them with a constant matrix. Nine enhanced strains that keep it from
locking in bending (Klinkel and Wagner, Int. J. Numer. Methods Eng. 40, 1997) are condensed into that matrix
once: the material is linear in the strain, so that they depend linearly on it.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.vectors import cross

CORNERS = np.array([(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)], float)
CORNERS = np.concatenate([CORNERS, CORNERS * np.array([1, 1, -1])])
"""Natural coordinates of the nodes."""
POINTS = CORNERS / np.sqrt(3.0)
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Components of strains; those of two axes count twice."""
ENHANCED = ((0, 0), (1, 1), (2, 2), (3, 0), (3, 1), (4, 1), (4, 2), (5, 0), (5, 2))
"""Component of each enhanced strain, and the natural coordinate that it is linear in."""


def _slopes(at: np.ndarray) -> Float[np.ndarray, "8 3"]:
    """Derivatives of the shape functions of the nodes by the natural coordinates."""
    factors = 1 + CORNERS * at
    return np.stack([CORNERS[:, k] * np.prod(np.delete(factors, k, 1), axis=1) / 8 for k in range(3)], axis=1)


SLOPES = np.stack([_slopes(at) for at in POINTS])
CENTRE = _slopes(np.zeros(3))


def _inverse(jacobian: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
    """Inverse and determinant; by formulas, thousands at once."""
    a, b, c = jacobian.T
    rows = jnp.stack([cross(b, c), cross(c, a), cross(a, b)])
    volume = a @ rows[0]
    return rows / volume, volume


def _strains(inverse: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    """From natural to Cartesian strains, with the derivatives of the natural coordinates by the place."""
    rows = []
    for i, j in PAIRS:
        row = [inverse[k, i] * inverse[m, j] + inverse[m, i] * inverse[k, j] * (k != m) for k, m in PAIRS]
        halves = [0.5 if k != m else 1.0 for k, m in PAIRS]
        rows.append(jnp.stack([x * half for x, half in zip(row, halves)]) * (1.0 if i == j else 2.0))
    return jnp.stack(rows)


class Brick(Potential):
    """A hexahedron of eight points, of a Saint Venant-Kirchhoff material, stress-free as assembled.

    Attributes:
        markers: the eight nodes: four in turn round one face, then those above them.
        E: Young's modulus [N/m^2].
        nu: Poisson's ratio [-], below 1/2.
        gradients: derivatives of the shape functions at the Gauss points [1/m], made at compile.
        stiffness: made at compile.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(8)))
    E: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    nu: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))
    gradients: Any = eqx.field(default=None, init=False)
    stiffness: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "brick"
    degree: ClassVar[int | None] = 2
    together: ClassVar[bool] = True
    faces: ClassVar[tuple[tuple[int, ...], ...]] = (
        (0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7),
    )  # fmt: skip

    def assembled_at(self, x: Float[Array, "8 3"]) -> "Brick":
        """With the gradients and the stiffness of the assembled pose."""
        first, second = self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu)), self.E / (2 * (1 + self.nu))
        unit = jnp.diag(jnp.array([2.0, 2, 2, 1, 1, 1]))
        law = second * unit + first * jnp.zeros((6, 6)).at[:3, :3].set(1.0)
        centre = x.T @ CENTRE
        inverse, size = _inverse(centre)
        turned = _strains(inverse)
        gradients, blocks, mixed, soft = [], [], [], jnp.zeros((9, 9))
        for slopes, at in zip(SLOPES, POINTS):
            jacobian = x.T @ slopes
            inverse, volume = _inverse(jacobian)
            gradients.append(slopes @ inverse)
            modes = np.zeros((6, 9))
            for k, (component, axis) in enumerate(ENHANCED):
                modes[component, k] = at[axis]
            enhanced = size / volume * turned @ modes
            blocks.append(volume * law)
            mixed.append(volume * law @ enhanced)
            soft = soft + volume * enhanced.T @ law @ enhanced
        stiffness = jnp.zeros((48, 48))
        for k, block in enumerate(blocks):
            stiffness = stiffness.at[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].set(block)
        mixed = jnp.concatenate(mixed)
        stiffness = stiffness - mixed @ definite_inverse(soft) @ mixed.T
        return replace_fields(self, gradients=jnp.stack(gradients), stiffness=stiffness)

    def invariants(self, x: Float[Array, "8 3 *n"]) -> Float[Array, "48 *n"]:
        """Strains of Green and Lagrange at the Gauss points [-]."""
        # Deformation gradients: (point, axis, component of place).
        f = jnp.sum(self.gradients[:, :, :, None] * x[None, :, None], axis=1)
        found = []
        for i, j in PAIRS:
            product = jnp.sum(f[:, i] * f[:, j], axis=1)
            found.append(0.5 * (product - 1.0) if i == j else product)
        whole = jnp.stack(found, axis=1)
        return whole.reshape(48, *whole.shape[2:])

    def energy(self, invariants: Float[Array, "48 *n"]) -> Float[Array, "*n"]:
        """Energy [J]."""
        return 0.5 * jnp.sum(invariants * self.slope(invariants), axis=0)

    def slope(self, invariants: Float[Array, "48 *n"]) -> Float[Array, "48 *n"]:
        """Stresses times volumes [J]."""
        return jnp.sum(self.stiffness * invariants[None], axis=1)

    def energy_curvature(self, invariants: Float[Array, " p"]) -> Float[Array, "p p"]:
        """The constant stiffness."""
        return self.stiffness
