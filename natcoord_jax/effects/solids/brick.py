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
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.cells import CORNERS, SIDES
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.kinds import of
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Numbers
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.core.together import instances_last, place_together
from natcoord_jax.effects.materials import MASS, Elastic
from natcoord_jax.effects.solids.mass import consistent_mass
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.symmetric import PAIRS
from natcoord_jax.maths.vectors import cross, dot, safe_sqrt

POINTS = CORNERS / np.sqrt(3.0)
ENHANCED = ((0, 0), (1, 1), (2, 2), (3, 0), (3, 1), (4, 1), (4, 2), (5, 0), (5, 2))
"""Component of each enhanced strain, and the natural coordinate that it is linear in."""


def _slopes(at: np.ndarray) -> Float[np.ndarray, "8 3"]:
    """Derivatives of the shape functions of the nodes by the natural coordinates."""
    factors = 1 + CORNERS * at
    return np.stack([CORNERS[:, k] * np.prod(np.delete(factors, k, 1), axis=1) / 8 for k in range(3)], axis=1)


SLOPES = np.stack([_slopes(at) for at in POINTS])
SHAPES = np.array([np.prod(1 + CORNERS * at, axis=1) / 8 for at in POINTS])
"""Shape functions of the nodes at the Gauss points."""
CENTRE = _slopes(np.zeros(3))


