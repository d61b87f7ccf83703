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

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.numeric import Definite, Number, Numbers, Vector
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.together import chunked
from natcoord_jax.effects.beams.directors import BeamReadings
from natcoord_jax.effects.beams.logarithm import Logarithm
from natcoord_jax.effects.beams.pairs import Expanded, tangents_of_pairs
from natcoord_jax.maths.components import Triple, combination, rows_of
from natcoord_jax.maths.rotations import logarithm_of_motion
from natcoord_jax.xla.materialise import materialised

LAW = FunctionOf("of the strains (6,) to the energy per length [J/m]")

Frame = tuple[Triple, tuple[Triple, Triple, Triple]]
"""A point and three directors."""


def frame_of(x: Float[Array, "4 3 *n"]) -> Frame:
    """Point and directors from an array."""
    return Triple.of(x[0]), (Triple.of(x[1]), Triple.of(x[2]), Triple.of(x[3]))


def relative_motion(x: Float[Array, "2 4 3 *n"]) -> Float[Array, "7 *n"]:
    """Relative rotation and place of two frames.

    Of R_ij = d_i^A . d_j^B the axial part 2 sin(angle) n and the trace, and s_i = d_i^A . (x^B - x^A) [m].
    """
    (start, (a1, a2, a3)), (end, (b1, b2, b3)) = frame_of(x[0]), frame_of(x[1])
    apart = end - start
    axial = Triple(a3.dot(b2) - a2.dot(b3), a1.dot(b3) - a3.dot(b1), a2.dot(b1) - a1.dot(b2))
    trace = a1.dot(b1) + a2.dot(b2) + a3.dot(b3)
    return rows_of(axial, trace, a1.dot(apart), a2.dot(apart), a3.dot(apart))


def pulled_back(x: Float[Array, "2 4 3 *n"], gradient: Float[Array, "7 *n"]) -> Float[Array, "2 4 3 *n"]:
    """Gradient by points and directors from that by `relative_motion`."""
    (start, first), (end, second) = frame_of(x[0]), frame_of(x[1])
    (w1, w2, w3), trace, by_place = gradient[:3], gradient[3], gradient[4:]
    apart, force = end - start, combination(list(by_place), first)
    # Gradient by R_ij: the trace on the diagonal, else the axial part.
    by_turned = ((trace, -w3, w2), (w3, trace, -w1), (-w2, w1, trace))
    on_first = [combination((*row, s), (*second, apart)) for row, s in zip(by_turned, by_place)]
    on_second = [combination(column, first) for column in zip(*by_turned)]
    return rows_of(-force, *on_first, force, *on_second).reshape(x.shape)


def strains_of(invariants: Float[Array, "7 *n"], length: Float[Array, "*n"]) -> Float[Array, "6 *n"]:
    """Stretch and shear (1 + strain along d_3) [-] and curvature [1/m] from the relative motion.

    From the helicoidal interpolation of Sonneville, Cardona & Bruls, Geometrically exact beam finite element
    formulated on the special Euclidean group SE(3) (2014), written in invariants.
    """
    axial, trace, place = Triple.of(invariants[:3]), invariants[3], Triple.of(invariants[4:])
    turn, shift = logarithm_of_motion(axial, trace, place)
    return rows_of(shift, turn) / length


