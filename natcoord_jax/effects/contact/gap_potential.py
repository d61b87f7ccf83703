"""Contact as an energy of the gap between two surfaces: it pushes where they overlap, and keeps the energy.

The gap is a function of invariants of the markers, so that energy, momentum and angular momentum are exact in
contact as everywhere. An overlap never holds more than the energy there is: the penetration is bounded by
that whatever the step. What impacts lose is an effect of its own, there only where it is asked for.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, Motion, Response, StepContext, replace_fields
from natcoord_jax.core.kinds import NAME, Choice, of
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential, marker_response, place_markers
from natcoord_jax.maths.vectors import positive_part

HERTZ = "hertz"
LAW = Choice(("linear", HERTZ))


def damping_of(restitution: Any, speed: Any) -> Array:
    """Part of the force per closing speed [s/m] with which an impact of this speed keeps this part of it.

    A force Q (1 + a v) of a closing speed v, whatever Q is as a function of the gap, lets a mass rebound with
    the part e of its speed v_0 for the root d = a v_0 of (1 + d) / (1 - e d) = exp(d (1 + e)).

    Args:
        restitution: e, above 0 up to 1 [-].
        speed: v_0 of the impact [m/s].
    """
    return _damping(as_array(restitution, float), as_array(speed, float))


@eager_numpy
def _damping(restitution: Array, speed: Array) -> Array:
    def missing(u: Array) -> Array:
        # With d = u / e, u in (0, 1): the left side grows beyond all bounds as u does to 1.
        d = u / restitution
        return jnp.log1p(d) - jnp.log1p(-u) - d * (1 + restitution)

    # Bisection: positive beyond the root, negative before it, zero at 0; 60 halvings are a double's digits.
    low, high = jnp.zeros_like(restitution) + 1e-12, jnp.ones_like(restitution) - 1e-15
    for _ in range(60):
        middle = 0.5 * (low + high)
        beyond = missing(middle) > 0
        low, high = jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)
    # One step of Newton's method gives the root its derivatives.
    root = jax.lax.stop_gradient(high)
    slope = 1 / (restitution + root) + 1 / (1 - root) - (1 + restitution) / restitution
    lossy = restitution < 1
    change = missing(root) / jnp.where(lossy, slope, 1.0)
    # Towards 1 the root is 3 (1 - e) / 2.
    return jnp.where(lossy, (root - change) / restitution, 1.5 * (1 - restitution)) / speed


class ContactReadings(eqx.Module):
    """What goes on in a contact.

    Attributes:
        gap: between the surfaces; negative where they overlap [m].
        force: that pushes them apart, without what is lost [N].
        energy: stored [J].
    """

    gap: Float[Array, "*t"]
    force: Float[Array, "*t"]
    energy: Float[Array, "*t"]


class GapPotential(Potential):
    """Base of contacts between two surfaces: subclass it and give `invariants` and `gap`.

    Attributes:
        markers: that the invariants are of.
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".

    Example:
        >>> import natcoord_jax as nc
        >>> class PointAboveGround(nc.GapPotential):
        ...     def invariants(self, x):
        ...         return (x[1] @ (x[2] - x[0]))[None]
        ...     def gap(self, invariants):
        ...         return invariants[0]
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    law: str = eqx.field(default="linear", kw_only=True, static=True, metadata=is_a(LAW))

    kind: ClassVar[str] = "contact"
    drawn: ClassVar[bool] = False
    silent: ClassVar[bool] = False

    @abc.abstractmethod
    def gap(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Distance of the surfaces, negative where they overlap [m]."""

    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""
        overlap = positive_part(-self.gap(invariants))
        if self.law == HERTZ:
            return 0.4 * self.stiffness * overlap**2 * _root(overlap)
        return 0.5 * self.stiffness * overlap**2

    def linearised(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> "GapPotential":
        """Itself: what is soft in the middle of a step may be stiff at its end."""
        return self

    def readings(self, place: Array, rows: Array) -> ContactReadings:
        """Gap and force."""
        invariants = self.invariants(place_markers(place, rows))
        gap, energy = self.gap(invariants), self.energy(invariants)
        overlap = positive_part(-gap)
        force = self.stiffness * overlap * (_root(overlap) if self.law == HERTZ else 1.0)
        return ContactReadings(gap, force, energy)


def _without_markers(contact: GapPotential) -> GapPotential:
    return replace_fields(contact, markers=None, name=None)


CONTACT = of("a contact, as nc.SphereOnPlane(...)", GapPotential)


class ContactLoss(Effect):
    """What impacts lose: a part of the force of a contact that grows with the speed at which its gap closes.

    It does work on the bodies that is never positive, by the change of the gap in a step, and pushes where
    the contact does, so that momentum and angular momentum are kept.

    Attributes:
        markers: those of the contact.
        contact: a contact with the same markers.
        damping: part of its force per closing speed [s/m], see `damping_of`.
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    contact: GapPotential = eqx.field(kw_only=True, metadata=is_a(CONTACT), converter=_without_markers)
    damping: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))

    kind: ClassVar[str] = "contact loss"
    drawn: ClassVar[bool] = False
    works: ClassVar[bool] = True

    def attach(self, find: Any) -> Any:
        """Markers of the contact."""
        return self.markers

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Force of the contact times the speed at which its gap closes; together they never pull."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        flow = jax.vmap(lambda xi, vi: jax.jvp(self.contact.invariants, (xi,), (vi,))[1])(x, rates)
        start = self.contact.invariants(place_markers(place, motion.start))
        stress = self.contact.averaged(start, now.h * flow, now.tableau)
        part = self.damping * self._closing(start, jnp.asarray(now.tableau.b) @ flow, now.h)
        part = jnp.maximum(part, -1.0)
        held = place_markers(place, motion.held.rows)
        forces = -part * jax.vmap(self.contact.pulled_back)(held, stress)
        return marker_response(place, forces, None, rates, motion)

    def _closing(self, start: Array, flow: Array, h: Array) -> Array:
        """Mean rate at which the gap closes in the step [m/s]; at one instant the rate."""
        gap, moving = self.contact.gap, h > 0
        mean = (gap(start) - gap(start + h * flow)) / jnp.where(moving, h, 1.0)
        return jnp.where(moving, mean, -jax.jvp(gap, (start,), (flow,))[1])


def _root(x: Array) -> Array:
    """Root of what is not negative, with derivatives that are zero at zero."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