def inverse_and_volume(jacobian: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
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


FLAT = 1e-12
"""Volume at a quadrature point, in cubes of the extent of an element, up to which that is flat."""


def is_degenerate(volumes: Float[Array, " n"], reference: Float[Array, "k 3"]) -> Bool[Array, ""]:
    """Whether any of the volumes at the quadrature points is none, or negative, or no number."""
    extent = jnp.max(jnp.max(reference, axis=0) - jnp.min(reference, axis=0))
    return ~(jnp.min(volumes) > FLAT * extent**3)


def smallest_volume_ratios(
    gradients: Float[Array, "n g k 3"], place: Array, rows: Array
) -> Float[Array, " n"]:
    """Smallest determinants of the deformation gradients of elements, see `Effect.volume_ratios`."""
    last, weights, rows = instances_last((gradients, place, rows))
    x = place_together(weights, rows)
    f = jnp.moveaxis(jnp.sum(last[:, :, :, None] * x[None, :, None], axis=1), -1, 1)
    return jnp.min(dot(f[:, :, 0], cross(f[:, :, 1], f[:, :, 2])), axis=0)


def von_mises(stress: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Equivalent stress; its derivative where there is no shear is zero."""
    away = stress - jnp.trace(stress) / 3.0 * jnp.eye(3)
    return safe_sqrt(1.5 * jnp.sum(away**2))


class SolidReadings(eqx.Module):
    """What goes on in an element of a solid, on average.

    Attributes:
        strain: of Green and Lagrange 11, 22, 33, and the angles 12, 23, 13, in the axes of the assembled
            pose [-].
        stress: of Cauchy (3, 3), in the axes of the world [N/m^2].
        von_mises: equivalent stress [N/m^2].
        energy: stored [J].
    """

    strain: Float[Array, "*t 6"]
    stress: Float[Array, "*t 3 3"]
    von_mises: Float[Array, "*t"]
    energy: Float[Array, "*t"]


class SolidPotential(Potential):
    """Base of elements of solids that are free of stress as assembled; a subclass has its `material`.

    Class attributes:
        listed: how its nodes are listed.
    """

    mass: str = eqx.field(default="lumped", kw_only=True, static=True, metadata=is_a(MASS))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 3))))
    gradients: Any = eqx.field(default=None, init=False)
    volumes: Any = eqx.field(default=None, init=False)

    together: ClassVar[bool] = True
    silent: ClassVar[bool] = False
    listed: ClassVar[str]

    def assembled_at(self, x: Float[Array, "k 3"]) -> Effect:
        """With the assembled pose as the one without stress, unless another is given."""
        return replace_fields(self, reference=x if self.reference is None else self.reference).renewed()

    def flaws(self) -> dict[str, Array]:
        """Corners that are no corners."""
        said = f"is degenerate or turned inside out: list {self.listed}"
        return {} if self.volumes is None else {said: is_degenerate(self.volumes, self.reference)}

    def volume_ratios(self, place: Array, rows: Array) -> Float[Array, " n"]:
        """Smallest of the quadrature points of each of `n` elements."""
        return smallest_volume_ratios(self.gradients, place, rows)

    def strains(self, x: Float[Array, "k 3 *n"]) -> list[Float[Array, "g *n"]]:
        """Those of Green and Lagrange at the quadrature points, component by component [-]."""
        # Deformation gradients: (point, axis, component of place).
        f = jnp.sum(self.gradients[:, :, :, None] * x[None, :, None], axis=1)
        found = []
        for i, j in PAIRS:
            product = jnp.sum(f[:, i] * f[:, j], axis=1)
            found.append(0.5 * (product - 1.0) if i == j else product)
        return found


class Brick(SolidPotential):
    """A hexahedron of eight points, of a Saint Venant-Kirchhoff material, stress-free as assembled.

    Attributes:
        markers: the eight nodes: four in turn round one face, then those above them.
        material: as `nc.Elastic`.
        mass: "lumped" at the nodes, or "consistent": between them, too, that of the interpolated motion.
        reference: points (8, 3) without stress [m]; None: those of the assembled pose.
        gradients: derivatives of the shape functions at the Gauss points [1/m], follow from the others.
        stiffness: by the strains there [J], follows from the others.
        volumes: of the Gauss points [m^3], follow from the others.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> corners = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        >>> nodes = scene.add(nc.Nodes.points(np.array(corners, float)))
        >>> rubber = nc.Elastic(E=1e6, nu=0.4, density=1100.0)
        >>> cube = scene.add(nc.Brick.on(nodes, [range(8)], material=rubber))
        >>> float(scene.compile()[0].mass[:, 0, 0].sum().round(6))
        1100.0
    """

    markers: Any = eqx.field(metadata=is_a(Markers(8)))
    material: Any = eqx.field(kw_only=True, metadata=is_a(of("a material, as nc.Elastic(...)", Elastic)))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((8, 3))))
    stiffness: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "brick"
    degree: ClassVar[int | None] = 2
    derived: ClassVar[tuple[str, ...]] = ("gradients", "stiffness", "volumes")
    faces: ClassVar[tuple[tuple[int, ...], ...]] = SIDES
    listed: ClassVar[str] = "four nodes in turn round one face, then those above"

    def renewed(self) -> "Brick":
        """With the gradients and the stiffness of the pose without stress."""
        x, law = self.reference, self.material.stiffness()
        inverse, size = inverse_and_volume(x.T @ CENTRE)
        turned = _strains(inverse)
        gradients, volumes, blocks, mixed, soft = [], [], [], [], jnp.zeros((9, 9))
        for slopes, at in zip(SLOPES, POINTS):
            inverse, volume = inverse_and_volume(x.T @ slopes)
            gradients.append(slopes @ inverse)
            volumes.append(volume)
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
        found = {"gradients": jnp.stack(gradients), "volumes": jnp.stack(volumes), "stiffness": stiffness}
        return replace_fields(self, **found)

    def mass_matrix(self) -> Float[Array, "8 *m"]:
        """Of the points [kg]."""
        if self.mass == "consistent":
            return consistent_mass(8, self.reference, self.material.density)
        return self.material.density * (SHAPES.T @ self.volumes)

    def invariants(self, x: Float[Array, "8 3 *n"]) -> Float[Array, "48 *n"]:
        """Strains of Green and Lagrange at the Gauss points [-]."""
        whole = jnp.stack(self.strains(x), axis=1)
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

    def readings(self, place: Array, rows: Array) -> SolidReadings:
        """Strains and stresses on average over the element."""
        x = place_markers(place, rows)
        found = self.invariants(x)
        strain = self.volumes @ found.reshape(8, 6) / jnp.sum(self.volumes)
        xx, yy, zz, xy, yz, xz = jnp.sum(self.slope(found).reshape(8, 6), axis=0) / jnp.sum(self.volumes)
        pulled = jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])
        deformation = x.T @ (self.volumes @ self.gradients.reshape(8, -1)).reshape(8, 3)
        deformation = deformation / jnp.sum(self.volumes)
        volume = deformation[:, 0] @ cross(deformation[:, 1], deformation[:, 2])
        stress = deformation @ pulled @ deformation.T / volume
        return SolidReadings(strain, stress, von_mises(stress), self.energy(found))
