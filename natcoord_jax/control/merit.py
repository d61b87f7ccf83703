"""The merit function: barrier cost and weighted violations, and the search for a step that lowers it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.iterate import Iterate, Options, Slacks
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import Path, Unknowns, roll, simulated

BOUNDARY = 0.99
"""Part of the way to a bound that a step may go."""
HALVINGS = 14
"""Halvings of a step before it is given up."""
DECREASE = 1e-4
"""Least part of the predicted decrease."""
ROUND_OFF = 1e-13
"""Changes of the merit below this fraction of it are noise."""
WEIGHT = 1.5
"""Weight of a violation in units of its multiplier; more than one makes the merit exact."""


class Direction(eqx.Module):
    """Directions of everything."""

    unknowns: Unknowns
    multipliers: Multipliers
    slacks: Slacks


class Violations(eqx.Module):
    """Residuals of the constraints, or the weights of their magnitudes."""

    motion: Float[Array, "steps n"]
    goal: Float[Array, " c"]
    path: Float[Array, "steps h"]
    end: Float[Array, " e"]

    def weighted(self, weights: "Violations") -> Array:
        """Weighted sum of magnitudes."""
        pairs = zip(jax.tree.leaves(self), jax.tree.leaves(weights))
        return sum((jnp.sum(w * jnp.abs(x)) for x, w in pairs), jnp.zeros(()))


def violations(path: Path, slacks: Slacks) -> Violations:
    """Residuals of all constraints."""
    gap, last = path.stages.excess + slacks.path, path.end.excess + slacks.end
    return Violations(path.stages.residual, path.end.missing, gap, last)


def merit(path: Path, slacks: Slacks, barrier: Array, weights: Violations) -> Array:
    """Barrier cost plus weighted violations."""
    logarithms = jnp.sum(jnp.log(slacks.path)) + jnp.sum(jnp.log(slacks.end))
    return path.cost - barrier * logarithms + violations(path, slacks).weighted(weights)


def slope_and_weights(iterate: Iterate, direction: Direction, every: int) -> tuple[Array, Violations]:
    """Slope of the merit along a direction, and weights that make it negative."""
    now, m, dm, mu = iterate.multipliers, iterate.multipliers, direction.multipliers, iterate.barrier
    worth = iterate.derivatives.worth.residuals

    def weight(a: Array, b: Array) -> Array:
        return WEIGHT * jnp.maximum(jnp.abs(a), jnp.abs(b))

    floor = 1e-6 * jnp.max(jnp.abs(worth), initial=0.0)
    weights = Violations(
        weight(worth, worth) + floor,
        weight(m.goal, m.goal + dm.goal),
        weight(m.path, m.path + dm.path),
        weight(m.end, m.end + dm.end),
    )
    gaps = violations(iterate.path, iterate.slacks)
    multipliers = Violations(worth, now.goal, now.path, now.end)
    d, by_w = direction.unknowns, iterate.derivatives.by_w[::every]
    leading = d.coefficients.shape[0] - by_w.shape[0]
    first = jnp.concatenate([d.free, d.coefficients[:leading].reshape(-1)])
    slope = jnp.sum(by_w * d.coefficients[leading:]) + iterate.derivatives.by_first @ first
    for gap, multiplier in zip(jax.tree.leaves(gaps), jax.tree.leaves(multipliers)):
        slope = slope + jnp.sum(multiplier * gap)
    slope = slope - gaps.weighted(weights)
    for s, ds, sigma in (
        (iterate.slacks.path, direction.slacks.path, m.path),
        (iterate.slacks.end, direction.slacks.end, m.end),
    ):
        slope = slope + jnp.sum((sigma - mu / s) * ds)
    return slope, weights


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


class Found(eqx.Module):
    """The result of a search.

    Attributes:
        length: of the step.
        unknowns: at its end.
        slacks: at its end.
        path: at its end.
        fine: whether the merit is lower there.
        newton: Newton iterations spent.
    """

    length: Float[Array, ""]
    unknowns: Unknowns
    slacks: Slacks
    path: Path
    fine: Bool[Array, ""]
    newton: Int[Array, ""]


def search(
    problem: OptimalControl,
    options: Options,
    iterate: Iterate,
    direction: Direction,
    slope: Float[Array, ""],
    weights: Violations,
) -> Found:
    """A step along the direction, halved until the merit is lower than one of the last two."""
    s, ds, mu = iterate.slacks, direction.slacks, iterate.barrier
    whole_step = room([(s.path, ds.path), (s.end, ds.end)])
    now, before = (merit(*x, mu, weights) for x in ((iterate.path, s), iterate.previous))
    limit = jnp.maximum(now, before)
    noise = ROUND_OFF * (jnp.abs(limit) + jnp.abs(iterate.path.cost) + jnp.sum(weights.goal))

    def attempt(a: Array, spent: Array) -> Found:
        unknowns = moved(iterate.unknowns, direction.unknowns, a)
        newton, whole = jnp.array(0), jnp.array(True)
        if not options.lifted:
            unknowns, whole, newton = simulated(problem, unknowns)
        path, slacks = roll(problem, unknowns), moved(s, ds, a)
        value = merit(path, slacks, mu, weights)
        lower = value <= limit + DECREASE * a * jnp.minimum(slope, 0.0) + noise
        return Found(a, unknowns, slacks, path, whole & jnp.isfinite(value) & lower, spent + newton)

    def unfinished(found: Found) -> Array:
        return ~found.fine & (found.length > whole_step * 0.5**HALVINGS)

    def body(found: Found) -> Found:
        return attempt(0.5 * found.length, found.newton)

    # The first attempt is a turn of the loop like the others, so that it is compiled once.
    begun = Found(2.0 * whole_step, iterate.unknowns, s, iterate.path, jnp.array(False), jnp.array(0))
    return jax.lax.while_loop(unfinished, body, begun)
