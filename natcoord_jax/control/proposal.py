"""The step that the quadratic model proposes: made convex, corrected, with its merit function."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.iterate import Derivatives, Iterate, Model, Options, Slacks, largest
from natcoord_jax.control.linearisation import nodes_before
from natcoord_jax.control.merit import Direction, Violations, slope_and_weights
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.quadratic import model
from natcoord_jax.control.riccati import REACH, Move, Weighted, solve
from natcoord_jax.control.transcription import (
    Node,
    Unknowns,
    end,
    entering,
    first_node,
    slices,
    stage,
)
from natcoord_jax.core.compiled import quickly

SHIFT = 1e-4
"""First increase of the curvature where the model is not convex."""
LARGEST_SHIFT = 1e8
STIFFEST = 1e3
"""Largest penalty on the goal, in units of its stiffness."""
LEAST_BARRIER = 1e-10
"""Barrier parameter at the end, relative to the cost."""
REFINEMENTS = 1
"""Corrections of a step, so that the goal is met to first order of the exact motion."""


NEAR = 0.1
"""Relative size of a step after which the model it came from may serve another one."""
GAIN = 0.2
"""Part of the errors that a step of an old model may leave, for the model to serve on."""


class Proposal(eqx.Module):
    """The step that the quadratic model proposes, the model, and how many steps that has served."""

    model: Model | None
    kept: Int[Array, ""]
    direction: Direction
    slope: Float[Array, ""]
    weights: Violations
    barrier: Float[Array, ""]
    shift: Float[Array, ""]
    penalty: Float[Array, " c"]
    unreachable: Float[Array, " c"]
    convex: Bool[Array, ""]


def _weighted(iterate: Iterate) -> Weighted:
    """Slacks and multipliers of bounds eliminated from the model."""
    m, s, mu = iterate.multipliers, iterate.slacks, iterate.barrier
    path, end = m.path / s.path, m.end / s.end
    gap, last = iterate.path.stages.excess + s.path, iterate.path.end.excess + s.end
    return Weighted(path, mu / s.path - m.path + path * gap, end, mu / s.end - m.end + end * last)


class Weights(eqx.Module):
    """What makes the model convex: penalty on the goal, shift of the curvature, and what counts as reach."""

    penalty: Float[Array, " c"]
    shift: Float[Array, ""]
    reach: Float[Array, ""]
    idle: Float[Array, "steps m"]


def _convex(problem: OptimalControl, iterate: Iterate, found: Model) -> tuple[Move, Weights]:
    """The solution of the model, its curvature increased until it is convex."""
    bounds = _weighted(iterate)
    idle = (jnp.arange(problem.steps) % problem.inputs.every != 0).astype(float)
    idle = jnp.broadcast_to(idle[:, None], (problem.steps, problem.channels))
    reach = jnp.clip(30.0 * iterate.errors.motion, *REACH)

    def with_weights(stiffness: Array, shift: Array) -> Weights:
        return Weights(stiffness * iterate.penalty, shift, reach, idle)

    def attempt(stiffness: Array, shift: Array) -> Move:
        w = with_weights(stiffness, shift)
        missing, goal = iterate.path.end.missing, iterate.multipliers.goal
        return solve(found, missing, bounds, w.idle, w.shift, w.penalty, goal, w.reach)

    def unfinished(carry: tuple) -> Array:
        move, _, shift, begun = carry
        return ~begun | (~move.convex & (shift < LARGEST_SHIFT))

    def body(carry: tuple) -> tuple:
        # A penalty on the goal bends the model only where the goal forbids a change; it is tried first.
        _, stiffness, shift, begun = carry
        exhausted = begun & (stiffness >= STIFFEST)
        shift = jnp.where(exhausted, jnp.maximum(10.0 * shift, SHIFT), shift)
        stiffness = jnp.where(begun & ~exhausted, 10.0 * stiffness, stiffness)
        return attempt(stiffness, shift), stiffness, shift, jnp.array(True)

    start = jnp.where(iterate.failures > 0, jnp.maximum(10.0 * iterate.shift, SHIFT), 0.1 * iterate.shift)
    start = jnp.where(start < SHIFT, 0.0, start)
    shapes = jax.eval_shape(attempt, start, start)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    first = (nothing, jnp.ones(()), start, jnp.array(False))
    move, stiffness, shift, _ = jax.lax.while_loop(unfinished, body, first)
    return move, with_weights(stiffness, shift)


def _penalty(iterate: Iterate, move: Move) -> Array:
    """Penalties on the goal, from its compliance in the first model."""
    compliance = jnp.diagonal(move.compliance)
    reached = compliance > 1e-12 * jnp.max(compliance, initial=0.0)
    found = jnp.where(reached, 1.0 / jnp.where(reached, compliance, 1.0), 0.0)
    return jnp.where(iterate.iteration == 0, found, iterate.penalty)


class Sweep(eqx.Module):
    """First-order changes along a direction, exact: of the steps' unknowns, excesses, and the goal."""

    y: Float[Array, "steps n"]
    excess: Float[Array, "steps h"]
    missing: Float[Array, " c"]
    end_excess: Float[Array, " e"]


