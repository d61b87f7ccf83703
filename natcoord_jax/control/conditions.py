"""The conditions of optimality to first order about a motion, of the steps as they are.

The quadratic model is that of steps whose velocities are projected (see `tangent`): its solution leaves a
part of order dt^2 of these conditions. Here they are applied to any change: one sweep forward for the motion,
one backward for what it is worth. First derivatives are exact, the curvature along the change is that of
the same steps by a central difference, good to some eight digits.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.costates import scored_end, through_step
from natcoord_jax.control.differences import Point, along, sizes
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.linearisation import first_gradient, nodes_before
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.riccati import Weighted
from natcoord_jax.control.transcription import Node, Unknowns, end, entering, first_node, slices, stage
from natcoord_jax.xla.one_kernel import scan_in_one_kernel


class Change(eqx.Module):
    """Changes that are solved for, or what they leave of the conditions.

    Attributes:
        first: of what is free and of leading coefficients; or the gradient there.
        w: of entering coefficients; or the gradient there.
        goal: of the goal's multipliers; or the goal's residual.
        path: of the multipliers of the bounds of all steps; or what they lack to complementarity.
        end: of those of the bounds at the end.
    """

    first: Float[Array, " f"]
    w: Float[Array, "steps m"]
    goal: Float[Array, " c"]
    path: Float[Array, "steps h"]
    end: Float[Array, " e"]


class Sweep(eqx.Module):
    """First-order changes along a direction.

    Attributes:
        y: of the steps' unknowns.
        excess: of the excesses over bounds.
        missing: of the goal's residual.
        end_excess: of the excesses at the end.
        motion: of the multipliers of the steps' equations.
    """

    y: Float[Array, "steps n"]
    excess: Float[Array, "steps h"]
    missing: Float[Array, " c"]
    end_excess: Float[Array, " e"]
    motion: Float[Array, "steps n"]


def as_unknowns(problem: OptimalControl, iterate: Iterate, change: Change) -> Unknowns:
    """Changes of the unknowns, without those of the steps."""
    count = iterate.unknowns.free.size
    head = change.first[count:].reshape(problem.inputs.degree, problem.channels)
    coefficients = jnp.concatenate([head, change.w[:: problem.inputs.every]])
    return Unknowns(coefficients, change.first[:count], jnp.zeros_like(iterate.unknowns.y))


class Linear(NamedTuple):
    """Changes along a direction that make the linearised equations of all steps hold.

    Attributes:
        before: of the nodes before every step, as vectors.
        last: of the last node.
        w: of entering coefficients.
        sweep: the rest.
    """

    before: Float[Array, "steps x"]
    last: Float[Array, " x"]
    w: Float[Array, "steps m"]
    sweep: Sweep


def swept(problem: OptimalControl, iterate: Iterate, change: Change, level: Array) -> Linear:
    """The motion's change; level 1 makes the residuals of the steps vanish, level 0 keeps them."""
    unknowns, path = iterate.unknowns, iterate.path
    moved = as_unknowns(problem, iterate, change)
    leading = problem.inputs.degree
    given = (unknowns.free, unknowns.coefficients[:leading])
    given_change = (moved.free, moved.coefficients[:leading])
    start = jax.jvp(lambda *x: first_node(problem, *x), given, given_change)[1]
    w, dw = entering(problem, unknowns.coefficients), entering(problem, moved.coefficients)
    unflat = ravel_pytree(start)[1]

    def body(dn: Array, given: tuple) -> tuple[Array, tuple]:
        at, node, w, dw, y, jacobian, residual = given
        dy = -(jacobian.inverses @ (level * residual + jacobian.by_node @ dn + jacobian.by_w @ dw))

        def rest(node: Node, w: Array, y: Array) -> tuple[Array, Array]:
            found = stage(problem, at, node, w, y)
            return ravel_pytree(found.after)[0], found.excess

        after, excess = jax.jvp(rest, (node, w, y), (unflat(dn), dw, dy))[1]
        return after, (dn, dy, excess)

    jacobians, residual = iterate.derivatives.jacobians, path.stages.residual
    given = (slices(problem), nodes_before(path), w, dw, unknowns.y, jacobians, residual)
    last, (before, y, excess) = scan_in_one_kernel(body, ravel_pytree(start)[0], given)
    final = jax.tree.map(lambda x: x[-1], path.nodes)
    reached = jax.jvp(lambda node: end(problem, node), (final,), (unflat(last),))[1]
    return Linear(before, last, dw, Sweep(y, excess, reached.missing, reached.excess, jnp.zeros_like(y)))


