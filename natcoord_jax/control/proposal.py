"""The step that the quadratic model proposes: made convex, and corrected."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.iterate import Iterate, Model, Options, Slacks, largest
from natcoord_jax.control.line_search import SMALL, Direction, missed, violation
from natcoord_jax.control.newton import Newton, as_unknowns, curvature, least_curved, newton
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.quadratic import model
from natcoord_jax.control.riccati import REACH, Factors, Move, Weighted, factored
from natcoord_jax.control.transcription import enters_in
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
MANY = 60
"""Inverse iterations that find the least curvature of a solution."""


class Proposal(eqx.Module):
    """The step that is proposed, the model and its factors."""

    model: Model
    factors: Factors
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


def _idle(problem: OptimalControl) -> Array:
    """1 for coefficients that do not enter in a step, else 0."""
    return jnp.broadcast_to(~enters_in(problem), (problem.steps, problem.channels)).astype(float)


def unshifted(problem: OptimalControl, iterate: Iterate, found: Model, bounds: Weighted) -> Factors:
    """Factors of the model at an optimum, nothing added to its curvature."""
    none, held = jnp.zeros(()), jnp.zeros(found.first.shape[1])
    soft, reach = iterate.softness, jnp.asarray(REACH[0])
    penalty, unit = iterate.penalty, iterate.unit
    return factored(found, bounds, _idle(problem), none, penalty, soft, reach, unit, held, none)


def _convex(problem: OptimalControl, iterate: Iterate, found: Model, reach: Array) -> tuple[Factors, Array]:
    """Factors of the model, its curvature increased until it is convex, and its shift."""
    bounds = _weighted(iterate)
    soft, known = iterate.softness, iterate.filter
    left = violation(known.units, soft, iterate.path, iterate.slacks) / (known.least / SMALL)
    held = iterate.unit * jnp.where(jnp.any(soft > 0), FIXED, HELD * jnp.clip(left, 0.0, 1.0))
    # Time and parameters, not the first coefficients of the inputs.
    held = jnp.where(jnp.arange(found.first.shape[1]) < iterate.unknowns.free.size, held, 0.0)

    def attempt(shift: Array) -> Factors:
        sway, unit = iterate.sway, iterate.unit
        return factored(found, bounds, _idle(problem), shift, iterate.penalty, soft, reach, unit, held, sway)

    # None is tried first, as long as steps are found.
    last = iterate.shift
    least = jnp.where(iterate.failures > 0, jnp.maximum(10.0 * last, SHIFT), 0.0)

    def body(carry: tuple) -> tuple:
        _, shift, begun = carry
        begin = jnp.maximum(jnp.where(last > 0, last / 3.0, SHIFT), 2.0 * least)
        more = jnp.where(shift > least, GROWTH * shift, begin)
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
    return jnp.where(iterate.iteration < 0, found, iterate.penalty)


def _direction(problem: OptimalControl, options: Options, iterate: Iterate, step: Newton) -> Direction:
    """Directions of coefficients, of what is free, of the unknowns of the steps, slacks and multipliers."""
    change, s = step.change, iterate.slacks
    unknowns = as_unknowns(problem, iterate, change.move)
    if options.lifted:
        unknowns = eqx.tree_at(lambda u: u.y, unknowns, change.y)
    slack = -(iterate.path.stages.excess + s.path) - change.excess
    last = -(iterate.path.end.excess + s.end) - change.end_excess
    motion = iterate.multipliers.motion
    if motion is not None:
        motion = iterate.derivatives.worth.residuals + step.motion - motion
    multipliers = Multipliers(change.move.goal, change.path, change.end, motion)
    return Direction(unknowns, multipliers, Slacks(slack, last))


def _slope(problem: OptimalControl, iterate: Iterate, step: Newton, slacks: Slacks) -> Array:
    """Slope of the barrier cost: that of the Lagrangian without what constraints change in it."""
    change, derivatives = step.change, iterate.derivatives
    m, s, mu = iterate.multipliers, iterate.slacks, iterate.barrier
    lagrangian = jnp.sum(derivatives.by_w * jnp.where(enters_in(problem), change.move.w, 0.0))
    lagrangian = lagrangian + derivatives.by_first @ change.move.first
    # The equations of all steps hold at the end of the direction, to first order.
    closed = -jnp.sum(derivatives.worth.residuals * iterate.path.stages.residual)
    bounds = jnp.sum(m.path * change.excess) + jnp.sum(m.end * change.end_excess)
    rooms = jnp.sum(mu / s.path * slacks.path) + jnp.sum(mu / s.end * slacks.end)
    soft = missed(iterate.softness, iterate.path.end.missing) @ change.missing
    return lagrangian - closed - m.goal @ change.missing - bounds - rooms + soft


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


class Attempt(NamedTuple):
    """A step and its model's factors.

    Attributes:
        factors: of the model.
        shift: of its curvature.
        reach: eigenvalues of the goal's compliance that count as zero.
        step: the step.
    """

    factors: Factors
    shift: Array
    reach: Array
    step: Newton


def _attempt(problem: OptimalControl, iterate: Iterate, found: Model) -> Attempt:
    """The step; once more where it leaves out too much of the goal."""

    def made(reach: Array) -> Attempt:
        factors, shift = _convex(problem, iterate, found, reach)
        return Attempt(factors, shift, reach, newton(problem, iterate, found, factors, _weighted(iterate)))

    def left_out(last: Attempt) -> Array:
        # Conditions that depend on each other along motions only, by conserved momenta, are nearly fulfilled
        # by a step that leaves them out. It makes worse those that inputs only reach with difficulty.
        return (last.reach > REACH[0]) & (largest(last.step.unreachable) > LEFT_OUT * iterate.errors.goal)

    def body(carry: tuple[Array, Attempt]) -> tuple[Array, Attempt]:
        turn, last = carry
        reach = jnp.where(turn > 0, REACH[0], jnp.clip(30.0 * iterate.errors.motion, *REACH))
        return turn + 1, made(reach)

    made, nothing = traced_once(made, jnp.asarray(REACH[0]))
    return jax.lax.while_loop(
        lambda carry: (carry[0] == 0) | left_out(carry[1]), body, (jnp.array(0), nothing)
    )[1]


def formed(problem: OptimalControl, iterate: Iterate) -> Model:
    """The quadratic model at an iterate."""
    return model(problem, iterate.path, iterate.unknowns, iterate.multipliers, iterate.derivatives)


@compiled
def propose(problem: OptimalControl, options: Options, iterate: Iterate) -> Proposal:
    """The next step, from the quadratic model."""
    iterate = eqx.tree_at(lambda i: i.barrier, iterate, _lowered(iterate))
    quadratic = formed(problem, iterate)
    found = _attempt(problem, iterate, quadratic)
    direction = _direction(problem, options, iterate, found.step)
    slope = _slope(problem, iterate, found.step, direction.slacks)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(direction)]))
    return Proposal(
        quadratic,
        found.factors,
        direction,
        slope,
        iterate.barrier,
        found.shift,
        _penalty(iterate, found.factors),
        found.step.unreachable,
        found.step.saddle & (found.shift > SHIFT),
        found.factors.convex & finite,
    )


@compiled
def curved_in_free(
    problem: OptimalControl, iterate: Iterate
) -> tuple[Float[Array, "f f"], Float[Array, "c f"]]:
    """Curvature of the Lagrangian in what is free, as all nodes follow it, and the slopes of the goal."""
    found, bounds = formed(problem, iterate), _weighted(iterate)
    size, still = found.forward.shape[1], jnp.zeros_like(iterate.derivatives.by_w)

    def forth(z: Array, forward: Array) -> tuple[Array, Array]:
        return forward[:, :size] @ z, z

    last, nodes = jax.lax.scan(forth, found.first, found.forward)
    nodes = jnp.concatenate([nodes, last[None]])

    def along(first: Array) -> Array:
        return 0.5 * curvature(found, bounds, Move(still, first, iterate.multipliers.goal, nodes @ first))

    return jax.hessian(along)(jnp.zeros(found.first.shape[1])), found.goal @ last


@compiled
def softest(problem: OptimalControl, iterate: Iterate) -> tuple[Array, Move, Array]:
    """The direction in which the Lagrangian is curved least while all conditions hold to first order.

    Found by inverse iteration.

    Returns:
        The curvature along it [cost per square of a coefficient], the direction of unit length, and the
        largest curvature in a coefficient, or the least that bounds add where that is larger.
    """
    found, bounds = formed(problem, iterate), _weighted(iterate)
    factors, _ = _convex(problem, iterate, found, jnp.clip(30.0 * iterate.errors.motion, *REACH))
    along = least_curved(problem, iterate, factors, MANY)
    length = jnp.sqrt(jnp.sum(along.w**2) + jnp.sum(along.first**2))
    along = jax.tree.map(lambda x: x / jnp.where(length > 0, length, 1.0), along)
    own = jnp.diagonal(found.hessian, axis1=1, axis2=2)[:, -problem.channels :]
    own = jnp.max(jnp.abs(own), initial=0.0)
    # Costs that are linear in the inputs have none of their own: only bounds bend them.
    steep = found.excess[:, :, -problem.channels :] ** 2
    pressed = jnp.min(jnp.einsum("kh,khm->km", bounds.path, steep))
    return curvature(found, bounds, along), along, jnp.maximum(own, pressed)
