"""Elastic materials of shells and solids, and plies of them."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.kinds import Choice, of
from natcoord_jax.core.numeric import Number, Numbers

MASS = Choice(("lumped", "consistent"))
"""How elements carry their mass."""
RUBBERY = ", as 0.4999 for rubber: at 1/2 no pressure would be enough to change the volume"
POISSON = Number(above=-1.0, below=0.5, instead=RUBBERY)
"""Poisson's ratio of shells and solids."""
SHEAR = 5.0 / 6.0
"""Shear coefficient of a homogeneous plate."""


class Sheet(eqx.Module):
    """What a layer of a material resists with, per area of its surface.

    Attributes:
        membrane: resultants by strains 11, 22, 12 [N/m].
        coupling: resultants by curvatures, and moments by strains [N].
        bending: moments by curvatures [N m].
        shear: by shears 13 and 23 [N/m].
        faces: stresses by strains at the sides against and along the director [N/m^2].
    """

    membrane: Float[Array, "3 3"]
    coupling: Float[Array, "3 3"]
    bending: Float[Array, "3 3"]
    shear: Float[Array, "2 2"]
    faces: Float[Array, "2 3 3"]

    def shifted(self, offset: Any) -> "Sheet":
        """The same about a surface from which the middle of the layer is at a distance along the director."""
        coupling = self.coupling + offset * self.membrane
        bending = self.bending + 2 * offset * self.coupling + offset**2 * self.membrane
        return Sheet(self.membrane, coupling, bending, self.shear, self.faces)


class Elastic(Part):
    """An isotropic material whose stresses are linear in the strains of Green and Lagrange.

    The law of Saint Venant and Kirchhoff: for any rotations, and for moderate strains; under strong
    compression it softens.

    Attributes:
        E: Young's modulus [N/m^2].
        nu: Poisson's ratio [-], between -1 and 1/2.
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> steel = nc.Elastic(E=210e9, nu=0.3, density=7850.0)
        >>> print(f"{steel.plane_stress()[0, 0]:.3e}")
        2.308e+11
    """

    E: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    nu: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(POISSON))
    density: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind = "material"
    split: ClassVar[bool] = False
    degree: ClassVar[int | None] = 2

    @property
    def shear_modulus(self) -> Any:
        """G [N/m^2]."""
        return self.E / (2 * (1 + self.nu))

    def stiffness(self) -> Float[Array, "6 6"]:
        """Stresses by strains 11, 22, 33, 12, 23, 13, shears as angles [N/m^2]."""
        first = self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))
        unit = jnp.diag(jnp.array([2.0, 2, 2, 1, 1, 1]))
        return self.shear_modulus * unit + first * jnp.zeros((6, 6)).at[:3, :3].set(1.0)

    def mean_stress(
        self, start: Float[Array, "6 *n"], step: Float[Array, "6 *n"], pressure: Any = None
    ) -> Float[Array, "6 *n"]:
        """Stress of Piola and Kirchhoff in the middle of a step of the strains, as of `nc.Hyperelastic`."""
        strain = start + 0.5 * step
        first = self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu)) * (strain[0] + strain[1] + strain[2])
        return self.shear_modulus * jnp.concatenate([2 * strain[:3], strain[3:]]) + jnp.concatenate(
            [jnp.broadcast_to(first, strain[:3].shape), jnp.zeros_like(strain[3:])]
        )

    def energy_density(self, strain: Float[Array, "6 *n"], project: Any = None) -> Float[Array, "*n"]:
        """Energy per volume [J/m^3], as of `nc.Hyperelastic`."""
        return 0.5 * jnp.sum(strain * self.mean_stress(strain, jnp.zeros_like(strain)), axis=0)

    def turned(self, rotation: Any) -> "Elastic":
        """As it is: all directions are alike."""
        return self

    def plane_stress(self) -> Float[Array, "3 3"]:
        """Stresses by strains 11, 22, 12 of a layer without stress across it [N/m^2]."""
        nu = self.nu
        plane = jnp.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0.5]])
        plane = plane + nu * jnp.array([[0, 1.0, 0], [1.0, 0, 0], [0, 0, -0.5]])
        return self.E / (1 - nu**2) * plane

    def sheet(self, thickness: Any) -> Sheet:
        """A layer of it."""
        h, plane = thickness, self.plane_stress()
        shear = h * self.transverse_shear()
        return Sheet(h * plane, jnp.zeros((3, 3)), h**3 / 12 * plane, shear, jnp.stack([plane, plane]))

    def transverse_shear(self) -> Float[Array, "2 2"]:
        """Mean shear stresses across a layer by shears 13 and 23, with the shear coefficient [N/m^2]."""
        return SHEAR * self.shear_modulus * jnp.eye(2)


