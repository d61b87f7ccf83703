"""Hyperelastic materials of solids: an energy w(C, G, c) + U(J) of the right Cauchy-Green tensor.

C = F^T F, its cofactor G and its determinant c = J^2 are a cascade: G = C x C / 2 and c = G : C / 3 with the
tensor cross product. Along a step Delta G = C_m x Delta C and Delta c = (C_m x C_m + G_m) : Delta C / 3 with
means C_m and G_m, so that an energy changes by

    Delta w = S : Delta C / 2,  S = 2 [D_C w + D_G w x C_m + (D_c w + p / (J_0 + J_1)) (C_m x C_m + G_m) / 3],

p = Delta U / Delta J, wherever D_C w : Delta C + D_G w : Delta G + D_c w Delta c = Delta w, which products
and scalar quotients give (P. Betsch, A. Janz, C. Hesch, Comput. Methods Appl. Mech. Eng. 335 (2018) 660-696).
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.numeric import Number
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.symmetric import PAIRS, UNIT, cofactor, contracted, full, tensor_cross
from natcoord_jax.xla.materialise import materialised

CLOSE = 1e-3
"""Relative distance of two volumes up to which the quotient of their logarithms is a series."""


class Tensors(NamedTuple):
    """The cascade, by components.

    Attributes:
        C: right Cauchy-Green tensor [-].
        G: its cofactor.
        c: its determinant.
    """

    C: Float[Array, "6 *n"]
    G: Float[Array, "6 *n"]
    c: Float[Array, "*n"]


def tensors_of(strain: Float[Array, "6 *n"]) -> Tensors:
    """Of strains of Green and Lagrange 11, 22, 33, and the angles 12, 23, 13."""
    unit = jnp.reshape(jnp.array(UNIT, strain.dtype), (6, *(1,) * (strain.ndim - 1)))
    right = unit + strain * (1.0 + unit)
    # Each is an array of its own: fused into what follows, it would be worked out anew for each component.
    other = materialised(cofactor(right))
    return Tensors(right, other, materialised(contracted(other, right) / 3.0))


def log_quotient(a: Float[Array, "*n"], b: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """(ln b - ln a) / (b - a), also where they are equal."""
    x = (b - a) / a
    close = jnp.abs(x) < CLOSE
    away = jnp.where(close, 1.0, x)
    series = 1.0 - x * (1 / 2 - x * (1 / 3 - x * (1 / 4 - x * (1 / 5 - x / 6))))
    return jnp.where(close, series, jnp.log1p(away) / away) / a


class Hyperelastic(Part):
    """Base of materials of solids with an energy of your own: subclass it and give `energy`.

    Energy, momentum and angular momentum are kept exactly, whatever the law is: stresses are averages of its
    derivatives along a step. The energy must be a function that JAX can differentiate twice.

    Attributes:
        density: [kg/m^3].

    Class attributes:
        split: whether `energy` does not change when all lengths are stretched alike, so that all that a
            change of volume costs is in `volumetric`; elements for nearly incompressible materials need it.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import equinox as eqx, jax.numpy as jnp
        >>> class Gent(nc.Hyperelastic):
        ...     shear_modulus: float = eqx.field(default=1e5, kw_only=True)
        ...     bulk_modulus: float = eqx.field(default=1e6, kw_only=True)
        ...     split = True
        ...     def energy(self, C, G, c):
        ...         return -25.0 * self.shear_modulus * jnp.log1p(-(c ** (-1 / 3) * jnp.trace(C) - 3) / 50.0)
        ...     def volumetric(self, J):
        ...         return 0.5 * self.bulk_modulus * jnp.log(J) ** 2
        >>> scene = nc.Scene()
        >>> mesh = nc.mesh.box((1.0, 0.2, 0.2), (4, 1, 1), element="hexahedron27")
        >>> block = scene.add(nc.Solid(mesh, material=Gent(density=1100.0)))
    """

    density: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind = "material"
    split: ClassVar[bool] = False
    degree: ClassVar[int | None] = None

    @abc.abstractmethod
    def energy(self, C: Float[Array, "3 3"], G: Float[Array, "3 3"], c: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per volume in the pose without stress [J/m^3].

        Args:
            C: right Cauchy-Green tensor F^T F [-].
            G: its cofactor [-].
            c: its determinant [-].
        """

    def volumetric(self, J: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Energy per volume of a change of volume [J/m^3], of the ratio of the volumes [-]."""
        return jnp.zeros_like(J)

    def turned(self, rotation: Float[Array, "3 3"]) -> "Hyperelastic":
        """The material of a body that is put into the scene turned; isotropic: as it is."""
        return self

    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """`energy` of many points of one element (m,), or of many elements, whose axis is the last (m, n)."""
        given = full(tensors.C), full(tensors.G), tensors.c

        def points(law: "Hyperelastic", *given: Array) -> Array:
            return jax.vmap(lambda *x: law.energy(*x), in_axes=-1)(*given)

        if tensors.c.ndim == 1:
            return points(self, *given)
        return jax.vmap(points, in_axes=-1, out_axes=-1)(self, *given)

    def distortion_stress(
        self, start: Float[Array, "6 *n"], step: Float[Array, "6 *n"]
    ) -> Float[Array, "6 *n"]:
        """Stress of Piola and Kirchhoff whose work over a step is the change of `distortion` [N/m^2]."""

        def energy(strain: Array) -> Array:
            return self.distortion(tensors_of(strain))

        return averaged_gradient(energy, start, step[None], gauss(1), None)[0]

    def pressure(self, before: Float[Array, "*n"], after: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Change of `volumetric` by that of the ratio of volumes [N/m^2]."""
        found = averaged_gradient(
            lambda J: self.volumetric(J[0]), before[None], (after - before)[None, None], gauss(1), None
        )
        return found[0, 0]

    def energy_density(
        self, strain: Float[Array, "6 *n"], project: Callable[[Array], Array] = lambda J: J
    ) -> Float[Array, "*n"]:
        """Energy per volume [J/m^3] by strains, with ratios of volumes as a function smooths them."""
        tensors = tensors_of(strain)
        return self.distortion(tensors) + self.volumetric(project(jnp.sqrt(tensors.c)))

    def mean_stress(
        self,
        start: Float[Array, "6 *n"],
        step: Float[Array, "6 *n"],
        pressure: Float[Array, "*n"] | None = None,
    ) -> Float[Array, "6 *n"]:
        """Stress of Piola and Kirchhoff whose work over a step is the change of energy [N/m^2].

        Args:
            start: strains of Green and Lagrange at the start, shears as angles.
            step: their changes.
            pressure: of the change of volume; None: as it follows.
        """
        begun, ended = tensors_of(start), tensors_of(start + step)
        before, after = jnp.sqrt(begun.c), jnp.sqrt(ended.c)
        given = self.pressure(before, after) if pressure is None else pressure
        middle = 0.5 * (begun.C + ended.C)
        whole = tensor_cross(middle, middle) + 0.5 * (begun.G + ended.G)
        share = materialised(2.0 / 3.0 * given / (before + after))
        return self.distortion_stress(start, step) + share * whole


class ClosedHyperelastic(Hyperelastic):
    """Base of laws whose derivatives along a step are products and scalar quotients."""

    @abc.abstractmethod
    def distortion(self, tensors: Tensors) -> Float[Array, "*n"]:
        """Energy per volume [J/m^3]."""

    @abc.abstractmethod
    def quotients(self, begun: Tensors, ended: Tensors) -> tuple[Any, Any, Any]:
        """Tensors D_C and D_G by components (D_G None: zero), and D_c."""

    def energy(self, C: Array, G: Array, c: Array) -> Array:
        """Energy per volume in the pose without stress [J/m^3]."""
        first, second = np.array(PAIRS).T
        return self.distortion(Tensors(C[first, second], G[first, second], c))

    def distortion_stress(
        self, start: Float[Array, "6 *n"], step: Float[Array, "6 *n"]
    ) -> Float[Array, "6 *n"]:
        """By the cascade."""
        begun, ended = tensors_of(start), tensors_of(start + step)
        by_C, by_G, by_c = materialised(self.quotients(begun, ended))
        middle = 0.5 * (begun.C + ended.C)
        whole = tensor_cross(middle, middle) + 0.5 * (begun.G + ended.G)
        found = by_C + by_c / 3.0 * whole
        return 2.0 * (found if by_G is None else found + tensor_cross(by_G, middle))
