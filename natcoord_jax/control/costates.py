"""What changes of nodes and residuals are worth: the adjoint equations of a motion."""

from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.phases import at_hand, in_all_phases, like
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.tangent import tangent_maps
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Unknowns,
    each_step,
    end,
    entering,
    slices,
    stage,
    unpacked,
)
from natcoord_jax.stepping.derivative import UNSOLVED
from natcoord_jax.xla.one_kernel import scan_in_one_kernel


class Multipliers(eqx.Module):
    """Multipliers of the constraints.

    Attributes:
        goal: of the goal.
        path: of the bounds at every step.
        end: of the bounds of what is free.
        motion: of the equations of all steps, as they bend the model; None: those that the others imply.
    """

    goal: Float[Array, "*batch c"]
    path: Float[Array, "*batch steps h"]
    end: Float[Array, "*batch e"]
    motion: Float[Array, "*batch steps n"] | None = None


class Costates(eqx.Module):
    """What a change of a node, or of a step's residual, is worth.

    Attributes:
        nodes: of all nodes, the structure of a node, leading axis steps + 1.
        residuals: of the residuals of all steps (steps, n).
    """

    nodes: Node
    residuals: Float[Array, "steps n"]


class Charts(NamedTuple):
    """Small numbers of nodes: forth from them and back; leading axis steps + 1."""

    forth: Float[Array, "k x z"]
    back: Float[Array, "k z x"]


def charts(problem: OptimalControl, nodes: Node) -> Charts:
    """Tangent maps of all nodes, everything besides the state added unchanged."""

    def one(phase: int, node: Node) -> tuple[Array, Array]:
        state = unpacked(like(problem.systems, problem.state, phase), node.x, problem.state.t)
        systems = problem.applied_systems(node.free)
        system = at_hand(systems, (phase,), phase, state) if phase else systems[0]
        forth, back = in_all_phases(problem.systems, state, tangent_maps(system, state))
        others = jnp.eye(ravel_pytree(node)[0].size - node.x.size, dtype=forth.dtype)
        block = jax.scipy.linalg.block_diag
        return block(forth, others), block(back, others)

    found, first = [], 0
    for phase, count in enumerate(problem.phases if problem.later else (problem.steps,)):
        # A node is of the phase that ends there.
        last = first + count + (phase == 0)
        found.append(jax.vmap(partial(one, phase))(jax.tree.map(itemgetter(slice(first, last)), nodes)))
        first = last
    return Charts(*jax.tree.map(lambda *x: jnp.concatenate(x), *found) if problem.later else found[0])


class Jacobians(NamedTuple):
    """How the equations of every step depend on what they are solved for and on what is given.

    Attributes:
        inverses: of the Jacobians in the step's own unknowns; NaN for those that have none.
        by_node: in the node before the step, as one vector.
        by_w: in the coefficients that enter.
    """

    inverses: Float[Array, "steps n n"]
    by_node: Float[Array, "steps n x"]
    by_w: Float[Array, "steps n m"]


def step_jacobians(problem: OptimalControl, path: Path, unknowns: Unknowns) -> Jacobians:
    """Jacobians of the equations of all steps."""

    def one(at: Slice, node: Node, w: Array, y: Array) -> Jacobians:
        flat, unflat = ravel_pytree(node)

        def residual(flat: Array, w: Array, y: Array) -> Array:
            return stage(problem, at, unflat(flat), w, y).residual

        by_node, by_w, by_y = jax.jacrev(residual, argnums=(0, 1, 2))(flat, w, y)
        inverse = jnp.linalg.inv(by_y)
        missing = jnp.abs(by_y @ inverse - jnp.eye(y.size))
        solved = jnp.all(missing <= UNSOLVED * (1.0 + jnp.abs(by_y) @ jnp.abs(inverse)))
        return Jacobians(jnp.where(solved, inverse, jnp.nan), by_node, by_w)

    before = jax.tree.map(lambda x: x[:-1], path.nodes)
    w = entering(problem, unknowns.coefficients)
    return each_step(problem, one, slices(problem), before, w, unknowns.y)