class Orthotropic(Part):
    """A material with three planes of symmetry, in plane stress; for shells.

    Its axis 1 is along `direction` of the shell.

    Attributes:
        E1: Young's modulus along the first axis [N/m^2].
        E2: across it, in the surface [N/m^2].
        nu12: contraction along 2 where it is stretched along 1 [-]; E2 nu12^2 < E1.
        G12: shear modulus in the surface [N/m^2].
        G13: across it, along 1 [N/m^2]; default G12.
        G23: across it, along 2 [N/m^2]; default G12.
        density: [kg/m^3].

    Raises:
        ValueError: for a Poisson's ratio at which a stretch would cost no energy.

    Example:
        >>> import natcoord_jax as nc
        >>> ply = nc.Orthotropic(E1=140e9, E2=10e9, nu12=0.3, G12=5e9, density=1600.0)
        >>> print(f"{ply.plane_stress()[0, 0]:.3e}")
        1.409e+11
    """

    E1: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    E2: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    nu12: Any = eqx.field(kw_only=True, metadata=is_a(Number()))
    G12: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    G13: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    G23: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    density: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind = "material"

    def _excess(self) -> Any:
        return 1.0 - self.nu12**2 * self.E2 / self.E1

    def flaws(self) -> dict[str, Any]:
        """A stretch that gives energy."""
        said = "has nu12 [-] whose square is not below E1 / E2: a stretch would give energy"
        return {said: self._excess() <= 0.0}

    def plane_stress(self) -> Float[Array, "3 3"]:
        """Stresses by strains 11, 22, 12 of a layer without stress across it [N/m^2]."""
        first, second = self.E1 / self._excess(), self.E2 / self._excess()
        zero, mixed = jnp.zeros_like(first), self.nu12 * second
        rows = (first, mixed, zero), (mixed, second, zero), (zero, zero, self.G12)
        return jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in rows])

    def transverse_shear(self) -> Float[Array, "2 2"]:
        """Mean shear stresses across a layer by shears 13 and 23, with the shear coefficient [N/m^2]."""
        moduli = (self.G12 if g is None else g for g in (self.G13, self.G23))
        return SHEAR * jnp.diag(jnp.stack([jnp.asarray(g, float) for g in moduli]))

    sheet = Elastic.sheet


PLY = of("a material, as nc.Orthotropic(...) or nc.Elastic(...)", Elastic, Orthotropic)


class Laminate(Part):
    """Plies of one material in different directions, one on the other; for shells.

    Attributes:
        material: of the plies.
        angles: of their first axes from `direction` of the shell, about the director [rad]; from the side
            against the director on.
        fractions: of the thickness, for each ply [-]; default: all are as thick.

    Raises:
        ValueError: for fractions of another number, or that do not add up to one.

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> ply = nc.Orthotropic(E1=140e9, E2=10e9, nu12=0.3, G12=5e9, density=1600.0)
        >>> crossed = nc.Laminate(ply, angles=np.radians([0, 90]))
        >>> bool(abs(crossed.sheet(1e-3).coupling[0, 0]) > 0)
        True
    """

    material: Any = eqx.field(metadata=is_a(PLY))
    angles: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None,))))
    fractions: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None,), sign="positive")))

    kind = "material"

    @property
    def density(self) -> Any:
        """[kg/m^3]."""
        return self.material.density

    def flaws(self) -> dict[str, Any]:
        """Plies that do not fill the thickness.

        Raises:
            ValueError: for other numbers of fractions than of angles.
        """
        if self.fractions is None:
            return {}
        if np.shape(self.fractions) != np.shape(self.angles):
            raise ValueError(
                f"Laminate: fractions [-] has shape {np.shape(self.fractions)}; pass one for each of the "
                f"angles, {np.shape(self.angles)}"
            )
        said = "has fractions [-] of the thickness that do not add up to one; divide them by their sum"
        return {said: abs(sum(self.fractions) - 1.0) > 1e-9}

    def sheet(self, thickness: Any) -> Sheet:
        """All plies, with the middle of the thickness as the reference surface."""
        angles = jnp.asarray(self.angles, float)
        count = angles.shape[0]
        parts = jnp.full(count, 1.0 / count) if self.fractions is None else jnp.asarray(self.fractions, float)
        ends = thickness * (jnp.concatenate([jnp.zeros(1), jnp.cumsum(parts)]) - 0.5)
        plane, shear = self.material.plane_stress(), self.material.transverse_shear()
        turned = [_turned(plane, shear, angles[k]) for k in range(count)]
        planes, shears = (jnp.stack(x) for x in zip(*turned))
        moments = [(ends[1:] ** k - ends[:-1] ** k) / k for k in (1, 2, 3)]
        stretch, couple, bend = (jnp.einsum("k,kij->ij", m, planes) for m in moments)
        slide = jnp.einsum("k,kij->ij", moments[0], shears)
        return Sheet(stretch, couple, bend, slide, planes[jnp.array([0, -1])])


def _turned(
    plane: Float[Array, "3 3"], shear: Float[Array, "2 2"], angle: Float[Array, ""]
) -> tuple[Float[Array, "3 3"], Float[Array, "2 2"]]:
    """Stiffness along axes of which the material's are turned by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    strains = jnp.stack(
        [
            jnp.stack([c * c, s * s, c * s]),
            jnp.stack([s * s, c * c, -c * s]),
            jnp.stack([-2 * c * s, 2 * c * s, c * c - s * s]),
        ]
    )
    axes = jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])
    return strains.T @ plane @ strains, axes.T @ shear @ axes
