"""The two-node beam element: strains from the relative motion of its end frames.

The frames (x, d_1, d_2, d_3) at both ends, d_3 along the tangent, give invariants that are quadratic and
frame-indifferent: of the relative rotation R_ij = d_i^A . d_j^B and the relative place d_i^A . (x^B - x^A).
Their logarithm as a rigid motion is the strain of a piece of constant strain (a helix), so that pure
bending, torsion, stretch and shear are exact with any number of elements and none of them locks another.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.effects.beams.readings import BeamReadings
from natcoord_jax.maths.rotations import logarithm_of_motion


def relative_motion(x: Float[Array, "2 4 3"]) -> Float[Array, "7"]:
    """Relative rotation and place of two frames.

    Of R_ij = d_i^A . d_j^B the axial part 2 sin(angle) n and the trace, and s_i = d_i^A . (x^B - x^A) [m].
    """
    first, second = x[0], x[1]
    turned = jnp.sum(first[1:, None] * second[None, 1:], axis=-1)
    axial = jnp.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    trace = turned[0, 0] + turned[1, 1] + turned[2, 2]
    place = jnp.sum(first[1:] * (second[0] - first[0]), axis=-1)
    return jnp.concatenate([axial, trace[None], place])


def strains_of(invariants: Float[Array, "7"], length: Float[Array, ""]) -> Float[Array, "6"]:
    """Stretch and shear (1 + strain along d_3) [-] and curvature [1/m] from the relative motion.

    From the helicoidal interpolation of Sonneville, Cardona & Bruls, Geometrically exact beam finite element
    formulated on the special Euclidean group SE(3) (2014), written in invariants.
    """
    turn, shift = logarithm_of_motion(invariants[:3], invariants[3], invariants[4:])
    return jnp.concatenate([shift, turn]) / length


class BeamElement(Potential):
    """Linearly elastic beam between two frames: energy l e . C e / 2 of the strains e = (Gamma, K).

    Attributes:
        markers: two attachments, the third axis along the tangent.
        length: l, of the unstressed piece of the reference curve [m].
        reference: strains (1 + Gamma, K) of the unstressed shape, shape (6,) [-, 1/m]; (0, 0, 1, 0, 0, 0)
            for a straight one.
        stiffness: C, shape (6, 6) [N, N m, N m^2], for (Gamma_1, Gamma_2, Gamma_3, K_1, K_2, K_3).

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> ends = [nc.Attachment(nc.ground, (0, 0, z), np.eye(3)) for z in (0.0, 1.0)]
        >>> stiffness = np.diag([1e4, 1e4, 1e5, 10.0, 10.0, 8.0])
        >>> element = nc.BeamElement(ends, length=1.0, stiffness=stiffness)
    """

    length: Any = eqx.field(kw_only=True)
    stiffness: Any = eqx.field(kw_only=True)
    reference: Any = eqx.field(default=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0), kw_only=True, converter=jnp.asarray)

    kind: ClassVar[str] = "beam element"
    couples: ClassVar[bool] = True
    silent: ClassVar[bool] = False

    def invariants(self, x: Array) -> Array:
        """Relative rotation [-] and place [m] of the second frame in the first."""
        return relative_motion(x)

    def readings(self, place: Array, rows: Array) -> BeamReadings:
        """Strains and section forces."""
        invariants = self.invariants(place_markers(place, rows))
        strains = self.strains(invariants)
        return BeamReadings(strains, self.resultants(strains), self.energy(invariants))

    def strains(self, invariants: Float[Array, "7"]) -> Float[Array, "6"]:
        """Strains Gamma [-] and K [1/m], zero in the unstressed shape."""
        return strains_of(invariants, self.length) - self.reference

    def resultants(self, strains: Float[Array, "6"]) -> Float[Array, "6"]:
        """Section forces [N] and moments [N m] about the axes of the section."""
        return jnp.sum(self.stiffness * strains, axis=-1)

    def energy(self, invariants: Array) -> Array:
        """Strain energy [J]."""
        strains = self.strains(invariants)
        return 0.5 * self.length * jnp.sum(strains * self.resultants(strains))


class NonlinearBeamElement(BeamElement):
    """Beam between two frames with any energy of its strains, on top of the linear one.

    Attributes:
        markers: two attachments, the third axis along the tangent.
        length: of the unstressed piece [m].
        stiffness: shape (6, 6), of the linear part; zeros for none.
        reference: strains of the unstressed shape (6,).
        law: function of the strains (Gamma, K), shape (6,), to the energy per length [J/m], in jax.numpy.
    """

    law: Callable[[Array], Array] = eqx.field(kw_only=True)

    kind: ClassVar[str] = "nonlinear beam element"

    def resultants(self, strains: Float[Array, "6"]) -> Float[Array, "6"]:
        """Section forces [N] and moments [N m]: gradient of the energy per length."""
        return super().resultants(strains) + jax.grad(self.law)(strains)

    def energy(self, invariants: Array) -> Array:
        """Strain energy [J]."""
        return super().energy(invariants) + self.length * self.law(self.strains(invariants))


class BeamDamping(Force):
    """Internal damping of a beam element: section forces C_v de/dt of the strain rates.

    It sees strains only, so that rigid motions are not damped and momentum and angular momentum are kept.

    Attributes:
        markers: two attachments, those of the element.
        length: of the unstressed piece [m].
        viscosity: C_v, shape (6, 6) [N s, N m s, N m^2 s]; Rayleigh-like damping takes a time times the
            stiffness.
    """

    length: Any = eqx.field(kw_only=True)
    viscosity: Any = eqx.field(kw_only=True)

    kind: ClassVar[str] = "beam damping"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Forces -l (de/dx)^T C_v de/dt on the frames."""

        def strains(x: Array) -> Array:
            return strains_of(relative_motion(x), self.length)

        speed = jax.jvp(strains, (x,), (rate,))[1]
        pulled = jax.vjp(strains, x)[1](self.viscosity @ speed)[0]
        return Load(-self.length * pulled, None)
