"""Contact by an energy of the gap, with friction: what pushes depends on the overlap, what rubs on that."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.potential import marker_response, place_markers
from natcoord_jax.effects.contact.friction import Rubbing
from natcoord_jax.effects.contact.law import ContactLaw


class FrictionalGapPotential(Rubbing, ContactLaw):
    """Contact by an energy of the gap where two surfaces overlap, as `nc.GapPotential`, with friction.

    The force along the normal N is that of the energy, so that this is exact; the force against slip is at
    most mu N, and what sticks is at rest, as with `nc.GapConstraint`. What friction and impacts lose is in
    its account. For schemes of one stage, `nc.EnergyMomentum()`.

    Attributes:
        markers: that the gap is of.
        gap: between the surfaces, which says where they touch, as `nc.SphereOnPlane(radius=0.1)`.
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".
        restitution: part of the closing speed that is left after an impact [-], above 0 up to 1; None: all.
        speed: of the impact that `restitution` is of [m/s].
        friction: coefficient mu [-].
        regularisation: of the velocity of slip [m/s]; None: see `nc.GapConstraint`.
        name: optional name.
        damping: part of the force per closing speed [s/m], follows from restitution and speed.
        mobility: change of the speed of closing by a unit impulse [1/kg], follows from the masses.

    Raises:
        ValueError: for other markers than the gap takes, a gap without a point of contact, a restitution
            above one, or one without the speed that it is of.

    Example:
        >>> import natcoord_jax as nc
        >>> floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> markers, gap = (*floor, nc.Point(nc.ground, (0, 0, 1))), nc.SphereOnPlane(radius=0.1)
        >>> contact = nc.FrictionalGapPotential(markers, gap, stiffness=1e5, friction=0.3)
    """

    kind: ClassVar[str] = "soft contact with friction"
    works: ClassVar[bool] = True

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """None: surfaces may overlap."""
        return jnp.zeros(1)

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The impulse along the normal is that of the energy's mean force, friction at most mu times it."""
        start, flow = self.gap.invariants(place_markers(place, motion.start)), self.flow(place, motion)
        gradient = self.gap.averaged(start, now.h * flow, now.tableau)
        before, closing = self.gap.distance(start), -jnp.sum(gradient * flow)
        elastic = now.h * self.mean_force(before, before - now.h * closing)
        # Where a contact is stiffer than the step is short, its equation is in terms of places.
        scale = 0.5 * self.mobility / (1.0 + 0.25 * self.mobility * self.stiffness * now.h**2)
        found = scale * (lam[0, 0] - self.lossy(closing) * elastic)
        forces, torques = self.pushing(place, motion, gradient, lam[:, 0]), None
        found = found[None, None]
        if self.friction is not None:
            rubbing, torques, missing = self.rubbing(place, motion, lam)
            forces, found = forces + rubbing, jnp.concatenate([found, missing], axis=1)
        rates = place_markers(place, motion.rates)
        response = marker_response(place, forces, torques, rates, motion)
        return replace_fields(response, rows=found, released=(-elastic * closing)[None])