def _swept(problem: OptimalControl, iterate: Iterate, change: Unknowns) -> Sweep:
    """Changes that make the linearised residuals of all steps vanish."""
    unknowns, path = iterate.unknowns, iterate.path
    leading = problem.inputs.degree
    given = (unknowns.free, unknowns.coefficients[:leading])
    given_change = (change.free, change.coefficients[:leading])
    start = jax.jvp(lambda *x: first_node(problem, *x), given, given_change)[1]
    w, dw = entering(problem, unknowns.coefficients), entering(problem, change.coefficients)

    def body(dn, given):
        at, node, w, dw, y, jacobian, residual = given
        moved = residual + jacobian.by_node @ ravel_pytree(dn)[0] + jacobian.by_w @ dw
        dy = -(jacobian.inverses @ moved)

        def rest(node: Node, w: Array, y: Array) -> tuple[Node, Array]:
            found = stage(problem, at, node, w, y)
            return found.after, found.excess

        after, excess = jax.jvp(rest, (node, w, y), (dn, dw, dy))[1]
        return after, (dy, excess)

    jacobians, residual = iterate.derivatives.jacobians, path.stages.residual
    given = (slices(problem), nodes_before(path), w, dw, unknowns.y, jacobians, residual)
    last, (y, excess) = jax.lax.scan(body, start, given)
    final = jax.tree.map(lambda x: x[-1], path.nodes)
    reached = jax.jvp(lambda node: end(problem, node), (final,), (last,))[1]
    return Sweep(y, excess, reached.missing, reached.excess)


def _refined(
    problem: OptimalControl, iterate: Iterate, found: Model, move: Move, weights: Weights
) -> tuple[Unknowns, Array, Sweep, tuple[Array, Array]]:
    """The move of the model, corrected until the goal is met to first order exactly.

    Returns:
        Changes of coefficients and of what is free, of the goal's multipliers, the exact sweep, and the
        changes of the excesses in the model.
    """
    count = iterate.unknowns.free.size
    every, leading = problem.inputs.every, problem.inputs.degree
    level = jax.tree.map(jnp.zeros_like, (found.gradient, found.offset, found.first_gradient))
    flat = eqx.tree_at(lambda m: (m.gradient, m.offset, m.first_gradient), found, level)
    bounds = _weighted(iterate)
    eased = Weighted(bounds.path, jnp.zeros_like(bounds.path), bounds.end, jnp.zeros_like(bounds.end))
    flat = eqx.tree_at(lambda m: m.excess_offset, flat, jnp.zeros_like(flat.excess_offset))

    def changed(first: Array, w: Array) -> Unknowns:
        head = first[count:].reshape(leading, problem.channels)
        return Unknowns(
            jnp.concatenate([head, w[::every]]), first[:count], jnp.zeros_like(iterate.unknowns.y)
        )

    def body(k: Array, carry: tuple) -> tuple:
        first, w, goal, z, sweep = carry
        missing = iterate.path.end.missing + sweep.missing
        none = jnp.zeros_like(goal)
        more = solve(flat, missing, eased, weights.idle, weights.shift, weights.penalty, none, weights.reach)
        # The first turn only sweeps: so everything is compiled once.
        usable = (k > 0) & more.convex & jnp.all(jnp.isfinite(more.w))
        pairs = ((first, more.first), (w, more.w), (goal, more.goal), (z, more.z))
        first, w, goal, z = (x + jnp.where(usable, dx, 0.0) for x, dx in pairs)
        return first, w, goal, z, _swept(problem, iterate, changed(first, w))

    path = iterate.path
    still = Sweep(
        *(
            jnp.zeros_like(x)
            for x in (iterate.unknowns.y, path.stages.excess, path.end.missing, path.end.excess)
        )
    )
    begun = (move.first, move.w, move.goal, move.z, still)
    first, w, goal, z, sweep = jax.lax.fori_loop(0, REFINEMENTS + 1, body, begun)
    both = jnp.concatenate([z[:-1], w], axis=1)
    excess = jnp.einsum("khz,kz->kh", found.excess, both) + found.excess_offset
    return changed(first, w), goal, sweep, (excess, found.last_excess @ z[-1])


