"""The step of Newton's method for the conditions of optimality: the quadratic model's, with all that follows.

The model is exact, so that its solution obeys the conditions to first order: what the equations of the steps
leave goes in as a motion that leads there under the model's own feedback, and stays small where the motion
itself would not.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.control.iterate import Iterate, Model, largest
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.riccati import Factors, Move, Right, Weighted, out_of_reach, solve, taken_back
from natcoord_jax.control.transcription import Unknowns, enters_in
from natcoord_jax.xla.one_kernel import scan_in_one_kernel

ASIDE = 0.1
"""Size of the inputs' change that is asked for along negative curvature, relative to the inputs."""
STILL = 1e-2
"""Gradient of the Lagrangian, relative, below which a step is drawn aside: others know where to go."""
TURNS = 12
"""Inverse iterations that find its direction."""


class Change(eqx.Module):
    """A step, and what follows from it to first order.

    Attributes:
        move: of entering coefficients, of what is free, of the goal's multipliers and of the nodes.
        path: of the multipliers of the bounds of all steps.
        end: of those of the bounds at the end.
        y: of the steps' unknowns.
        excess: of the excesses over bounds.
        missing: of the goal's residual.
        end_excess: of the excesses at the end.
    """

    move: Move
    path: Float[Array, "steps h"]
    end: Float[Array, " e"]
    y: Float[Array, "steps n"]
    excess: Float[Array, "steps h"]
    missing: Float[Array, " c"]
    end_excess: Float[Array, " e"]


class Newton(eqx.Module):
    """The step.

    Attributes:
        change: the step.
        motion: worth of the residuals of the steps after it, less that before it.
        unreachable: part of the goal that nothing can change.
        saddle: whether the curvature is negative along the direction in which it is least.
    """

    change: Change
    motion: Float[Array, "steps n"]
    unreachable: Float[Array, " c"]
    saddle: Bool[Array, ""]


def as_unknowns(problem: OptimalControl, iterate: Iterate, move: Move) -> Unknowns:
    """Changes of the unknowns, without those of the steps."""
    count = iterate.unknowns.free.size
    head = move.first[count:].reshape(problem.inputs.degree, problem.channels)
    coefficients = jnp.concatenate([head, move.w[:: problem.inputs.every]])
    return Unknowns(coefficients, move.first[:count], jnp.zeros_like(iterate.unknowns.y))


def _both(move: Move) -> Float[Array, "steps zm"]:
    return jnp.concatenate([move.z[:-1], move.w], axis=1)


def closing(iterate: Iterate, residual: Float[Array, "steps n"]) -> Float[Array, "steps n"]:
    """Changes of the steps' unknowns that remove residuals, nodes and inputs kept."""
    return -jnp.einsum("kij,kj->ki", iterate.derivatives.jacobians.inverses, residual)


def constrained(
    found: Model, factors: Factors, bounds: Weighted, right: Right, dy: Float[Array, "steps n"]
) -> Move:
    """The minimum of the model where the steps' unknowns change by `dy` besides what nodes and inputs do.

    Args:
        found: the model.
        factors: of it.
        bounds: what slacks add.
        right: linear terms.
        dy: see `closing`.
    """
    pushed = jnp.einsum("kzn,kn->kz", found.forward_y, dy)

    def forth(z: Array, given: tuple) -> tuple[Array, tuple]:
        forward, gain, pushed = given
        w = gain @ z
        return forward @ jnp.concatenate([z, w]) + pushed, (z, w)

    begun = jnp.zeros(found.forward.shape[1])
    last, (z, w) = scan_in_one_kernel(forth, begun, (found.forward, factors.gain, pushed))
    led = Move(
        w, jnp.zeros_like(right.first), jnp.zeros_like(right.missing), jnp.concatenate([z, last[None]])
    )
    both = _both(led)
    pressed = bounds.path * jnp.einsum("khz,kz->kh", found.excess, both)
    gradient = right.gradient + jnp.einsum("kij,kj->ki", found.hessian, both)
    gradient = gradient + jnp.einsum("khz,kh->kz", found.excess, pressed)
    gradient = gradient.at[:, last.size :].add(factors.added[0] * w)
    end = found.last_hessian @ last + found.last_excess.T @ (bounds.end * (found.last_excess @ last))
    missing = found.goal @ last
    end = end + found.goal.T @ (factors.penalty * missing)
    move = solve(factors, Right(gradient, right.last + end, right.first, right.missing + missing))
    return jax.tree.map(jnp.add, move, led)


def followed(found: Model, bounds: Weighted, move: Move, dy: Float[Array, "steps n"]) -> Change:
    """All that follows from a solution of the model."""
    both, last = _both(move), move.z[-1]
    excess = jnp.einsum("khz,kz->kh", found.excess, both) + jnp.einsum("khn,kn->kh", found.excess_y, dy)
    end_excess = found.last_excess @ last
    return Change(
        move,
        bounds.path_slope + bounds.path * excess,
        bounds.end_slope + bounds.end * end_excess,
        dy + jnp.einsum("knz,kz->kn", found.y, both),
        excess,
        found.goal @ last,
        end_excess,
    )


