"""Impacts that are located in a step: where it is split, and how long its parts are.

Contacts that are apart do not push; an attempt at the rest of a step at whose end a gap is negative is made
anew, shorter, until the gap closes at its end. There the impact law acts, and the rest of the step follows.
How long the part is follows from its own equations, so that derivatives know of it: with the rates y of the
part, g(q_0 + h V(y)) = 0 gives h as a function of where it starts and of y.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.constraint import FREE
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.free_flight import (
    CLOSED,
    SLOW,
    bouncing_groups,
    gaps_and_rates,
    in_free_flight,
    lowest,
    touch,
)
from natcoord_jax.mechanics.response import StageKinematics
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.mechanics.violations import contact_gaps
from natcoord_jax.stepping.error_control import StepDecision
from natcoord_jax.system import System

FLIGHT, WHOLE = -1, -2
"""What ends a part of a step instead of a contact: nothing yet; nothing more, by the law of whole steps."""

TRIES = 30
"""Attempts at one part of a step; three or four are the rule."""

COMPLETE = 1e-12
"""Part of a step that may be missing in the sum of its parts."""


class Ahead(eqx.Module):
    """Contacts that have impacts, in an attempt.

    Attributes:
        free: which do not push.
        gap: at its start and its end [m].
        rate: of the gaps there, before impacts [m/s].
        touching: gap at which contacts have met at its end.
        slow: speed up to which they have met slowly.
        h: length of the attempt [s].
    """

    free: Bool[Array, " c"]
    gap: tuple[Float[Array, " c"], Float[Array, " c"]]
    rate: tuple[Float[Array, " c"], Float[Array, " c"]]
    touching: Float[Array, ""]
    slow: Float[Array, ""]
    h: Float[Array, ""]

    @property
    def late(self) -> Bool[Array, " c"]:
        """Which have closed before its end."""
        return self.free & ((self.gap[1] < 0) | self.dips)

    @property
    def dips(self) -> Bool[Array, " c"]:
        """Which have been closed within it and are open again, by the parabolas through what is known."""
        return self.free & (lowest(self.gap[0], *self.rate, self.h) < 0)

    @property
    def hit(self) -> Bool[Array, " c"]:
        """Which close at its end."""
        near = (self.gap[1] >= 0) & (self.gap[1] <= self.touching)
        return self.free & near & (self.rate[1] < 0)

    @classmethod
    def of(cls, system: System, state: State, at: StageKinematics, h: Array, dt: Array) -> "Ahead":
        """Of an attempt that is solved."""
        groups: Any = bouncing_groups(system)
        rates = at.rates[0, : len(system.structure.bodies)].reshape(state.q.shape)
        after = replace_fields(state, q=state.q + h * rates)
        begun = gaps_and_rates(system, groups, state, state.v)
        ended = gaps_and_rates(system, groups, after, 2.0 * rates - state.v)
        free = jnp.concatenate([group.effect.phase == FREE for group in groups])
        slow = touch(system, after, SLOW) / dt
        return cls(free, (begun[0], ended[0]), (begun[1], ended[1]), touch(system, after, CLOSED), slow, h)

    def crossings(self) -> Float[Array, " c"]:
        """When late gaps close [s], by the parabolas through what is known."""
        gap, rate = self.gap[0] - 0.5 * self.touching, self.rate[0]
        bend = (self.gap[1] - self.gap[0] - rate * self.h) / self.h**2
        root = jnp.sqrt(jnp.maximum(rate**2 - 4.0 * bend * gap, 0.0))
        falling = rate < 0
        below = jnp.where(falling, root - rate, 2.0 * bend)
        found = jnp.where(falling, 2.0 * gap, -rate - root) / jnp.where(below != 0, below, 1.0)
        return jnp.where(below != 0, found, jnp.inf)

    def nearer(self) -> Float[Array, " c"]:
        """The same by the speed at which they close at its end."""
        closing = self.rate[1] < 0
        more = (0.5 * self.touching - self.gap[1]) / jnp.where(closing, self.rate[1], 1.0)
        return jnp.where(closing, self.h + more, jnp.inf)


class ImpactSearch(eqx.Module):
    """Where the search for the next impact in a step stands.

    Attributes:
        event: number of the contact that is to close at the end of the attempt at hand, `FLIGHT` or `WHOLE`.
        ended: the same of the attempt before, if it was accepted.
        early: longest part of the step known to end before the impact.
        late: shortest known to end after it.
        count: impacts located in the step.
        tries: attempts at the part at hand.
    """

    event: Int[Array, ""]
    ended: Int[Array, ""]
    early: Float[Array, ""]
    late: Float[Array, ""]
    count: Int[Array, ""]
    tries: Int[Array, ""]

    @classmethod
    def first(cls) -> "ImpactSearch":
        """At the start of a step."""
        nought, whole = jnp.array(0), jnp.ones(())
        return cls(nought + FLIGHT, nought + FLIGHT, 0.0 * whole, whole, nought, nought)

    def after(
        self, ahead: Ahead, fraction: Array, done: Array, most: int, solved: Bool[Array, ""]
    ) -> tuple["ImpactSearch", Bool[Array, ""], Float[Array, ""]]:
        """What follows from an attempt: where the search stands, whether it is the part, the next part.

        Args:
            ahead: contacts in the attempt.
            fraction: part of the step that it takes.
            done: part before it.
            most: impacts that are located in a step.
            solved: whether the equations of the attempt are.
        """
        searching, whole = self.event >= 0, self.event == WHOLE
        overshot, met = jnp.any(ahead.late), jnp.any(ahead.hit)
        slowly = met & ~overshot & ~jnp.any(ahead.hit & (ahead.rate[1] < -ahead.slow))
        given_up = (overshot | met) & ((self.count >= most) | slowly)
        given_up = (given_up | (self.tries >= TRIES)) & ~whole
        accepted = solved & (whole | (~overshot & (met | ~searching) & ~given_up))
        over = accepted & (1.0 - done - fraction <= COMPLETE)
        anew = accepted | ~solved
        nearer, following = self._nearer(ahead, fraction)
        again, kept = anew | given_up, jnp.where(whole & ~over, WHOLE, FLIGHT)
        search = ImpactSearch(
            jnp.where(anew, kept, jnp.where(given_up, WHOLE, nearer.event)),
            jnp.where(met, jnp.argmax(ahead.hit), jnp.where(searching, FLIGHT, self.event)),
            jnp.where(again, 0.0, nearer.early),
            jnp.where(again, 1.0, nearer.late),
            jnp.where(over, 0, self.count + (accepted & met)),
            jnp.where(anew, 0, self.tries + 1),
        )
        following = jnp.where(given_up, 1.0 - done, following)
        following = jnp.where(accepted, jnp.where(over, 1.0, 1.0 - done - fraction), following)
        return search, accepted, jnp.where(solved, following, 0.5 * fraction)

    def _nearer(self, ahead: Ahead, fraction: Array) -> tuple["ImpactSearch", Float[Array, ""]]:
        """The search with what an attempt that was too long or too short says, and the next part to try."""
        searching, overshot = self.event >= 0, jnp.any(ahead.late)
        # Of several that close, the first; of none, that which was sought.
        sought = jnp.where(overshot, ahead.late, jnp.arange(ahead.late.shape[0]) == self.event)
        when = jnp.where(searching & ~ahead.dips, ahead.nearer(), ahead.crossings())
        when = jnp.where(sought, when, jnp.inf)
        row = jnp.argmin(when)
        early, late = jnp.where(overshot, self.early, fraction), jnp.where(overshot, fraction, self.late)
        guess = fraction * when[row] / ahead.h
        guess = jnp.where((guess > early) & (guess < late), guess, 0.5 * (early + late))
        # What rises and falls within one part has no speed on average that would tell when: up to its top.
        rising = ~searching & (ahead.rate[0][row] * guess * ahead.h > ahead.gap[0][row] * fraction)
        search = replace_fields(
            self,
            event=jnp.where(rising, FLIGHT, row),
            early=jnp.where(rising, 0.0, early),
            late=jnp.where(rising, 1.0, late),
        )
        return search, jnp.where(rising, 0.5, 1.0) * guess


def with_impacts(
    search: ImpactSearch, ahead: Ahead, found: StepDecision, before: Any, most: int, solved: Any
) -> tuple[ImpactSearch, StepDecision]:
    """A decision with the search for impacts: an attempt that goes beyond the next one is made anew.

    Args:
        search: where it stands.
        ahead: contacts in the attempt.
        found: what is decided without.
        before: where the rollout stands.
        most: impacts that are located in a step.
        solved: whether the attempt's equations are.
    """
    search, accepted, fraction = search.after(ahead, before.fraction, before.done, most, solved)
    done = before.done + jnp.where(accepted, before.fraction, 0.0)
    state = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), found.state, before.state)
    state = replace_fields(state, elapsed=jnp.where(done > 1.0 - COMPLETE, 0.0, state.elapsed))
    change = jnp.where(accepted, 1, 0)
    given = {"state": state, "done": done, "fraction": fraction, "change": change, "accepted": accepted}
    return search, replace_fields(found, **given)


def part_of_step(
    system: System, state: State, u: Array, dt: Array, y: Array, tableau: Tableau, slot: Any
) -> tuple[System, Float[Array, ""]]:
    """The system whose equations a recorded part of a step solves, and its length [s].

    Both as functions of all that they depend on: what an impact ends by when that is, what follows it in its
    step by what is left.

    Args:
        system: compiled system.
        state: at the start of the part.
        u: inputs.
        dt: step [s].
        y: solution of the equations.
        tableau: of the scheme.
        slot: the record.
    """
    if slot.event is None or state.elapsed is None:
        return system, slot.fraction * dt
    fixed = jax.lax.stop_gradient
    system = in_free_flight(system, state, dt, slot.event != WHOLE)
    rest = dt - state.elapsed
    share = slot.fraction / (1.0 - slot.done)
    length = fixed(slot.fraction * dt) + share * (rest - fixed(rest))
    located = (slot.event >= 0) & ~slot.completes
    return system, jnp.where(located, _until_contact(system, state, u, dt, y, tableau, slot), length)


def _until_contact(
    system: System, state: State, u: Array, dt: Array, y: Array, tableau: Tableau, slot: Any
) -> Float[Array, ""]:
    """Time until the gap is what the record has of it [s]; its derivatives by the implicit rule."""
    groups, row = bouncing_groups(system), jnp.maximum(slot.event, 0)

    def gap(h: Array) -> Array:
        equations = prepare(system, state, u, h, tableau, NOTHING)
        at = equations.moved(equations.split(y)[0])[0]
        rates = at.rates[0, : len(system.structure.bodies)].reshape(state.q.shape)
        return contact_gaps(system, groups, replace_fields(state, q=state.q + h * rates))[row]

    recorded = jax.lax.stop_gradient(slot.fraction * dt)
    level = jax.lax.stop_gradient(gap(recorded))

    def solved(slope: Any, right: Array) -> Array:
        speed = slope(jnp.ones_like(right))
        return jnp.where(speed != 0, right / jnp.where(speed != 0, speed, 1.0), 0.0)

    return jax.lax.custom_root(lambda h: gap(h) - level, recorded, lambda _, h: h, solved)
