"""Hyperelastic laws of what is reinforced by fibres."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.numeric import Directions, Number
from natcoord_jax.effects.hyperelastic import ClosedHyperelastic, Tensors
from natcoord_jax.effects.materials import POISSON
from natcoord_jax.effects.rubber import NeoHooke
from natcoord_jax.maths.symmetric import PAIRS, contracted


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
