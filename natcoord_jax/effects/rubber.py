"""Hyperelastic laws of rubber and of what is reinforced by fibres."""

import operator
from functools import reduce
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.numeric import Directions, Number, Numbers
from natcoord_jax.effects.hyperelastic import ClosedHyperelastic, Hyperelastic, Tensors, log_quotient
from natcoord_jax.effects.materials import POISSON
from natcoord_jax.maths.matrix_logarithm import exponential_less_one, logarithm
from natcoord_jax.maths.symmetric import PAIRS, contracted, trace, unit_like


def _cubic(begun: Tensors, ended: Tensors) -> tuple[Array, Array, Array, Array]:
    """Cube roots of the determinants, the change of the first by c, and the mean of its inverse."""
    before, after = jnp.cbrt(begun.c), jnp.cbrt(ended.c)
    change = 1.0 / (before * before + before * after + after * after)
    return before, after, change, 0.5 * (1.0 / before + 1.0 / after)


class WithBulkModulus(Hyperelastic):
    """Base of laws with the energy K (J^2 - 1 - 2 ln J) / 4 of a change of volume, `bulk_modulus` K."""

    split: ClassVar[bool] = True

    @property
    def _bulk(self) -> Any:
        return self.bulk_modulus  # pyright: ignore[reportAttributeAccessIssue]

    def volumetric(self, J: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Energy per volume of a change of volume [J/m^3]."""
        return 0.25 * self._bulk * (J * J - 1.0 - 2.0 * jnp.log(J))

    def pressure(self, before: Float[Array, "*n"], after: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Its change by that of the ratio of volumes [N/m^2]."""
        return 0.25 * self._bulk * (before + after - 2.0 * log_quotient(before, after))


class NeoHooke(WithBulkModulus, ClosedHyperelastic):
    """Rubber whose chains resist stretch alone: mu/2 (J^(-2/3) tr C - 3) + K/4 (J^2 - 1 - 2 ln J).

    Attributes:
        E: Young's modulus at small strains [N/m^2].
        nu: Poisson's ratio at small strains [-], between -1 and 1/2, as 0.4999.
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> rubber = nc.NeoHooke(E=1.2675, nu=0.4999, density=1e-9)
        >>> print(f"{rubber.shear_modulus:.4f} {rubber.bulk_modulus:.1f}")
        0.4225 2112.5
    """

    E: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    nu: Any = eqx.field(kw_only=True, metadata=is_a(POISSON))

    @property
    def shear_modulus(self) -> Any:
        """Mu [N/m^2]."""
        return self.E / (2 * (1 + self.nu))

    @property
    def bulk_modulus(self) -> Any:
        """K [N/m^2]."""
        return self.E / (3 * (1 - 2 * self.nu))

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume of a change of shape [J/m^3]."""
        return 0.5 * self.shear_modulus * (trace(tensors.C) / jnp.cbrt(tensors.c) - 3.0)

    def quotients(self, begun: Tensors, ended: Tensors) -> tuple[Any, Any, Any]:
        """Of the product c^(-1/3) tr C."""
        before, after, change, inverse = _cubic(begun, ended)
        half = 0.5 * self.shear_modulus
        by_c = -0.5 * half * (trace(begun.C) + trace(ended.C)) * change / (before * after)
        return half * inverse * unit_like(begun.C), None, by_c


class MooneyRivlin(WithBulkModulus, ClosedHyperelastic):
    """Rubber: c10 (J^(-2/3) tr C - 3) + c01 (J^(-4/3) tr G - 3) + K/4 (J^2 - 1 - 2 ln J), G = cof C.

    Attributes:
        c10: [N/m^2], not negative.
        c01: [N/m^2], not negative; the shear modulus is 2 (c10 + c01).
        bulk_modulus: K [N/m^2].
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> rubber = nc.MooneyRivlin(c10=3e5, c01=1e5, bulk_modulus=4e7, density=1100.0)
    """

    c10: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    c01: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    bulk_modulus: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume of a change of shape [J/m^3]."""
        root = jnp.cbrt(tensors.c)
        first, second = trace(tensors.C) / root - 3.0, trace(tensors.G) / (root * root) - 3.0
        return self.c10 * first + self.c01 * second

    def quotients(self, begun: Tensors, ended: Tensors) -> tuple[Any, Any, Any]:
        """Of the products c^(-1/3) tr C and c^(-2/3) tr G."""
        before, after, change, inverse = _cubic(begun, ended)
        both = before * after
        squared = 0.5 * (1.0 / (before * before) + 1.0 / (after * after))
        by_c = self.c10 * (trace(begun.C) + trace(ended.C)) * change / both
        by_c = by_c + self.c01 * (trace(begun.G) + trace(ended.G)) * change * (before + after) / (both * both)
        unit = unit_like(begun.C)
        return self.c10 * inverse * unit, self.c01 * squared * unit, -0.5 * by_c


class CompressibleMooneyRivlin(ClosedHyperelastic):
    """Foam and soft tissue: c10 (tr C - 3) + c01 (tr G - 3) - (2 c10 + 4 c01) ln J + k/2 (J - 1)^2.

    P. G. Ciarlet, G. Geymonat, C. R. Acad. Sci. Paris 295 (1982) 423-426; polyconvex. Without k, Poisson's
    ratio at small strains is that of c10 and c01 alone: 1/4 for c01 = 0.

    Attributes:
        c10: [N/m^2], not negative.
        c01: [N/m^2], not negative; the shear modulus is 2 (c10 + c01).
        volume_stiffness: k [N/m^2].
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> foam = nc.CompressibleMooneyRivlin(c10=4e4, c01=1e4, density=200.0)
    """

    c10: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    c01: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    volume_stiffness: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume but that of the volume [J/m^3]."""
        return self.c10 * (trace(tensors.C) - 3.0) + self.c01 * (trace(tensors.G) - 3.0)

    def quotients(self, begun: Tensors, ended: Tensors) -> tuple[Any, Any, Any]:
        """Linear: the derivatives."""
        unit = unit_like(begun.C)
        return self.c10 * unit, self.c01 * unit, 0.0

    def volumetric(self, J: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Energy per volume of a change of volume [J/m^3]."""
        balance = 2.0 * self.c10 + 4.0 * self.c01
        return 0.5 * self.volume_stiffness * (J - 1.0) ** 2 - balance * jnp.log(J)

    def pressure(self, before: Float[Array, "*n"], after: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Its change by that of the ratio of volumes [N/m^2]."""
        balance = 2.0 * self.c10 + 4.0 * self.c01
        return self.volume_stiffness * (0.5 * (before + after) - 1.0) - balance * log_quotient(before, after)


class Ogden(WithBulkModulus):
    """Rubber: sum_p mu_p / alpha_p (l_1^alpha_p + l_2^alpha_p + l_3^alpha_p - 3) + K/4 (J^2 - 1 - 2 ln J).

    l_i are the principal stretches over J^(1/3). R. W. Ogden, Proc. R. Soc. Lond. A 326 (1972) 565-584.

    Attributes:
        moduli: mu_p [N/m^2], (p,).
        exponents: alpha_p [-], (p,), none zero; the shear modulus is half the sum of mu_p alpha_p.
        bulk_modulus: K [N/m^2].
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> law = dict(moduli=(6.3e5, 1.2e3, -1e4), exponents=(1.3, 5.0, -2.0))
        >>> rubber = nc.Ogden(**law, bulk_modulus=2e7, density=1100.0)
    """

    moduli: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None,))))
    exponents: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None,))))
    bulk_modulus: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))

    def flaws(self) -> dict[str, Any]:
        """Stiffnesses that are none.

        Raises:
            ValueError: for other numbers of moduli than of exponents.
        """
        if np.shape(self.moduli) != np.shape(self.exponents):
            raise ValueError(
                f"Ogden: moduli [N/m^2] has shape {np.shape(self.moduli)}, exponents [-] "
                f"{np.shape(self.exponents)}; pass as many of both"
            )
        terms = [(modulus * exponent, exponent) for modulus, exponent in zip(self.moduli, self.exponents)]
        missing = reduce(operator.or_, (exponent == 0 for _, exponent in terms), False)
        said = "has no shear modulus: the sum of moduli times exponents must be positive, no exponent zero"
        return {said: missing | (sum(product for product, _ in terms) <= 0)}

    energy = ClosedHyperelastic.energy  # pyright: ignore

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume of a change of shape [J/m^3]."""
        logarithms = logarithm(tensors.C / jnp.cbrt(tensors.c))
        total = jnp.zeros_like(tensors.c)
        for k in range(len(self.exponents)):
            modulus, exponent = self.moduli[k], self.exponents[k]
            total = total + modulus / exponent * trace(exponential_less_one(0.5 * exponent * logarithms))
        return total


class TransverselyIsotropic(ClosedHyperelastic):
    """A neo-Hookean matrix with fibres along one direction: the matrix's energy + k/8 (a . C a - 1)^2.

    The standard reinforcing model (G. Y. Qiu, T. J. Pence, J. Elasticity 49 (1997) 1-30); fibres resist
    compression as they do tension.

    Attributes:
        E: Young's modulus of the matrix at small strains [N/m^2].
        nu: its Poisson's ratio [-], between -1 and 1/2.
        fibre_stiffness: k, what the fibres add to Young's modulus along them [N/m^2].
        direction: of the fibres, in the axes of the mesh [-].
        density: [kg/m^3].

    Example:
        >>> import natcoord_jax as nc
        >>> gel = dict(E=1e6, nu=0.45, density=1100.0)
        >>> tendon = nc.TransverselyIsotropic(**gel, fibre_stiffness=2e7, direction=(1, 0, 0))
    """

    E: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    nu: Any = eqx.field(kw_only=True, metadata=is_a(POISSON))
    fibre_stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    direction: Any = eqx.field(kw_only=True, metadata=is_a(Directions()))

    @property
    def matrix(self) -> NeoHooke:
        """The material between the fibres."""
        # As a copy: the numbers may be those of many elements.
        return replace_fields(NeoHooke(E=1.0, nu=0.0), E=self.E, nu=self.nu, density=self.density)

    def turned(self, rotation: Float[Array, "3 3"]) -> "TransverselyIsotropic":
        """With fibres that are turned with the body."""
        return replace_fields(self, direction=rotation @ as_array(self.direction, float))

    def _fibre(self, like: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
        """The dyad of the direction, by components, with as many axes as another tensor."""
        a = jnp.stack([jnp.asarray(self.direction[k]) for k in range(3)])
        a = a / jnp.sqrt(jnp.sum(a * a, axis=0))
        dyad = jnp.stack([a[i] * a[j] for i, j in PAIRS])
        return dyad.reshape(6, *(1,) * (like.ndim - dyad.ndim), *dyad.shape[1:])

    def _stretch(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Squared, of the fibres."""
        return contracted(self._fibre(tensors.C), tensors.C)

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume but that of the volume [J/m^3]."""
        stretch = self._stretch(tensors) - 1.0
        return self.matrix.distortion(tensors) + self.fibre_stiffness / 8 * stretch * stretch

    def quotients(self, begun: Tensors, ended: Tensors) -> tuple[Any, Any, Any]:
        """Of the matrix, and of the square of a . C a - 1."""
        by_C, by_G, by_c = self.matrix.quotients(begun, ended)
        pull = self.fibre_stiffness / 8 * (self._stretch(begun) + self._stretch(ended) - 2.0)
        return by_C + pull * self._fibre(by_C), by_G, by_c

    def volumetric(self, J: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Energy per volume of a change of volume [J/m^3]."""
        return self.matrix.volumetric(J)

    def pressure(self, before: Float[Array, "*n"], after: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Its change by that of the ratio of volumes [N/m^2]."""
        return self.matrix.pressure(before, after)
