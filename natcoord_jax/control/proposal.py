"""The step that the quadratic model proposes: made convex, and corrected."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.conditions import Change, as_unknowns, left_of_conditions
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.improvement import FLAT, Improved, curvature, improved, least_curved, times
from natcoord_jax.control.iterate import Derivatives, Iterate, Model, Options, Slacks, largest
from natcoord_jax.control.line_search import SMALL, Direction, missed, violation
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.quadratic import model
from natcoord_jax.control.riccati import REACH, Factors, Weighted, factored
from natcoord_jax.core.compiled import compiled
from natcoord_jax.xla.tracing import traced_once

SHIFT = 1e-4
"""First increase of the curvature where the model is not convex."""
GROWTH = 8.0
"""Of the increase, until the model is convex."""
LARGEST_SHIFT = 1e8
LEFT_OUT = 0.1
"""Part of what is missing to the goal that a step may leave out."""
HELD = 3.0
"""Curvature in what is free, in units of the cost, where the equations are violated as at the start: least
time would else be at its lower bound before there is any motion that lasts as long."""
FIXED = 1e9
"""The same in a feasibility restoration: time and parameters stay."""
SOLVED = 10.0
"""Errors, in terms of the barrier parameter, of a problem with barriers that is solved well enough."""
LEAST_BARRIER = 1e-10
"""Barrier parameter at the end, relative to the cost."""


NEAR = 0.5
"""Relative size of a step after which the model it came from may serve another one."""
MANY = 60
"""Inverse iterations that find the least curvature of a solution."""
FEW = 7
"""Solutions of a model that a step may take, for the model to serve on."""


class Proposal(eqx.Module):
    """The step that is proposed, the model, its factors, steps that it has served, solutions for this one."""

    model: Model
    factors: Factors
    kept: Int[Array, ""]
    corrections: Int[Array, ""]
    direction: Direction
    slope: Float[Array, ""]
    barrier: Float[Array, ""]
    shift: Float[Array, ""]
    penalty: Float[Array, " c"]
    unreachable: Float[Array, " c"]
    saddle: Bool[Array, ""]
    convex: Bool[Array, ""]


def _weighted(iterate: Iterate) -> Weighted:
    """Slacks and multipliers of bounds eliminated from the model."""
    m, s, mu = iterate.multipliers, iterate.slacks, iterate.barrier
    path, end = m.path / s.path, m.end / s.end
    gap, last = iterate.path.stages.excess + s.path, iterate.path.end.excess + s.end
    return Weighted(path, mu / s.path - m.path + path * gap, end, mu / s.end - m.end + end * last)


def _convex(problem: OptimalControl, iterate: Iterate, found: Model, reach: Array) -> tuple[Factors, Array]:
    """Factors of the model, its curvature increased until it is convex, and its shift."""
    bounds = _weighted(iterate)
    idle = (jnp.arange(problem.steps) % problem.inputs.every != 0).astype(float)
    idle = jnp.broadcast_to(idle[:, None], (problem.steps, problem.channels))

    soft, known = iterate.softness, iterate.filter
    left = violation(known.units, soft, iterate.path, iterate.slacks) / (known.least / SMALL)
    held = iterate.unit * jnp.where(jnp.any(soft > 0), FIXED, HELD * jnp.clip(left, 0.0, 1.0))
    # Time and parameters, not the first coefficients of the inputs.
    held = jnp.where(jnp.arange(found.first.shape[1]) < iterate.unknowns.free.size, held, 0.0)

    def attempt(shift: Array) -> Factors:
        return factored(found, bounds, idle, shift, iterate.penalty, soft, reach, iterate.unit, held)

    # None is tried first, as long as steps are found.
    last = iterate.shift
    least = jnp.where(iterate.failures > 0, jnp.maximum(10.0 * last, SHIFT), 0.0)

    def body(carry: tuple) -> tuple:
        _, shift, begun = carry
        more = jnp.where(
            shift > least, GROWTH * shift, jnp.maximum(jnp.maximum(last / 3.0, 2.0 * least), SHIFT)
        )
        shift = jnp.where(begun, more, shift)
        return attempt(shift), shift, jnp.array(True)

    attempt, nothing = traced_once(attempt, least)
    factors, shift, _ = jax.lax.while_loop(
        lambda carry: ~carry[2] | (~carry[0].convex & (carry[1] < LARGEST_SHIFT)),
        body,
        (nothing, least, jnp.array(False)),
    )
    return factors, shift


def _penalty(iterate: Iterate, factors: Factors) -> Array:
    """Penalties on the goal, from its compliance in the first model."""
    compliance = jnp.diagonal(factors.compliance)
    reached = compliance > 1e-12 * jnp.max(compliance, initial=0.0)
    found = jnp.where(reached, 1.0 / jnp.where(reached, compliance, 1.0), 0.0)
    found = jnp.where(iterate.softness > 0, 0.0, found)
    return jnp.where(iterate.iteration == 0, found, iterate.penalty)


def _direction(problem: OptimalControl, options: Options, iterate: Iterate, better: Improved) -> Direction:
    """Directions of coefficients, of what is free, of the unknowns of the steps, slacks and multipliers."""
    unknowns, sweep = as_unknowns(problem, iterate, better.change), better.sweep
    if options.lifted:
        unknowns = eqx.tree_at(lambda u: u.y, unknowns, sweep.y)
    s = iterate.slacks
    slack = -(iterate.path.stages.excess + s.path) - sweep.excess
    last = -(iterate.path.end.excess + s.end) - sweep.end_excess
    motion = iterate.multipliers.motion
    if motion is not None:
        motion = iterate.derivatives.worth.residuals + sweep.motion - motion
    multipliers = Multipliers(better.change.goal, better.change.path, better.change.end, motion)
    return Direction(unknowns, multipliers, Slacks(slack, last))


def _slope(problem: OptimalControl, iterate: Iterate, better: Improved, slacks: Slacks) -> Array:
    """Slope of the barrier cost: that of the Lagrangian without what constraints change in it."""
    change, sweep, derivatives = better.change, better.sweep, iterate.derivatives
    m, s, mu = iterate.multipliers, iterate.slacks, iterate.barrier
    enters = (jnp.arange(problem.steps) % problem.inputs.every == 0)[:, None]
    lagrangian = jnp.sum(derivatives.by_w * jnp.where(enters, change.w, 0.0))
    lagrangian = lagrangian + derivatives.by_first @ change.first
    # The equations of all steps hold at the end of the direction, to first order.
    closed = -jnp.sum(derivatives.worth.residuals * iterate.path.stages.residual)
    bounds = jnp.sum(m.path * sweep.excess) + jnp.sum(m.end * sweep.end_excess)
    rooms = jnp.sum(mu / s.path * slacks.path) + jnp.sum(mu / s.end * slacks.end)
    soft = missed(iterate.softness, iterate.path.end.missing) @ sweep.missing
    return lagrangian - closed - m.goal @ sweep.missing - bounds - rooms + soft


def _lowered(iterate: Iterate) -> Array:
    """The barrier parameter of the next iteration: lower where the present one is solved.

    Waechter and Biegler, Math. Program. 106 (2006), equation (7), with errors in units of the cost. An
    iterate that is far from the present parameter's solution gets stuck at its bounds under a lower one.
    """
    s, m, mu, e = iterate.slacks, iterate.multipliers, iterate.barrier, iterate.errors
    count = max(1, s.path.size + s.end.size)
    central = largest(s.path * m.path - mu, s.end * m.end - mu) / iterate.unit
    missing = largest(jnp.stack([e.stationarity, central, e.bounds, e.goal, e.motion]))
    relative = count * mu / iterate.unit
    lower = iterate.unit / count * jnp.maximum(LEAST_BARRIER, jnp.minimum(0.2 * relative, relative**1.5))
    return jnp.where(missing < SOLVED * mu / iterate.unit, jnp.minimum(lower, mu), mu)


def no_model(derivatives: Derivatives, multipliers: Multipliers) -> Model:
    """A place for a model."""
    forth, steps = derivatives.maps.forth, derivatives.by_w.shape[0]
    z, m, f = forth.shape[2], derivatives.by_w.shape[1], derivatives.by_first.shape[0]
    h, c, e = multipliers.path.shape[1], multipliers.goal.shape[0], multipliers.end.shape[0]
    stages = ((steps, z, z + m), (steps, z + m, z + m), (steps, h, z + m))
    ends = ((z, z), (c, z), (e, z), (z, f), (f, f))
    return Model(*(jnp.zeros(shape) for shape in stages + ends))


class Attempt(NamedTuple):
    """A model and the step that follows from it.

    Attributes:
        model: formed at hand, or for an earlier step.
        kept: how many steps it has served before this one.
        factors: of the model.
        shift: of its curvature.
        reach: eigenvalues of the goal's compliance that count as zero.
        better: the step.
    """

    model: Model
    kept: Array
    factors: Factors
    shift: Array
    reach: Array
    better: Improved


def _attempt(problem: OptimalControl, iterate: Iterate) -> Attempt:
    """The step, by the last model where that serves, else by one that is formed here.

    A model only has to be near: steps obey the exact conditions, and a model that is not from here takes some
    more of its solutions, each of which is much less work. Where these do not get there, it is too far.
    """

    def formed() -> Model:
        return model(problem, iterate.path, iterate.unknowns, iterate.multipliers, iterate.derivatives)

    def made(fresh: Array, reach: Array) -> Attempt:
        found = jax.lax.cond(fresh, formed, lambda: iterate.model)
        factors, shift = _convex(problem, iterate, found, reach)
        better = improved(problem, iterate, found, factors, _weighted(iterate), iterate.penalty)
        return Attempt(found, jnp.where(fresh, 0, iterate.kept + 1), factors, shift, reach, better)

    def left_out(last: Attempt) -> Array:
        # Conditions that depend on each other along motions only, by conserved momenta, are nearly fulfilled
        # by a step that leaves them out. It makes worse those that inputs only reach with difficulty.
        return (last.reach > REACH[0]) & (largest(last.better.unreachable) > LEFT_OUT * iterate.errors.goal)

    def unserved(carry: tuple[Array, Attempt]) -> Array:
        turn, last = carry
        poor = ~(last.better.there & last.factors.convex)
        return (turn == 0) | ((turn == 1) & (last.kept > 0) & poor) | left_out(last)

    def body(carry: tuple[Array, Attempt]) -> tuple[Array, Attempt]:
        turn, last = carry
        # A model that was not convex would need its shift again, which a new one may not.
        near = (iterate.step >= 1.0) & (iterate.moved < NEAR) & (iterate.shift < SHIFT)
        # The first one knows no multipliers, and bends as little at a saddle as at a minimum.
        near = near & (iterate.iteration > 1)
        fresh = ~near | (iterate.failures > 0) | (iterate.corrections > FEW) | (turn > 0)
        reach = jnp.where(left_out(last), REACH[0], jnp.clip(30.0 * iterate.errors.motion, *REACH))
        return turn + 1, made(fresh, reach)

    made, nothing = traced_once(made, jnp.array(True), jnp.asarray(REACH[0]))
    return jax.lax.while_loop(unserved, body, (jnp.array(0), nothing))[1]


@compiled
def propose(problem: OptimalControl, options: Options, iterate: Iterate) -> Proposal:
    """The next step, from the quadratic model."""
    iterate = eqx.tree_at(lambda i: i.barrier, iterate, _lowered(iterate))
    found = _attempt(problem, iterate)
    direction = _direction(problem, options, iterate, found.better)
    slope = _slope(problem, iterate, found.better, direction.slacks)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(direction)]))
    return Proposal(
        found.model,
        found.factors,
        found.kept,
        found.better.count,
        direction,
        slope,
        iterate.barrier,
        found.shift,
        _penalty(iterate, found.factors),
        found.better.unreachable,
        found.better.saddle & (found.shift > SHIFT),
        found.factors.convex & finite,
    )


@compiled
def softest(problem: OptimalControl, iterate: Iterate) -> tuple[Array, Change, Array]:
    """The direction in which the Lagrangian is curved least while all conditions hold to first order.

    Found in the model, by inverse iteration; the curvature is that of the steps themselves.

    Returns:
        The curvature along it [cost per square of a coefficient], the direction of unit length, and the
        largest curvature in a coefficient; where the cost has none, the least that bounds add.
    """
    found = model(problem, iterate.path, iterate.unknowns, iterate.multipliers, iterate.derivatives)
    factors, _ = _convex(problem, iterate, found, jnp.clip(30.0 * iterate.errors.motion, *REACH))
    along, bounds = least_curved(problem, iterate, factors, MANY), _weighted(iterate)
    length = jnp.sqrt(jnp.sum(along.w**2) + jnp.sum(along.first**2))
    along = jax.tree.map(lambda x: x / jnp.where(length > 0, length, 1.0), along)
    left, sweep = left_of_conditions(problem, iterate, bounds, factors.added, along, jnp.zeros(()))
    own = jnp.diagonal(found.hessian, axis1=1, axis2=2)[:, -problem.channels :]
    own = jnp.max(jnp.abs(own), initial=0.0)
    # Costs that are linear in the inputs have none of their own: only bounds bend them.
    steep = found.excess[:, :, -problem.channels :] ** 2
    pressed = jnp.min(jnp.einsum("kh,khm->km", bounds.path, steep))
    value = curvature(along, times(along, left), sweep, bounds, factors.added)
    return value, along, jnp.where(own > FLAT * pressed, own, pressed)