def scored_end(problem: OptimalControl, multipliers: Multipliers, node: Node) -> Array:
    """Lagrangian of the end."""
    found = end(problem, node)
    return found.cost + multipliers.goal @ found.missing + multipliers.end @ found.excess


TransmittedWrench = Callable[[Array, Array], tuple[Array, Array, Array]]


def through_step(
    problem: OptimalControl, at: Slice, node: Node, w: Array, y: Array, jacobian: Jacobians
) -> TransmittedWrench:
    """One step back, the adjoint of its linearised equations.

    Returns:
        A function of the worth of the node after it, as one vector, and of a slope in the unknowns y, to the
        worth of the node before it, the slope in what enters, and the residual's worth.
    """
    flat, unflat = ravel_pytree(node)

    def reached(node: Array, w: Array, y: Array) -> Array:
        return ravel_pytree(stage(problem, at, unflat(node), w, y).after)[0]

    pull = jax.vjp(reached, flat, w, y)[1]

    def through(after: Array, slope: Array) -> tuple[Array, Array, Array]:
        before, by_w, by_y = pull(after)
        worth = -((by_y + slope) @ jacobian.inverses)
        return before + worth @ jacobian.by_node, by_w + worth @ jacobian.by_w, worth

    return through


def direct_slopes(
    problem: OptimalControl, at: Slice, node: Node, w: Array, y: Array, sigma: Array
) -> tuple[Array, Array, Array]:
    """Slopes of a step's own cost and weighted excesses: in the node before it, as one vector, in w and y."""
    flat, unflat = ravel_pytree(node)

    def value(node: Array, w: Array, y: Array) -> Array:
        found = stage(problem, at, unflat(node), w, y)
        return found.cost + sigma @ found.excess

    return jax.grad(value, argnums=(0, 1, 2))(flat, w, y)


def costates(
    problem: OptimalControl,
    path: Path,
    unknowns: Unknowns,
    multipliers: Multipliers,
    jacobians: Jacobians,
) -> tuple[Costates, Costates, Float[Array, "steps m"]]:
    """Worth of nodes and residuals, such that the Lagrangian is stationary in all states and unknowns y.

    Returns:
        Costates; those that the curvature is taken with, where multipliers of the motion that are given
        replace what the others imply; and the gradient of the Lagrangian in the entering coefficients.
    """
    final = jax.grad(partial(scored_end, problem, multipliers))(jax.tree.map(lambda x: x[-1], path.nodes))
    last, unflat = ravel_pytree(final)

    def body(after: Array, given: tuple) -> tuple[Array, tuple]:
        at, node, w, y, slopes, jacobian = given
        before, by_w, worth = through_step(problem, at, node, w, y, jacobian)(after, slopes[2])
        return before + slopes[0], (before + slopes[0], worth, by_w + slopes[1])

    before = jax.tree.map(itemgetter(slice(None, -1)), path.nodes)
    each = (slices(problem), before, entering(problem, unknowns.coefficients), unknowns.y)
    slopes = each_step(problem, partial(direct_slopes, problem), *each, multipliers.path)
    _, (nodes, residuals, by_w) = scan_in_one_kernel(body, last, (*each, slopes, jacobians), reverse=True)

    def whole(nodes: Array) -> Node:
        return jax.vmap(unflat)(jnp.concatenate([nodes, last[None]]))

    exact = Costates(whole(nodes), residuals)
    if multipliers.motion is None:
        return exact, exact, by_w

    def given_body(after: Array, given: tuple) -> tuple[Array, Array]:
        (at, node, w, y, slopes), motion = given
        flat, unflat = ravel_pytree(node)

        def reached(node: Array) -> tuple[Array, Array]:
            found = stage(problem, at, unflat(node), w, y)
            return ravel_pytree(found.after)[0], found.residual

        found = jax.vjp(reached, flat)[1]((after, motion))[0] + slopes[0]
        return found, found

    _, nodes = scan_in_one_kernel(given_body, last, ((*each, slopes), multipliers.motion), reverse=True)
    return exact, Costates(whole(nodes), multipliers.motion), by_w
