"""Contact as an energy of the gap between two surfaces: it pushes where they overlap, and keeps the energy.

The gap is a function of invariants of the markers, so that energy, momentum and angular momentum are exact in
contact as everywhere. An overlap never holds more than the energy there is: the penetration is bounded by
that whatever the step. What impacts lose is a part of the force that grows with the speed at which the gap
closes; it is there only where a restitution is asked for.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.effects.contact.gap import GapEffect
from natcoord_jax.effects.contact.law import ContactLaw, closing_speed


class GapPotential(GapEffect, ContactLaw, Potential):
    """Contact by an energy of the gap between two surfaces, where they overlap.

    With a restitution, what impacts lose is the work in its account, which is never positive.

    Attributes:
        markers: that the gap is of.
        gap: between the surfaces, as `nc.SphereOnPlane(radius=0.1)`, or one of your own, see `nc.Gap`.
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".
        restitution: part of the closing speed that is left after an impact [-], above 0 up to 1; None: all.
        speed: of the impact that `restitution` is of [m/s].
        damping: part of the force per closing speed [s/m], follows from the two.

    Raises:
        ValueError: for other markers than the gap takes, a restitution above one, or one without the speed
            that it is of.

    Example:
        >>> import natcoord_jax as nc
        >>> floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> gap = nc.SphereOnPlane(radius=0.1)
        >>> contact = nc.GapPotential((*floor, nc.Point(nc.ground, (0, 0, 1))), gap, stiffness=1e5)
    """

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """That of the potential, and more of it where the gap closes; together they never pull."""
        found = super().respond(place, motion, now, lam)
        if self.damping is None:
            return found
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        flow = jax.vmap(lambda xi, vi: jax.jvp(self.invariants, (xi,), (vi,))[1])(x, rates)
        start: Any = self.invariants(place_markers(place, motion.start))
        factor = self.lossy(closing_speed(self.gap.distance, start, jnp.asarray(now.tableau.b) @ flow, now.h))
        forces: Any = found.forces
        given = found.power
        return replace_fields(found, forces=factor * forces, power=factor * given, released=given)

    def invariants(self, x: Float[Array, "k 3"]) -> Float[Array, " p"]:
        """Those of the gap."""
        return self.gap.invariants(x)

    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""
        return self.stored_at(self.gap.distance(invariants))

    def linearised(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> "GapPotential":
        """Itself: what is soft in the middle of a step may be stiff at its end."""
        return self
