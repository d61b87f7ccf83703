"""Newton's method for an equilibrium, downhill where it fails."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.analysis.static_equations import Loading, Static
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.system import System

ITERATIONS = 40
"""Newton iterations for one load."""

DOWNHILL = 400
"""Further iterations with inertia where those have failed."""

SHORT, LONG = 0.1, 0.4
"""Corrections (relative to the extent; radians) below which inertia fades, and above which it grows."""

NO_WEIGHT = 1e-9
"""Part of the first inertia that no longer slows Newton's method."""

LARGEST_TURN = 0.5
"""Largest Cayley vector of a body in one iteration: about one radian."""

TOLERANCE = 1e-11
"""Last correction, relative to the extent of the system and to one radian; the error is its square."""

FLOOR = 1e-7
"""Corrections that stop shrinking below this have reached the floor of round-off of a stiff system."""


class Search(eqx.Module):
    """Where Newton's iteration stands.

    Of the inertia added to the stiffness, `weight` [1/s^2] is what is added, `heaviest` what it begins with.
    `first` is the correction along the tangent; where a later one is larger, or the search has gone downhill,
    it has `snapped`: what it ends at need not be on the path that it began on. In a rotation one more trip
    looks whether it is an equilibrium (`steady`) when everything has turned on, too; then it is `over`.
    """

    state: State
    lam: Array
    weight: Array
    heaviest: Array
    correction: Array
    first: Array
    count: Array
    done: Array
    snapped: Array
    steady: Array
    over: Array

    @property
    def code(self) -> Array:
        """Whether it came to an end."""
        failed = jnp.where(self.snapped, int(Result.DIVERGED), int(Result.MAX_ITERATIONS))
        return jnp.where(self.done, int(Result.SUCCESSFUL), failed)


def extent_of(system: System, state: State) -> Array:
    """Extent of the system with the ground's origin [m]; never zero."""
    points = jnp.max(jnp.abs(state.rows[:, 0]), initial=0.0)
    moment = jnp.sum(jnp.trace(system.mass[:, 1:, 1:], axis1=1, axis2=2)) / jnp.sum(system.mass[:, 0, 0])
    return points + jnp.where(moment > 0, jnp.sqrt(jnp.where(moment > 0, moment, 1.0)), 1e-300)


def largest(system: System, change: Float[Array, " balances"], extent: Array) -> tuple[Array, Array]:
    """Largest displacement relative to the extent, and largest rotation."""
    moved, turned = (jnp.max(jnp.abs(x), initial=0.0) for x in system.local_rates.parts(change))
    return moved / extent, turned


def search_equilibrium(
    system: System, state: State, lam: Array, loading: Loading, snap: bool = True
) -> Search:
    """Newton's method from a configuration and multipliers; every iteration counts from where it is.

    Where it fails, it begins again with inertia added to the stiffness, which keeps corrections short and
    leads downhill, to a stable equilibrium, as time steps with all velocities forgotten would; the inertia
    fades as corrections do (pseudo-transient continuation). Without `snap` it ends there.
    """
    extent = extent_of(system, state)

    def trip(search: Search) -> Search:
        static, slowed = Static(system, search.state, loading), search.weight > 0
        y, looking = jnp.concatenate([jnp.zeros(static.balances), search.lam]), search.done
        if rotating:
            on = static.turned().state
            static = Static(
                system, jax.tree.map(lambda a, b: jnp.where(looking, a, b), on, search.state), loading
            )
        wrenches = static.wrenches(y)
        gaps = jnp.where(looking, 0.0, static.gaps(static.displaced(y)))
        residual = jnp.concatenate([static.balanced(jnp.sum(wrenches, axis=0)), gaps])
        pull = jnp.max(jnp.abs(residual[: static.balances]))
        begun = pull / (jnp.mean(system.mass[:, 0, 0]) * SHORT * extent)
        heaviest = jnp.where(search.count == 0, begun, search.heaviest)
        # Reactions to a rotation first, hardly without a motion: they are part of the stiffness.
        inert = jnp.where(rotating & (search.count == 0), begun / FLOOR, search.weight)
        change = -static.solver(y, inert)[0].solve(residual)
        moved, turned = largest(system, change[: static.balances], extent)
        correction = jnp.maximum(moved, turned)
        finite = jnp.all(jnp.isfinite(change))
        # No body moves or turns too far at once: shortened, or repeated with more inertia.
        too_far = ~finite | (slowed & (correction > LONG))
        allowed = jnp.minimum(2 * LARGEST_TURN / jnp.maximum(turned, 1e-300), 1 / jnp.maximum(moved, 1e-300))
        short = jnp.where(slowed, 1.0, jnp.minimum(1.0, allowed))
        stalled = (search.count > 0) & (correction > 0.5 * search.correction) & (correction <= FLOOR)
        free = search.weight <= NO_WEIGHT * heaviest
        done = ((correction <= TOLERANCE) | stalled) & (short == 1.0) & finite & free
        after = static.moved_along_tree(short * change), search.lam + short * change[static.balances :]
        after = jax.tree.map(lambda a, b: jnp.where(too_far, a, b), (search.state, search.lam), after)
        lighter = jnp.where(correction < SHORT, 0.25, 1.0)
        weight = search.weight * jnp.where(too_far, 4.0, lighter)
        lost = ~slowed & ~done & (~finite | (search.count + 1 >= ITERATIONS))
        now, pulls = jax.tree.map(lambda a, b: jnp.where(lost, a, b), (state, lam), after)
        weight = jnp.where(lost, heaviest, weight)
        first = jnp.where(search.count <= int(rotating), correction, search.first)
        snapped = search.snapped | lost | (correction > jnp.maximum(first, FLOOR))
        count, over = search.count + 1, done
        if not rotating:
            return Search(now, pulls, weight, heaviest, correction, first, count, done, snapped, no, over)
        steady = static.pulls(wrenches)[1]
        found = Search(now, pulls, weight, heaviest, correction, first, count, done, snapped, steady, no)
        steady = search.steady & steady & (correction <= FLOOR)
        looked = replace_fields(search, steady=steady, over=looking)
        return jax.tree.map(lambda a, b: jnp.where(looking, a, b), looked, found)

    def going(search: Search) -> Array:
        return ~search.over & (search.count < ITERATIONS + DOWNHILL) & (snap | ~search.snapped)

    nought, no, rotating = jnp.zeros(()), jnp.array(False), loading.rotation is not None
    start = Search(state, lam, nought, nought, nought, nought, jnp.array(0), no, no, no, no)
    return jax.lax.while_loop(going, trip, start)
