"""The search along a direction: a step is taken if it lowers the barrier cost or the violations.

The filter of Waechter and Biegler, Math. Program. 106 (2006) 25-57, with their constants: pairs of
violation and barrier cost that no later iterate may be worse than in both. No weights have to be guessed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.iterate import Filter, Iterate, Model, Options, Slacks
from natcoord_jax.control.newton import as_unknowns, closing, constrained, followed
from natcoord_jax.control.phases import rates_of
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.riccati import Factors, Right, Weighted
from natcoord_jax.control.transcription import Path, Unknowns, roll, simulated

BOUNDARY = 0.99
"""Part of the way to a bound that a step may go."""
HALVINGS = 14
"""Halvings of a step before it is given up."""
LESS_VIOLATION, LESS_COST = 1e-5, 1e-8
"""Least decrease, relative to the violation."""
ARMIJO = 1e-4
"""Least part of the predicted decrease of the cost."""
SLOPE_POWER, VIOLATION_POWER = 2.3, 1.1
"""A step is for the cost if its predicted decrease to one power exceeds the violation to the other."""
ROUND_OFF = 1e-13
"""Changes of the barrier cost below this fraction of it are noise."""
MEMORY = 40
"""Pairs that the filter remembers."""
SMALL, LARGE = 1e-4, 1e4
"""Violations below which steps are for the cost, and that are never exceeded, relative to the first."""
CLOSED = 1e-12
"""Violations below this are noise."""


class Direction(eqx.Module):
    """Directions of everything."""

    unknowns: Unknowns
    multipliers: Multipliers
    slacks: Slacks


def room(pairs: list[tuple[Array, Array]]) -> Array:
    """Largest part of a step, at most the whole, that keeps positive numbers positive."""
    found = jnp.ones(())
    for x, dx in pairs:
        shrinking = dx < 0
        ratios = jnp.where(shrinking, -BOUNDARY * x / jnp.where(shrinking, dx, -1.0), 1.0)
        found = jnp.minimum(found, jnp.min(ratios, initial=1.0))
    return found


def moved(x: Any, dx: Any, a: Array) -> Any:
    """A point along a direction."""
    return jax.tree.map(lambda x, dx: x + a * dx, x, dx)


def missed(softness: Array, missing: Array) -> Array:
    """Multipliers of a soft goal: what missing it costs, by what is missing."""
    return jnp.where(softness > 0, missing / jnp.where(softness > 0, softness, 1.0), 0.0)


def violation(units: Array, softness: Array, path: Path, slacks: Slacks) -> Array:
    """Sum of what all constraints leave, the equations of steps in their units."""
    gap, last = path.stages.excess + slacks.path, path.end.excess + slacks.end
    missing = jnp.where(softness > 0, 0.0, path.end.missing)
    parts = (units * path.stages.residual, missing, gap, last)
    found = sum((jnp.sum(jnp.abs(part)) for part in parts), jnp.zeros(()))
    # What is no number stays none.
    return jnp.where(found <= CLOSED, 0.0, found)


def _measured(iterate: Iterate, path: Path, slacks: Slacks) -> tuple[Array, Array]:
    """Violation of all constraints, and barrier cost in units of the cost."""
    logarithms = jnp.sum(jnp.log(slacks.path)) + jnp.sum(jnp.log(slacks.end))
    soft = 0.5 * missed(iterate.softness, path.end.missing) @ path.end.missing
    cost = (path.cost + soft - iterate.barrier * logarithms) / iterate.unit
    return violation(iterate.filter.units, iterate.softness, path, slacks), cost


def first_filter(
    problem: OptimalControl,
    unknowns: Unknowns,
    softness: Array,
    path: Path,
    slacks: Slacks,
    inverses: Array,
) -> Filter:
    """A filter that knows nothing but what the first iterate violates."""
    rates = jnp.where(rates_of(problem.systems, problem.phases, problem.stages)[:, :, None], inverses, 0.0)
    _, dt = problem.applied(unknowns.free)
    units = dt * jnp.max(jnp.abs(rates), axis=(0, 1))
    size = jnp.maximum(1.0, violation(units, softness, path, slacks))
    nothing = jnp.full(MEMORY, jnp.inf, float)
    return Filter(nothing, nothing, jnp.array(0), units, SMALL * size, LARGE * size)


def at_barrier(iterate: Iterate, barrier: Array) -> Iterate:
    """The iterate at another barrier parameter: what the filter knows of costs is then worth nothing."""
    same, known = barrier == iterate.barrier, iterate.filter
    violations, costs = (jnp.where(same, x, jnp.inf) for x in (known.violations, known.costs))
    return eqx.tree_at(
        lambda i: (i.barrier, i.filter.violations, i.filter.costs), iterate, (barrier, violations, costs)
    )


class Found(eqx.Module):
    """The result of a search.

    Attributes:
        length: of the step.
        unknowns: at its end.
        slacks: at its end.
        path: at its end.
        fine: whether it is taken.
        for_cost: whether it is, because it lowers the cost as predicted.
        newton: Newton iterations spent.
        corrected: whether the whole step has been corrected.
    """

    length: Float[Array, ""]
    unknowns: Unknowns
    slacks: Slacks
    path: Path
    fine: Bool[Array, ""]
    for_cost: Bool[Array, ""]
    newton: Int[Array, ""]
    corrected: Bool[Array, ""]


def search(
    problem: OptimalControl,
    options: Options,
    iterate: Iterate,
    direction: Direction,
    slope: Float[Array, ""],
    model: Model,
    factors: Factors,
) -> Found:
    """A step along the direction, halved until the filter takes it.

    A whole step that is not taken is corrected once, by the least change that takes back what it violates to
    second order: near the solution steps would else be cut for ever (Maratos, thesis, Paris 1978).

    Args:
        problem: the problem.
        options: whether to simulate.
        iterate: where it starts.
        direction: where it goes.
        slope: of the barrier cost along it.
        model: where the direction comes from.
        factors: of the model.
    """
    s, ds = iterate.slacks, direction.slacks
    longest = room([(s.path, ds.path), (s.end, ds.end)])
    left, cost = _measured(iterate, iterate.path, s)
    known, slope = iterate.filter, slope / iterate.unit
    noise = ROUND_OFF * (1.0 + jnp.abs(cost))

    def attempt(a: Array, extra: tuple[Unknowns, Slacks], spent: Array, corrected: Array) -> Found:
        along = moved((iterate.unknowns, s), (direction.unknowns, ds), a)
        unknowns, slacks = moved(along, extra, jnp.ones(()))
        unknowns, whole, newton = simulated(problem, unknowns, options.lifted)
        path = roll(problem, unknowns)
        violated, costs = _measured(iterate, path, slacks)
        gain = -a * slope
        promising = (gain > 0) & (
            jnp.maximum(gain, 0.0) ** SLOPE_POWER * a ** (1.0 - SLOPE_POWER) > left**VIOLATION_POWER
        )
        for_cost = promising & (left <= known.least)
        lower = costs <= cost - ARMIJO * gain + noise
        either = (violated <= (1.0 - LESS_VIOLATION) * left) | (costs <= cost - LESS_COST * left + noise)
        new = jnp.all((violated <= known.violations) | (costs <= known.costs + noise))
        taken = jnp.where(for_cost, lower, either) & new & (violated <= known.largest)
        finite = whole & jnp.isfinite(violated) & jnp.isfinite(costs)
        return Found(a, unknowns, slacks, path, finite & taken, for_cost & lower, spent + newton, corrected)

    nothing = jax.tree.map(jnp.zeros_like, (iterate.unknowns, s))

    def body(found: Found) -> Found:
        whole = (longest == 1.0) & (found.length == 1.0) & ~found.corrected & jnp.all(iterate.softness == 0)
        extra = jax.lax.cond(
            whole,
            lambda: second_order_correction(problem, iterate, model, factors, found.path),
            lambda: nothing,
        )
        a = jnp.where(whole, 1.0, 0.5 * found.length)
        return attempt(a, extra, found.newton, found.corrected | whole)

    # The first attempt is a turn of the loop like the others, so that it is compiled once.
    no = jnp.array(False)
    begun = Found(2.0 * longest, iterate.unknowns, s, iterate.path, no, no, jnp.array(0), no)
    least = longest * 0.5**HALVINGS
    return jax.lax.while_loop(lambda found: ~found.fine & (found.length > least), body, begun)


def second_order_correction(
    problem: OptimalControl, iterate: Iterate, model: Model, factors: Factors, path: Path
) -> tuple[Unknowns, Slacks]:
    """The least change, as the model weighs it, that takes away what a motion near an iterate violates."""
    m, dy = iterate.multipliers, closing(iterate, path.stages.residual)
    nothing = Weighted(*(jnp.zeros_like(x) for x in (m.path, m.path, m.end, m.end)))
    gradient = jnp.zeros(model.hessian.shape[:2])
    last, first = jnp.zeros(model.goal.shape[1]), jnp.zeros(model.first.shape[1])
    move = constrained(model, factors, nothing, Right(gradient, last, first, path.end.missing), dy)
    change = followed(model, nothing, move, dy)
    unknowns = eqx.tree_at(lambda u: u.y, as_unknowns(problem, iterate, move), change.y)
    return unknowns, Slacks(-change.excess, -change.end_excess)


def remembered(iterate: Iterate, found: Found) -> Filter:
    """The filter after a step: one that was not for the cost leaves its start behind, for good."""
    known = iterate.filter
    left, cost = _measured(iterate, iterate.path, iterate.slacks)
    place = known.count % known.costs.shape[0]
    pair = ((1.0 - LESS_VIOLATION) * left, cost - LESS_COST * left)
    kept = found.fine & ~found.for_cost
    violations = jnp.where(kept, known.violations.at[place].set(pair[0]), known.violations)
    costs = jnp.where(kept, known.costs.at[place].set(pair[1]), known.costs)
    return Filter(violations, costs, known.count + kept, known.units, known.least, known.largest)
