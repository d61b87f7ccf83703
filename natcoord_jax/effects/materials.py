"""Elastic materials of shells and solids."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.kinds import Choice
from natcoord_jax.core.numeric import Number

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
