"""Contact as an energy of the gap between two surfaces: it pushes where they overlap, and keeps the energy.

The gap is a function of invariants of the markers, so that energy, momentum and angular momentum are exact in
contact as everywhere. An overlap never holds more than the energy there is: the penetration is bounded by
that whatever the step. What impacts lose is a part of the force that grows with the speed at which the gap
closes; it is there only where a restitution is asked for.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a, require
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Motion, Response, StepContext, replace_fields
from natcoord_jax.core.kinds import Choice, of
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.effects.contact.gap import Gap
from natcoord_jax.maths.vectors import positive_part

HERTZ = "hertz"
GAP = of("a gap, as nc.SphereOnPlane(radius=0.1)", Gap)
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

    gap: Gap = eqx.field(metadata=is_a(GAP))
    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    law: str = eqx.field(default="linear", kw_only=True, static=True, metadata=is_a(LAW))
    restitution: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    speed: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    damping: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "contact"
    derived: ClassVar[tuple[str, ...]] = ("damping",)
    drawn: ClassVar[bool] = False
    silent: ClassVar[bool] = False

    def __check_init__(self) -> None:
        """Refuse markers of another gap, what gives energy, and a restitution of no speed."""
        require(self, "markers", self.gap.markers)
        value = self.restitution
        if value is not None and is_concrete(value) and np.any(np.asarray(value) > 1):
            raise ValueError(
                f"{type(self).__name__}: restitution [-] is {value}; pass a number up to 1: an impact "
                "gives nothing"
            )
        if (value is None) != (self.speed is None):
            raise ValueError(
                f"{type(self).__name__}: restitution [-] is that of one speed, since slower impacts lose "
                "less; pass `restitution` and `speed` [m/s], or neither"
            )

    @property
    def works(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether anything is lost, which its account then has."""
        return self.restitution is not None

    def flaws(self) -> dict[str, Array]:
        """A restitution that gives energy, or none."""
        if self.restitution is None:
            return {}
        said = "has a restitution [-] that is not above 0 and up to 1: an impact gives nothing"
        return {said: (self.restitution <= 0.0) | (self.restitution > 1.0)}

    def assembled_at(self, x: Array) -> "GapPotential":
        """With its damping."""
        return self.renewed()

    def renewed(self) -> "GapPotential":
        """With the damping for its restitution."""
        if self.restitution is None:
            return self
        return replace_fields(self, damping=damping_of(self.restitution, self.speed))

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """That of the potential, and more of it where the gap closes; together they never pull."""
        found = super().respond(place, motion, now, lam)
        if self.damping is None:
            return found
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        flow = jax.vmap(lambda xi, vi: jax.jvp(self.invariants, (xi,), (vi,))[1])(x, rates)
        start: Any = self.invariants(place_markers(place, motion.start))
        closing = self._closing(start, jnp.asarray(now.tableau.b) @ flow, now.h)
        factor = 1.0 + jnp.maximum(self.damping * closing, -1.0)
        forces: Any = found.forces
        given = found.power
        return replace_fields(found, forces=factor * forces, power=factor * given, released=given)

    def _closing(self, start: Any, flow: Any, h: Any) -> Any:
        """Mean rate at which the gap closes in the step [m/s]; at one instant the rate."""
        moving = h > 0
        mean = (self.gap.distance(start) - self.gap.distance(start + h * flow)) / jnp.where(moving, h, 1.0)
        return jnp.where(moving, mean, -jax.jvp(self.gap.distance, (start,), (flow,))[1])

    def invariants(self, x: Float[Array, "k 3"]) -> Float[Array, " p"]:
        """Those of the gap."""
        return self.gap.invariants(x)

    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""
        overlap = positive_part(-self.gap.distance(invariants))
        if self.law == HERTZ:
            return 0.4 * self.stiffness * overlap**2 * _root(overlap)
        return 0.5 * self.stiffness * overlap**2

    def linearised(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> "GapPotential":
        """Itself: what is soft in the middle of a step may be stiff at its end."""
        return self

    def readings(self, place: Array, rows: Array) -> ContactReadings:
        """Gap and force."""
        invariants = self.invariants(place_markers(place, rows))
        gap, energy = self.gap.distance(invariants), self.energy(invariants)
        overlap = positive_part(-gap)
        force = self.stiffness * overlap * (_root(overlap) if self.law == HERTZ else 1.0)
        return ContactReadings(gap, force, energy)


def _root(x: Array) -> Array:
    """Root of what is not negative, with derivatives that are zero at zero."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
