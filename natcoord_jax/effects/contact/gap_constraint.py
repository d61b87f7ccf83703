"""Contact as a constraint: a gap between two surfaces that does not become negative (65), (66)."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.constraint import FREE, RESTING
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import marker_response, place_markers
from natcoord_jax.effects.contact.friction import Rubbing
from natcoord_jax.effects.contact.law import NO_GIFT

RESTITUTION = Number("not negative", most=1.0, instead=NO_GIFT)


class GapReadings(eqx.Module):
    """What goes on in a contact that is a constraint.

    Attributes:
        gap: between the surfaces [m].
    """

    gap: Float[Array, "*t"]


class GapConstraint(Rubbing):
    """A gap between two surfaces that does not become negative, with impacts.

    Where it would, a force pushes the surfaces apart, along the gradient of the gap averaged over the step:
    they end the step touching, whatever its length, and momentum and angular momentum are exact. What that
    force takes from the motion an impact gives back at the end of the step, a part `restitution` of the
    speed, wherever in the step the surfaces met; with 1 energy is exact, too, for any number of impacts at
    once (`natcoord_jax.mechanics.impacts` has the law). What is lost is in its account.

    With friction a force of slip acts where the surfaces touch, f sqrt(|u|^2 + eps^2) = -mu N u of the
    velocity u with which the second slips on the first: at most mu N, and against it. At the end of a step
    slip that friction can stop is stopped, so that what sticks is at rest. Under a load that it holds a
    contact creeps, more slowly than eps, the regularisation.

    For schemes of one stage, `nc.EnergyMomentum()`. Derivatives are those of the program: where an impact
    falls within a step they are not those of the motion, unless the scheme locates impacts,
    `nc.EnergyMomentum(max_events=8)`.

    Attributes:
        markers: that the gap is of.
        gap: between the surfaces, as `nc.SphereOnPlane(radius=0.1)`, or one of your own, see `nc.Gap`.
        restitution: part of the closing speed that is left after an impact [-], from 0 to 1.
        friction: coefficient mu [-]; None: there is none.
        regularisation: eps [m/s]; None: 3e-6 of the speed that gravity gives along the size of the scene, and
            of the fastest body at the start.
        compliance: speed with which it gives way, in terms of that which its impulse makes [-]. Some 1e-9
            lets contacts that depend on each other, as the corners of a box, share a load evenly, where it
            would be left to the rounding of their places which of them carry it.
        name: optional name.
        mobility: change of the speed of closing by a unit impulse [1/kg], follows from the masses at compile;
            weighs gaps against impulses while a step is solved.

    Raises:
        ValueError: for other markers than the gap takes, a restitution above 1, and friction of a gap without
            a point of contact.

    Example:
        >>> import natcoord_jax as nc
        >>> floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
        >>> gap = nc.SphereOnPlane(radius=0.1)
        >>> contact = nc.GapConstraint((*floor, nc.Point(nc.ground, (0, 0, 1))), gap, restitution=0.5)
    """

    restitution: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(RESTITUTION))
    compliance: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "hard contact"
    bounces: ClassVar[bool] = True

    def quadratic(self, place: Array, rows: Array) -> Array:
        """The invariants of the gap."""
        return jnp.ravel(self.gap.invariants(place_markers(place, rows)))

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """How far the surfaces overlap, negative."""
        gap = self.gap_at(place, rows)
        return jnp.where(gap < 0, gap, 0.0)[None]

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The gap at the end of the step or the impulse, whichever is smaller, vanishes (66)."""
        start, flow = self.gap.invariants(place_markers(place, motion.start)), self.flow(place, motion)
        gradient = self.gap.averaged(start, now.h * flow, now.tableau)
        forces, torques = self.pushing(place, motion, gradient, lam[:, 0]), None
        moving = now.h > 0
        gap = self.gap.distance(start)
        if self.phase is not None:
            # What an impact has left open does not close in no time.
            gap = jnp.where(self.phase == RESTING, jnp.minimum(gap, 0.0), gap)
        before = jnp.where(moving, gap / jnp.where(moving, now.h, 1.0), 0.0)
        ahead = before + jnp.sum(gradient * flow, axis=-1)
        # An impulse changes the mean speed of a step by half of what it changes the speed by.
        pushed = 0.5 * self.mobility * lam[:, 0]
        ahead = ahead + self.compliance * pushed
        free = pushed < ahead if self.phase is None else (pushed < ahead) | (self.phase == FREE)
        found = jnp.where(free, pushed, ahead)[:, None]
        if self.friction is not None:
            rubbing, torques, missing = self.rubbing(place, motion, lam)
            forces, found = forces + rubbing, jnp.concatenate([found, missing], axis=1)
        rates = place_markers(place, motion.rates)
        return replace_fields(marker_response(place, forces, torques, rates, motion), rows=found)

    def readings(self, place: Array, rows: Array) -> GapReadings:
        """The gap."""
        return GapReadings(self.gap_at(place, rows))
