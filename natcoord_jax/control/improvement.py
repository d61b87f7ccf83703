"""The quadratic model's step, corrected until it obeys the conditions of optimality of the steps as they are.

The model serves as approximate inverse in a few conjugate residuals; negative curvature is looked for on the
way.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.conditions import Change, Sweep, left_of_conditions
from natcoord_jax.control.iterate import Iterate, Model, largest
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.riccati import Factors, Right, Weighted, out_of_reach, solve, taken_back
from natcoord_jax.linsolve.conjugate_residuals import conjugate_residuals

CORRECTIONS = 8
"""Most directions of one improvement."""
SOFTEST = 1e-3
"""Least curvature in an entering coefficient that counts, relative to the largest."""
FLAT = 1e-12
"""Curvature in all entering coefficients, relative to that of their bounds, that is rounding."""
ASIDE = 0.1
"""Size of the inputs' change that is asked for along negative curvature, relative to the inputs."""
STILL = 1e-2
"""Gradient of the Lagrangian, relative, below which a step is drawn aside: others know where to go."""
TURNS = 12
"""Inverse iterations that find its direction."""
ENOUGH = (1e-6, 1e-3)
"""Part of the conditions that may be left: the relative size of the step, which is what its square leaves."""


def least_curved(problem: OptimalControl, iterate: Iterate, factors: Factors, turns: Array | int) -> Change:
    """The direction along which the model is curved least, by inverse iteration; the way that the cost falls.

    The increase of the curvature, little more than it is negative, makes that quick.

    Args:
        problem: the problem.
        iterate: the motion.
        factors: of the model.
        turns: iterations.
    """
    by_w, multipliers = iterate.derivatives.by_w, iterate.multipliers
    states = factors.forward.shape[1]
    last, nothing = jnp.zeros(states), jnp.zeros_like(multipliers.goal)
    enters = (jnp.arange(problem.steps) % problem.inputs.every == 0)[:, None]

    def again(_: Array, along: tuple[Array, Array]) -> tuple[Array, Array]:
        first, w = along
        move = solve(factors, Right(jnp.pad(w, ((0, 0), (states, 0))), last, first, nothing))
        w = jnp.where(enters, move.w, 0.0)
        size = jnp.maximum(largest(move.first, w), 1e-300)
        return move.first / size, w / size

    # Without any symmetry.
    start = jnp.sin(1.0 + 2.4 * jnp.arange(by_w.size).reshape(by_w.shape))
    first, w = jax.lax.fori_loop(0, turns, again, (jnp.zeros_like(iterate.derivatives.by_first), start))
    uphill = jnp.sum(by_w * w) + iterate.derivatives.by_first @ first > 0
    first, w = (jnp.where(uphill, -x, x) for x in (first, w))
    return Change(first, w, nothing, jnp.zeros_like(multipliers.path), jnp.zeros_like(multipliers.end))


def curvature(
    along: Change, bent: Array, sweep: Sweep, bounds: Weighted, added: tuple[Array, Array]
) -> Float[Array, ""]:
    """Curvature of the Lagrangian along a direction, with what bounds add.

    Args:
        along: the direction.
        bent: the direction times what it leaves of the conditions, at level 0.
        sweep: along it.
        bounds: what slacks add.
        added: what has been added to the curvature, which is left out.
    """
    own = bent - jnp.sum(added[0] * along.w**2) - jnp.sum(added[1] * along.first**2)
    return own + jnp.sum(bounds.path * sweep.excess**2) + jnp.sum(bounds.end * sweep.end_excess**2)


def times(change: Change, left: Change) -> Float[Array, ""]:
    """A direction of what is solved for times what another one leaves of the conditions there."""
    return jnp.sum(change.w * left.w) + change.first @ left.first


class Improved(NamedTuple):
    """A step that obeys the conditions, as far as asked for.

    Attributes:
        change: of coefficients and multipliers.
        sweep: along it.
        unreachable: part of the goal that nothing can change.
        saddle: whether the curvature is negative along the direction in which the model's is least.
        there: whether the conditions hold as well as asked for.
        count: solutions of the model that this has taken.
    """

    change: Change
    sweep: Sweep
    unreachable: Float[Array, " c"]
    saddle: Bool[Array, ""]
    there: Bool[Array, ""]
    count: Int[Array, ""]