def _direction(
    problem: OptimalControl, options: Options, iterate: Iterate, found: Model, move: Move, weights: Weights
) -> Direction:
    """Directions of coefficients, of what is free, of the unknowns of the steps, slacks and multipliers."""
    unknowns, goal, sweep, excess = _refined(problem, iterate, found, move, weights)
    if options.lifted:
        unknowns = eqx.tree_at(lambda u: u.y, unknowns, sweep.y)
    s, m, mu = iterate.slacks, iterate.multipliers, iterate.barrier
    slack = -(iterate.path.stages.excess + s.path) - sweep.excess
    last = -(iterate.path.end.excess + s.end) - sweep.end_excess
    # Multipliers are those of the model: where a bound is stiff, the little by which its excess differs from
    # the exact one would be a force.
    felt = -(iterate.path.stages.excess + s.path) - excess[0]
    felt_last = -(iterate.path.end.excess + s.end) - excess[1]
    path = (mu - m.path * felt) / s.path - m.path
    ends = (mu - m.end * felt_last) / s.end - m.end
    return Direction(unknowns, Multipliers(goal, path, ends), Slacks(slack, last))


def _lowered(iterate: Iterate) -> Array:
    """The barrier parameter of the next iteration: lower where the present one is nearly solved."""
    s, m, mu, e = iterate.slacks, iterate.multipliers, iterate.barrier, iterate.errors
    count = max(1, s.path.size + s.end.size)
    unit = iterate.unit / count
    relative = mu / unit
    central = largest(s.path * m.path - mu, s.end * m.end - mu) / unit
    missing = jnp.maximum(jnp.maximum(e.stationarity, central), jnp.maximum(e.bounds, e.goal))
    lower = unit * jnp.maximum(LEAST_BARRIER, jnp.minimum(0.2 * relative, relative**1.5))
    return jnp.where(missing < 10.0 * relative, jnp.minimum(lower, mu), mu)


def no_model(derivatives: Derivatives, multipliers: Multipliers) -> Model:
    """A place for a model."""
    forth, steps = derivatives.maps.forth, derivatives.by_w.shape[0]
    z, m, f = forth.shape[2], derivatives.by_w.shape[1], derivatives.by_first.shape[0]
    h, c, e = multipliers.path.shape[1], multipliers.goal.shape[0], multipliers.end.shape[0]
    stages = (
        (steps, z, z + m),
        (steps, z),
        (steps, z + m, z + m),
        (steps, z + m),
        (steps, h, z + m),
        (steps, h),
    )
    ends = ((z, z), (c, z), (e, z), (z, f), (f, f), (f,))
    return Model(*(jnp.zeros(shape) for shape in stages + ends))


def _modelled(problem: OptimalControl, options: Options, iterate: Iterate) -> tuple[Model, Array]:
    """The quadratic model: formed here, or the last one with the gradient from here where that will do.

    Near the end the curvature hardly changes from step to step, and it is most of the work. A motion that
    obeys its equations has no offsets, so that only the gradient has to be new.
    """

    def formed() -> tuple[Model, Array]:
        found = model(problem, iterate.path, iterate.unknowns, iterate.multipliers, iterate.derivatives)
        return found, jnp.zeros_like(iterate.kept)

    last = iterate.model
    if last is None:
        return formed()

    def kept() -> tuple[Model, Array]:
        by_w, by_first = iterate.derivatives.by_w, iterate.derivatives.by_first
        gradient = jnp.zeros_like(last.gradient).at[:, -by_w.shape[1] :].set(by_w)
        found = eqx.tree_at(lambda m: (m.gradient, m.first_gradient), last, (gradient, by_first))
        return found, iterate.kept + 1

    near = (iterate.step >= 1.0) & (iterate.moved < NEAR) & (iterate.failures == 0)
    return jax.lax.cond(near & ((iterate.kept == 0) | (iterate.gain < GAIN)), kept, formed)


@quickly
def propose(problem: OptimalControl, options: Options, iterate: Iterate) -> Proposal:
    """The next step, from the quadratic model."""
    iterate = eqx.tree_at(lambda i: i.barrier, iterate, _lowered(iterate))
    found, kept = _modelled(problem, options, iterate)
    move, made = _convex(problem, iterate, found)
    direction = _direction(problem, options, iterate, found, move, made)
    slope, weights = slope_and_weights(iterate, direction, problem.inputs.every)
    penalty = _penalty(iterate, move)
    return Proposal(
        None if options.lifted else found,
        kept,
        direction,
        slope,
        weights,
        iterate.barrier,
        made.shift,
        penalty,
        move.unreachable,
        move.convex,
    )