def _motion(iterate: Iterate, found: Model, change: Change, dy: Array) -> Float[Array, "steps n"]:
    """What the worth of the steps' residuals changes by: one sweep backward."""
    both, size = _both(change.move), found.forward.shape[1]
    slope = jnp.einsum("knz,kz->kn", found.slope_y, both) + jnp.einsum("kij,kj->ki", found.bent_y, dy)
    slope = slope + jnp.einsum("khn,kh->kn", found.excess_y, change.path)
    gradient = jnp.einsum("kij,kj->ki", found.hessian, both) + jnp.einsum("knz,kn->kz", found.slope_y, dy)
    gradient = gradient + jnp.einsum("khz,kh->kz", found.excess, change.path)
    last = found.last_hessian @ change.move.z[-1] + found.last_excess.T @ change.end
    last = last + found.goal.T @ change.move.goal

    def body(after: Array, given: tuple) -> tuple[Array, Array]:
        slope, gradient, forward, forward_y, inverse = given
        motion = -(slope + forward_y.T @ after) @ inverse
        return gradient[:size] + (forward.T @ after)[:size], motion

    given = (slope, gradient, found.forward, found.forward_y, iterate.derivatives.jacobians.inverses)
    return scan_in_one_kernel(body, last, given, reverse=True)[1]


def least_curved(problem: OptimalControl, iterate: Iterate, factors: Factors, turns: Array | int) -> Move:
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
    enters = enters_in(problem)

    def again(_: Array, along: Move) -> Move:
        move = solve(factors, Right(jnp.pad(along.w, ((0, 0), (states, 0))), last, along.first, nothing))
        move = eqx.tree_at(lambda m: m.w, move, jnp.where(enters, move.w, 0.0))
        size = jnp.maximum(largest(move.first, move.w), 1e-300)
        return jax.tree.map(lambda x: x / size, move)

    # Without any symmetry.
    start = jnp.sin(1.0 + 2.4 * jnp.arange(by_w.size).reshape(by_w.shape))
    nodes = jnp.zeros((problem.steps + 1, states))
    along = Move(start, jnp.zeros_like(iterate.derivatives.by_first), nothing, nodes)
    along = jax.lax.fori_loop(0, turns, again, along)
    uphill = jnp.sum(by_w * along.w) + iterate.derivatives.by_first @ along.first > 0
    return jax.tree.map(lambda x: jnp.where(uphill, -x, x), along)


def curvature(found: Model, bounds: Weighted, along: Move) -> Float[Array, ""]:
    """Curvature of the Lagrangian along a direction, with what bounds add, nothing else."""
    both, last = _both(along), along.z[-1]
    own = jnp.einsum("ki,kij,kj->", both, found.hessian, both) + last @ found.last_hessian @ last
    pressed = jnp.sum(bounds.path * jnp.einsum("khz,kz->kh", found.excess, both) ** 2)
    pressed = pressed + jnp.sum(bounds.end * (found.last_excess @ last) ** 2)
    return own + pressed + along.first @ found.first_hessian @ along.first


def _stiffened(found: Model, added: Array) -> Model:
    """The model with curvature added in the unknowns of the steps."""
    hessian = found.hessian + added * jnp.einsum("kni,knj->kij", found.y, found.y)
    bent_y = found.bent_y + added * jnp.eye(found.y.shape[1])
    parts = hessian, found.slope_y + added * found.y, bent_y
    return eqx.tree_at(lambda m: (m.hessian, m.slope_y, m.bent_y), found, parts)


def newton(
    problem: OptimalControl, iterate: Iterate, found: Model, factors: Factors, bounds: Weighted
) -> Newton:
    """The step that obeys the conditions of optimality to first order.

    Args:
        problem: the problem.
        iterate: the motion.
        found: the model.
        factors: of it.
        bounds: what slacks add.
    """
    derivatives, missing = iterate.derivatives, iterate.path.end.missing
    added, look = factors.added, factors.added[0] > 0
    soft = least_curved(problem, iterate, factors, jnp.where(look, TURNS, 0))
    falling = look & (curvature(found, bounds, soft) < 0)
    # A motion that is as symmetric as its problem may be stationary and no minimum: nothing in the conditions
    # leads out of the symmetry, but a force along negative curvature does.
    size = largest(iterate.unknowns.coefficients)
    away = jnp.where(falling & (iterate.errors.stationarity < STILL), ASIDE, 0.0)
    away = away * jnp.where(size > 0, size, 1.0)
    found = _stiffened(found, added[2])
    dy = closing(iterate, iterate.path.stages.residual)
    pressed = bounds.path_slope + bounds.path * jnp.einsum("khn,kn->kh", found.excess_y, dy)
    gradient = jnp.einsum("knz,kn->kz", found.slope_y, dy) + jnp.einsum("khz,kh->kz", found.excess, pressed)
    by_w = jnp.where(enters_in(problem), derivatives.by_w - away * added[0] * soft.w, 0.0)
    states = found.forward.shape[1]
    back = taken_back(factors, iterate.multipliers.goal)
    end = found.last_excess.T @ bounds.end_slope + found.goal.T @ (factors.penalty * missing + back)
    first = derivatives.by_first - away * added[1] * soft.first
    right = Right(gradient + jnp.pad(by_w, ((0, 0), (states, 0))), end, first, missing)
    move = constrained(found, factors, bounds, right, dy)
    move = eqx.tree_at(lambda m: m.goal, move, move.goal + back)
    change = followed(found, bounds, move, dy)
    unreachable = jnp.where(iterate.softness > 0, 0.0, out_of_reach(factors, missing + change.missing))
    return Newton(change, _motion(iterate, found, change, dy), unreachable, falling)