def improved(
    problem: OptimalControl,
    iterate: Iterate,
    found: Model,
    factors: Factors,
    bounds: Weighted,
    penalty: Array,
) -> Improved:
    """The step that obeys the conditions to first order, with the model as approximate inverse.

    Args:
        problem: the problem.
        iterate: the motion.
        found: the model.
        factors: of the model.
        bounds: what slacks add.
        penalty: weight of the goal's square in the model.
    """
    unknowns, missing = iterate.unknowns, iterate.path.end.missing

    added, look = factors.added, factors.added[0] > 0
    soft = least_curved(problem, iterate, factors, jnp.where(look, TURNS, 0))
    still, size = iterate.errors.stationarity < STILL, largest(unknowns.coefficients)
    aside = ASIDE * jnp.where(size > 0, size, 1.0)

    def bent(seen: tuple[Sweep, Array]) -> Array:
        return curvature(soft, seen[1], seen[0], bounds, added)

    def apply(change: Change, level: Array, seen: tuple[Sweep, Array]) -> tuple[Change, tuple[Sweep, Array]]:
        # The model is not exact: where the curvature of the steps themselves is not negative, it needs no
        # increase. Far from the solution, that keeps steps short in valleys that wind.
        rising = (bent(seen) >= 0) & still & (iterate.step >= 1.0) & (iterate.failures == 0)
        own = jax.tree.map(lambda x: jnp.where(rising, 0.0, x), added)
        left, sweep = left_of_conditions(problem, iterate, bounds, own, change, level)
        product = times(soft, left)
        # A motion that is as symmetric as its problem may be stationary and no minimum: nothing in the
        # conditions leads out of the symmetry, but a force along negative curvature does.
        away = level * aside * ((bent(seen) < 0) & still)
        force = away * added[0] * soft.w, away * added[1] * soft.first
        left = eqx.tree_at(lambda x: (x.w, x.first), left, (left.w - force[0], left.first - force[1]))
        gradient = jnp.pad(-left.w, ((0, 0), (found.forward.shape[1], 0)))
        gradient = gradient + jnp.einsum("kh,khz->kz", left.path, found.excess)
        last = found.last_excess.T @ left.end - found.goal.T @ (penalty * left.goal)
        move = solve(factors, Right(gradient, last, -left.first, -left.goal))
        both = jnp.concatenate([move.z[:-1], move.w], axis=1)
        path = left.path + bounds.path * jnp.einsum("khz,kz->kh", found.excess, both)
        end = left.end + bounds.end * (found.last_excess @ move.z[-1])
        return Change(move.first, move.w, move.goal, path, end), (sweep, product)

    def enough(change: Change) -> Array:
        size = largest(unknowns.coefficients, unknowns.free)
        return jnp.clip(largest(change.w, change.first) / jnp.where(size > 0, size, 1.0), *ENOUGH)

    # What changes are worth by their curvature, without what bounds add; by that alone where the cost is
    # linear. And multipliers by the compliance of what they press.
    steep = found.excess[:, :, -problem.channels :] ** 2
    own = jnp.abs(jnp.diagonal(found.hessian, axis1=1, axis2=2)[:, -problem.channels :])
    pressed = jnp.einsum("kh,khm->km", bounds.path, steep)
    flat = jnp.max(own, initial=0.0) <= FLAT * jnp.max(pressed, initial=0.0)
    own = jnp.where(flat, pressed, own)
    own = jnp.maximum(own, SOFTEST * jnp.max(own, initial=1e-300))
    felt = factors.goal_scale > 0
    give = jnp.sum(steep / own[:, None], axis=2)
    weights = Change(
        factors.start_stiffness,
        own,
        jnp.where(felt, 1.0 / jnp.where(felt, factors.goal_scale, 1.0) ** 2, 0.0),
        give,
        jnp.zeros_like(bounds.end),
    )
    y, path = unknowns.y, iterate.path
    sweep = Sweep(y, path.stages.excess, missing, path.end.excess, y)
    shapes = sweep, jnp.zeros_like(iterate.unit)
    start = Change(
        jnp.zeros(found.first.shape[1]),
        jnp.zeros_like(iterate.derivatives.by_w),
        taken_back(factors, iterate.multipliers.goal),
        jnp.zeros_like(iterate.multipliers.path),
        jnp.zeros_like(iterate.multipliers.end),
    )
    reached = conjugate_residuals(apply, soft, look, start, shapes, weights, enough, CORRECTIONS)
    sweep, saddle = reached.more[0], look & (bent(reached.found) < 0)
    unreachable = jnp.where(iterate.softness > 0, 0.0, out_of_reach(factors, missing + sweep.missing))
    return Improved(reached.solution, sweep, unreachable, saddle, reached.there, reached.count)