def _curved(
    problem: OptimalControl, iterate: Iterate, change: Change, linear: Linear
) -> tuple[Array, Array, Array]:
    """Changes of the Lagrangian's gradient along a change and that of the motion.

    Returns:
        The gradient's change in `first`, and in `w`, and that of the multipliers of the motion.
    """
    unknowns, path, multipliers = iterate.unknowns, iterate.path, iterate.multipliers
    worth, jacobians = iterate.derivatives.bending, iterate.derivatives.jacobians
    w = entering(problem, unknowns.coefficients)
    final, unflat = ravel_pytree(jax.tree.map(lambda x: x[-1], path.nodes))
    size = sizes(problem, path, unknowns)

    def bent(at, node, w, y, after, rho, direction: Point, bounds: tuple) -> tuple[Array, ...]:
        value = ravel_pytree(after)[0]

        def slopes(node: Array, w: Array, y: Array, sigma: Array) -> tuple:
            def lagrangian(node: Array, w: Array, y: Array) -> Array:
                found = stage(problem, at, unflat(node), w, y)
                carried = value @ ravel_pytree(found.after)[0]
                return found.cost + carried + rho @ found.residual + sigma @ found.excess

            return jax.grad(lagrangian, argnums=(0, 1, 2))(node, w, y)

        return along(slopes, Point(ravel_pytree(node)[0], w, y), direction, size, bounds)

    following = jax.tree.map(lambda x: x[1:], worth.nodes)
    each = (slices(problem), nodes_before(path), w, unknowns.y)
    direction = Point(linear.before, linear.w, linear.sweep.y)
    by_node, by_w, by_y = jax.vmap(bent)(
        *each, following, worth.residuals, direction, (multipliers.path, change.path)
    )

    def scored(node: Array, goal: Array, end: Array) -> Array:
        given = eqx.tree_at(lambda m: (m.goal, m.end), multipliers, (goal, end))
        return jax.grad(lambda node: scored_end(problem, given, unflat(node)))(node)

    there, moved = (final, multipliers.goal, multipliers.end), (linear.last, change.goal, change.end)
    last = jax.jvp(scored, there, moved)[1]

    def body(after: Array, given: tuple) -> tuple[Array, tuple[Array, Array]]:
        at, node, w, y, jacobian, by_node, by_w, by_y = given
        before, more, motion = through_step(problem, at, node, w, y, jacobian)(after, by_y)
        return before + by_node, (more + by_w, motion)

    first, (by_w, motion) = scan_in_one_kernel(
        body, last, (*each, jacobians, by_node, by_w, by_y), reverse=True
    )
    value = ravel_pytree(jax.tree.map(lambda x: x[0], worth.nodes))[0]

    def slope(unknowns: Unknowns, value: Array) -> Array:
        return first_gradient(problem, unknowns, value)

    tangent = as_unknowns(problem, iterate, change)
    return jax.jvp(slope, (unknowns, value), (tangent, first))[1], by_w, motion


def left_of_conditions(
    problem: OptimalControl,
    iterate: Iterate,
    bounds: Weighted,
    added: tuple[Array, Array],
    change: Change,
    level: Array,
) -> tuple[Change, Sweep]:
    """What a change leaves of the conditions, to first order, and the sweep along it.

    Args:
        problem: the problem.
        iterate: the motion.
        bounds: what slacks add.
        added: to the curvature in entering coefficients, and in what is free.
        change: of coefficients and multipliers.
        level: 1 for the conditions at the changed motion, 0 for their change alone.
    """
    linear = swept(problem, iterate, change, level)
    sweep, derivatives = linear.sweep, iterate.derivatives
    first, w, motion = _curved(problem, iterate, change, linear)
    sweep = eqx.tree_at(lambda s: s.motion, sweep, motion)
    enters = (jnp.arange(problem.steps) % problem.inputs.every == 0)[:, None]
    w = jnp.where(enters, level * derivatives.by_w + w + added[0] * change.w, 0.0)
    first = level * derivatives.by_first + first + added[1] * change.first
    missing = level * iterate.path.end.missing + sweep.missing - iterate.softness * change.goal
    path = change.path - level * bounds.path_slope - bounds.path * sweep.excess
    last = change.end - level * bounds.end_slope - bounds.end * sweep.end_excess
    return Change(first, w, missing, path, last), sweep
