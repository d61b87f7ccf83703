"""Closing the constraints of a state, by damped Gauss-Newton steps from wherever it is.

Every step turns and shifts the bodies at least expense of mass to where the linearised constraints close
(`natcoord_jax.mechanics.projection`). It goes no farther than the reach found so far: bodies turn by 1.5 rad,
then by twice as much where the constraints answer as foreseen, so that angles of many turns are counted and
reached. A step that makes matters worse is taken back and damped. Where nothing helps any more, coordinates
that were set are let go, then the bodies are shaken, which leaves positions where a gap has no slope.

The steps are found in a loop without derivatives, which writes down how each was made; derivatives are those
of the steps that were accepted, with these decisions held.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import definite_solution
from natcoord_jax.maths.vectors import largest, safe_norm
from natcoord_jax.mechanics.coordinates import coordinate_rates
from natcoord_jax.mechanics.projection import Projection, gaps, moved
from natcoord_jax.mechanics.violations import GAP, constrained, coordinate_sizes, position_size, spans
from natcoord_jax.model.rows import row_rates, rows_with_ground
from natcoord_jax.stepping.newton import any_lane
from natcoord_jax.system import System

TRIPS = 400
"""Steps, those included that are taken back."""

ACCEPTED = 256
"""Steps that are accepted."""

REACH = 1.5
"""Angle [rad] that a body may turn by in the first step."""

DAMPING = 1e-12
"""Least damping: what depends on others to some 1e-6 is not pushed against."""

ROUND_OFF = 1e-15
"""Gaps, relative, that no step makes smaller."""

MOST_DAMPING = 1e4
"""Damping at which a step is along the slope of the gaps: if it does not help, nothing does."""

SLOW = 15
"""Steps in sequence that may close less than a hundredth of the gaps."""

SHAKES = 2
"""How often the bodies are shaken where they are stuck."""

SHAKEN = 0.2
"""By how much: [rad], and in terms of the extent of the system."""


class Manner(eqx.Module):
    """How a step is made.

    Attributes:
        damping: see `DAMPING`.
        reach: largest angle that a body turns by [rad].
        holding: 1 where the coordinates that were set are held, else 0.
        shake: number of the shake that is made instead of a step; 0: none.
    """

    damping: Float[Array, "*k"]
    reach: Float[Array, "*k"]
    holding: Float[Array, "*k"]
    shake: Int[Array, "*k"]

    @classmethod
    def at_first(cls, dtype: Any) -> "Manner":
        """The first step."""
        damping, reach, holding = (jnp.asarray(x, dtype) for x in (DAMPING, REACH, 1.0))
        return cls(damping, reach, holding, jnp.asarray(0))


class Outcome(eqx.Module):
    """A step, and what the gaps are before and after it (root of the energy that closes them).

    Attributes:
        after: the state.
        before, left, foreseen: gaps before and after it, and after it if they were linear.
        limited: whether it ends at its reach.
        close: whether they are small before and after it.
        least: whether they were round-off before it.
    """

    after: State
    before: Float[Array, ""]
    left: Float[Array, ""]
    foreseen: Float[Array, ""]
    limited: Bool[Array, ""]
    close: Bool[Array, ""]
    least: Bool[Array, ""]


def _step(system: System, origin: State, state: State, manner: Manner) -> Outcome:
    """One step from a state on the way from `origin`, where coordinates have the values to hold."""
    held = None if origin.held is None else manner.holding * origin.held[0]
    wanted = origin.coordinates
    linear = Projection.of(system, state, held)
    gap = gaps(system, state, held, wanted)
    scaled = gap / linear.scale
    multipliers = definite_solution(linear.damped(manner.damping), scaled)
    twist = -(linear.impulses @ multipliers).reshape(-1, 6)
    turned = largest(safe_norm(twist[:, 3:]))
    limited = turned > manner.reach
    twist = jnp.where(limited, manner.reach / jnp.where(limited, turned, 1.0), 1.0) * twist
    points = state.rows[:, 0]
    extent = largest(jnp.abs(points - jnp.mean(points, axis=0)).reshape(-1)) + 0.1 * system.size
    size = jnp.concatenate([jnp.full(3, extent), jnp.ones(3, extent.dtype)])
    # Twists by which bodies are shaken, the first one none.
    random = np.random.default_rng(0).normal(size=(SHAKES, *twist.shape))
    shakes = SHAKEN * np.concatenate([np.zeros((1, *twist.shape)), random])
    shaken = jnp.asarray(shakes)[manner.shake] * size
    twist = jnp.where(manner.shake > 0, shaken, twist)
    after = _moved(system, state, twist)
    found = gaps(system, after, held, wanted)
    sizes = [x.reshape(-1) for x in spans(system, constrained(system))]
    sizes += [] if held is None else [coordinate_sizes(system)]
    gap, other = (x / jnp.concatenate([jnp.zeros(0), *sizes]) for x in (gap, found))
    size = position_size(system, after)
    return Outcome(
        after,
        jnp.linalg.norm(scaled),
        jnp.linalg.norm(found / linear.scale),
        jnp.linalg.norm(scaled + linear.matrix @ twist.reshape(-1)),
        limited,
        jnp.max(jnp.abs(jnp.stack([gap, other])), initial=0.0) <= GAP * size,
        jnp.max(jnp.abs(gap), initial=0.0) <= ROUND_OFF * size,
    )


def _moved(system: System, state: State, twist: Float[Array, "bodies 6"]) -> State:
    """State after a twist, its joint coordinates counted on."""
    rows = rows_with_ground(state.q)
    still = jnp.zeros((1, 3), twist.dtype)
    spin = jnp.concatenate([twist[:, 3:], still])
    rates = row_rates(rows, jnp.concatenate([twist[:, :3], still]), spin)
    return moved(system, state, twist, coordinate_rates(system, rows, rates, spin))


class Way(eqx.Module):
    """Where the way to a closed state has got to.

    Attributes:
        state: reached.
        manner: of the next step.
        manners: of the accepted steps.
        accepted: their number.
        trips: number of all steps.
        slow: steps in sequence that closed next to nothing.
        shakes: how often the bodies were shaken.
        closed: whether the constraints are closed to round-off.
        over: whether nothing helps.
    """

    state: State
    manner: Manner
    manners: Manner
    accepted: Int[Array, ""]
    trips: Int[Array, ""]
    slow: Int[Array, ""]
    shakes: Int[Array, ""]
    closed: Bool[Array, ""]
    over: Bool[Array, ""]

    @property
    def code(self) -> Int[Array, ""]:
        """Result code."""
        finite = jnp.all(jnp.isfinite(self.state.q)) & jnp.all(jnp.isfinite(self.state.coordinates))
        failed = jnp.where(finite, int(Result.MAX_ITERATIONS), int(Result.NONFINITE))
        return jnp.where(self.closed, int(Result.SUCCESSFUL), failed)


def _judged(way: Way, found: Outcome, holds: bool) -> Way:
    """What follows from a step."""
    manner = way.manner
    shaken = manner.shake > 0
    finite = jnp.isfinite(found.left) & jnp.isfinite(found.before)
    accepted = finite & ((found.left < found.before) | found.close | shaken)
    # One step more than positions need: it takes derivatives to where these are.
    done = found.least | (found.left >= 0.25 * found.before)
    closed = found.close & done & (way.accepted > 0)
    # Foreseen within a tenth: the gaps are straight enough for twice the way.
    straight = jnp.abs(found.left - found.foreseen) <= 0.1 * jnp.abs(found.before - found.foreseen)
    under_way = found.limited & straight
    winding = under_way & (manner.reach >= REACH)
    creeping = (found.left > 0.99 * found.before) & ~winding & ~found.close & ~shaken
    slow = jnp.where(accepted, jnp.where(creeping, way.slow + 1, 0), way.slow)
    stuck = (~accepted & (manner.damping >= MOST_DAMPING)) | (slow >= SLOW)
    reach = jnp.where(accepted & under_way, 2.0 * manner.reach, manner.reach)
    reach = jnp.where(accepted, reach, jnp.minimum(0.5 * manner.reach, REACH))
    # Where the gaps are curved within the reach, less damping would only turn the step across the valley.
    softer = jnp.where(found.limited & ~straight, 1.0, 0.01) * manner.damping
    helps = accepted & ~creeping
    damping = jnp.where(helps, jnp.maximum(softer, DAMPING), 100.0 * manner.damping)
    first = Manner.at_first(manner.reach.dtype)
    letting_go = stuck & holds & (manner.holding > 0)
    shaking = stuck & ~letting_go & (way.shakes < SHAKES)
    anew = stuck | shaken
    following = Manner(
        jnp.where(anew, first.damping, damping),
        jnp.where(anew, first.reach, reach),
        jnp.where(letting_go, 0.0, manner.holding),
        jnp.where(shaking, way.shakes + 1, 0),
    )
    manners = jax.tree.map(
        lambda every, x: every.at[way.accepted].set(jnp.where(accepted, x, every[way.accepted])),
        way.manners,
        manner,
    )
    return Way(
        jax.tree.map(lambda new, old: jnp.where(accepted, new, old), found.after, way.state),
        following,
        manners,
        way.accepted + accepted,
        way.trips + 1,
        jnp.where(anew, 0, slow),
        way.shakes + shaking,
        closed,
        (stuck & ~letting_go & ~shaking) | ~jnp.isfinite(found.before),
    )


def _way(system: System, state: State) -> Way:
    """The way from a state to one that obeys its constraints."""
    first = Manner.at_first(state.q.dtype)
    # Lanes of a vmap that are closed go on with the others: as at first, which is always possible.
    every = jax.tree.map(lambda x: jnp.broadcast_to(x, (ACCEPTED,)), first)
    zero, no = jnp.asarray(0), jnp.asarray(False)
    start = Way(state, first, every, zero, zero, zero, zero, no, no)

    def unfinished(way: Way) -> Bool[Array, ""]:
        return ~way.closed & ~way.over & (way.trips < TRIPS) & (way.accepted < ACCEPTED)

    def trip(way: Way) -> Way:
        return _judged(way, _step(system, state, way.state, way.manner), state.held is not None)

    return jax.lax.while_loop(unfinished, trip, start)


@jax.custom_jvp
def closed(system: System, state: State) -> tuple[State, Int[Array, ""]]:
    """State whose positions obey joints and relations, and a result code.

    Args:
        system: compiled system.
        state: with orthonormal directors.
    """
    way = _way(system, state)
    return way.state, way.code


@closed.defjvp
def _closed_jvp(primals: tuple, tangents: tuple) -> tuple:
    way = _way(*jax.lax.stop_gradient(primals))

    def along(system: System, origin: State) -> State:
        @jax.checkpoint
        def step(state: State, recorded: tuple[Array, Manner]) -> tuple[State, None]:
            number, manner = recorded
            taken = number < way.accepted
            after = jax.lax.cond(
                any_lane(taken), lambda s: _step(system, origin, s, manner).after, lambda s: s, state
            )
            return jax.tree.map(lambda new, old: jnp.where(taken, new, old), after, state), None

        return jax.lax.scan(step, origin, (jnp.arange(ACCEPTED), way.manners))[0]

    state, change = jax.jvp(along, primals, tangents)
    return (state, way.code), (change, np.zeros(way.code.shape, jax.dtypes.float0))