class BeamElement(Expanded):
    """Linearly elastic beam between two frames: energy l e . C e / 2 of the strains e = (Gamma, K).

    The frames must stay less than half a turn apart: at half a turn the strain has no direction and is not a
    number, beyond it is that of the rest of a turn.

    Attributes:
        markers: two attachments, the third axis along the tangent.
        length: l, of the unstressed piece of the reference curve [m].
        reference: strains (1 + Gamma, K) of the unstressed shape, shape (6,) [-, 1/m]; (0, 0, 1, 0, 0, 0)
            for a straight one.
        stiffness: C, shape (6, 6) [N, N m, N m^2], for (Gamma_1, Gamma_2, Gamma_3, K_1, K_2, K_3).
        inertia: mass of the points and directors of both frames (2, 4, 2, 4) [kg, kg m, kg m^2], which
            couples them; None: what the frames sit on has it.

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> ends = [nc.Attachment(nc.ground, (0, 0, z), np.eye(3)) for z in (0.0, 1.0)]
        >>> stiffness = np.diag([1e4, 1e4, 1e5, 10.0, 10.0, 8.0])
        >>> element = nc.BeamElement(ends, length=1.0, stiffness=stiffness)
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=2)))
    length: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Definite((6, 6))))
    reference: Any = eqx.field(
        default=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0), kw_only=True, converter=as_array, metadata=is_a(Vector(6))
    )
    inertia: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((2, 4, 2, 4))))

    kind: ClassVar[str] = "beam element"
    couples: ClassVar[bool] = True
    silent: ClassVar[bool] = False
    together: ClassVar[bool] = True
    points: ClassVar[int | None] = 2
    units: ClassVar[tuple[int, ...] | None] = (4, 3)

    def mass_matrix(self) -> Float[Array, "2 4 2 4"] | None:
        """Of the frames."""
        return self.inertia

    def invariants(self, x: Array) -> Array:
        """Relative rotation [-] and place [m] of the second frame in the first."""
        return relative_motion(x)

    def pulled_back(self, x: Array, gradient: Array) -> Array:
        """Gradient by points and directors from that by the invariants."""
        return pulled_back(x, gradient)

    def readings(self, place: Array, rows: Array) -> BeamReadings:
        """Strains and section forces."""
        invariants = self.invariants(place_markers(place, rows))
        strains = self.strains(invariants)
        return BeamReadings(strains, self.resultants(strains), self.energy(invariants))

    def strains(self, invariants: Float[Array, "7 *n"]) -> Float[Array, "6 *n"]:
        """Strains Gamma [-] and K [1/m], zero in the unstressed shape."""
        return strains_of(invariants, self.length) - self.reference

    def resultants(self, strains: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
        """Section forces [N] and moments [N m] about the axes of the section."""
        return jnp.sum(self.stiffness * strains, axis=1)

    def energy(self, invariants: Array) -> Array:
        """Strain energy [J]."""
        strains = self.strains(invariants)
        return 0.5 * self.length * jnp.sum(strains * BeamElement.resultants(self, strains), axis=0)

    def moduli(self, strains: Float[Array, "6 *n"]) -> Float[Array, "6 6 *n"]:
        """Derivatives of the resultants by the strains [N, N m, N m^2]."""
        return jnp.broadcast_to(self.stiffness, (6, *strains.shape))

    def slope(self, invariants: Float[Array, "7 *n"]) -> Float[Array, "7 *n"]:
        """Gradient of the energy by the invariants."""
        motion = Logarithm.of(invariants)
        return materialised(motion.gradient(self._resultants_at(motion)))

    def energy_curvature(self, invariants: Float[Array, "7 *n"]) -> Float[Array, "7 7 *n"]:
        """Second derivatives of the energy by the invariants."""
        return self.expansion(invariants)[1]

    def expansion(self, invariants: Float[Array, "7 *n"]) -> tuple[Array, Array]:
        """Gradient and second derivatives of the energy by the invariants."""
        motion = Logarithm.of(invariants)
        resultants = self._resultants_at(motion)
        moduli = self.moduli(self._strains_at(motion)) / self.length
        return motion.gradient(resultants), motion.hessian(resultants, moduli)

    def _strains_at(self, motion: Logarithm) -> Float[Array, "6 *n"]:
        return rows_of(motion.shift, motion.turn) / self.length - self.reference

    def _resultants_at(self, motion: Logarithm) -> Float[Array, "6 *n"]:
        return materialised(self.resultants(materialised(self._strains_at(motion))))

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Array, *, turning: bool
    ) -> Array | None:
        """Derivatives of the wrenches by the twists for one stage; more are left to the general way."""
        if now.tableau.stages > 1:
            return None
        return chunked(tangents_of_pairs, self, place, motion, now)


class NonlinearBeamElement(BeamElement):
    """Beam between two frames with any energy of its strains, on top of the linear one.

    Attributes:
        markers: two attachments, the third axis along the tangent.
        length: of the unstressed piece [m].
        stiffness: shape (6, 6), of the linear part; zeros for none.
        reference: strains of the unstressed shape (6,).
        law: function of the strains (Gamma, K), shape (6,), to the energy per length [J/m], in jax.numpy.
    """

    law: Callable[[Array], Array] = eqx.field(kw_only=True, metadata=is_a(LAW))

    kind: ClassVar[str] = "nonlinear beam element"

    def resultants(self, strains: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
        """Section forces [N] and moments [N m]: gradient of the energy per length."""
        return super().resultants(strains) + self._of_each(jax.grad, strains)

    def moduli(self, strains: Float[Array, "6 *n"]) -> Float[Array, "6 6 *n"]:
        """Derivatives of the resultants by the strains [N, N m, N m^2]."""
        return super().moduli(strains) + self._of_each(jax.hessian, strains)

    def energy(self, invariants: Array) -> Array:
        """Strain energy [J]."""
        more = self._of_each(lambda law: law, self.strains(invariants))
        return super().energy(invariants) + self.length * more

    def _of_each(self, made: Callable[..., Any], strains: Float[Array, "6 *n"]) -> Float[Array, "*out"]:
        """What is made of the law at the strains of one element, or of many with a law each."""
        if strains.ndim == 1:
            return made(self.law)(strains)
        each = eqx.filter_vmap(lambda law, x: made(law)(x), in_axes=(eqx.if_array(-1), -1), out_axes=-1)
        return each(self.law, strains)


class BeamDamping(Force):
    """Internal damping of a beam element: section forces C_v de/dt of the strain rates.

    It sees strains only, so that rigid motions are not damped and momentum and angular momentum are kept.

    Attributes:
        markers: two attachments, those of the element.
        length: of the unstressed piece [m].
        viscosity: C_v, shape (6, 6) [N s, N m s, N m^2 s]; Rayleigh-like damping takes a time times the
            stiffness.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=2)))
    length: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    viscosity: Any = eqx.field(kw_only=True, metadata=is_a(Definite((6, 6))))

    kind: ClassVar[str] = "beam damping"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Forces -l (de/dx)^T C_v de/dt on the frames."""

        def strains(x: Array) -> Array:
            return strains_of(relative_motion(x), self.length)

        speed = jax.jvp(strains, (x,), (rate,))[1]
        pulled = jax.vjp(strains, x)[1](self.viscosity @ speed)[0]
        return Load(-self.length * pulled, None)
