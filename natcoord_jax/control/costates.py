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

from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.tangent import split, tangent_maps
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Unknowns,
    end,
    entering,
    packed,
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
    """Small numbers of nodes, forth from them and back, and inverse inertias; leading axis steps + 1."""

    forth: Float[Array, "k x z"]
    back: Float[Array, "k z x"]
    flexibility: Float[Array, "k n n"]


def charts(problem: OptimalControl, nodes: Node) -> Charts:
    """Tangent maps of all nodes, everything besides the state added unchanged."""

    def one(node: Node) -> tuple[Array, Array, Array]:
        system, _ = problem.applied(node.free)
        forth, back, flexibility = tangent_maps(system, unpacked(problem.state, node.x, problem.state.t))
        others = jnp.eye(ravel_pytree(node)[0].size - node.x.size, dtype=forth.dtype)
        block = jax.scipy.linalg.block_diag
        return block(forth, others), block(back, others), flexibility

    return Charts(*jax.vmap(one)(nodes))


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
    return jax.vmap(one)(slices(problem), before, entering(problem, unknowns.coefficients), unknowns.y)


def split_node(problem: OptimalControl, node: Node, rates: Array, worth: Array) -> tuple[Node, Array]:
    """Node with given rates of its free motions, and what the momenta are worth that they leave out."""
    system, _ = problem.applied(node.free)
    state, left = split(system, unpacked(problem.state, node.x, problem.state.t), rates, worth)
    return eqx.tree_at(lambda n: n.x, node, packed(state)), left


def projections(problem: OptimalControl, nodes: Node, maps: Charts) -> Float[Array, "k n"]:
    """Rates of the free motions of nodes, with their momenta."""
    count, size = maps.flexibility.shape[1], problem.state.q.size
    project = maps.back[:, count : 2 * count, size : 2 * size]
    return jnp.einsum("kij,kj->ki", project, nodes.x[:, size : 2 * size])


def worth_of_left(worth: Node, forth: Array, flexibility: Array) -> Float[Array, " n"]:
    """What momenta left out by a projection are worth, so that its result is stationary."""
    count = flexibility.shape[0]
    return flexibility @ (forth[: worth.x.shape[0], count : 2 * count].T @ worth.x)


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
    maps: Charts,
) -> tuple[Costates, Costates, Costates, Float[Array, "steps m"]]:
    """Worth of nodes and residuals, such that the Lagrangian is stationary in all states and unknowns y.

    Returns:
        Costates; those that bend the exact conditions, and, of steps with projected velocities, those that
        bend the model, where multipliers of the motion that are given replace what the others imply; and the
        gradient of the Lagrangian in the entering coefficients.
    """
    final = jax.grad(partial(scored_end, problem, multipliers))(jax.tree.map(lambda x: x[-1], path.nodes))
    last, unflat = ravel_pytree(final)

    def body(after: tuple[Array, Array], given: tuple) -> tuple[tuple[Array, Array], tuple]:
        at, node, w, y, slopes, jacobian, following, rates, forth, flexibility = given

        unprojected = _unprojected(problem, after[1], following, rates, forth, flexibility)
        through = through_step(problem, at, node, w, y, jacobian)
        both, by_w, worth = jax.vmap(through, in_axes=(0, None))(
            jnp.stack([after[0], unprojected]), slopes[2]
        )
        both = both + slopes[0]
        return (both[0], both[1]), (both, worth, by_w[0] + slopes[1])

    before, after = (jax.tree.map(itemgetter(s), path.nodes) for s in (slice(None, -1), slice(1, None)))
    w = entering(problem, unknowns.coefficients)
    each = (slices(problem), before, w, unknowns.y)
    slopes = jax.vmap(partial(direct_slopes, problem))(*each, multipliers.path)
    given = (*each, slopes, jacobians, after)
    rates = projections(problem, path.nodes, maps)[1:]
    given = (*given, rates, maps.forth[1:], maps.flexibility[1:])
    _, (nodes, residuals, by_w) = scan_in_one_kernel(body, (last, last), given, reverse=True)
    nodes = jnp.concatenate([nodes, jnp.broadcast_to(last, (1, 2, last.size))])
    exact, model = (Costates(jax.vmap(unflat)(nodes[:, k]), residuals[:, k]) for k in range(2))
    if multipliers.motion is None:
        return exact, exact, model, by_w
    # Of projected steps they differ by a part of order dt^2.
    motion = jnp.stack([multipliers.motion, multipliers.motion + model.residuals - exact.residuals], axis=1)

    def given_body(after: Array, given: tuple) -> tuple[Array, Array]:
        (at, node, w, y, slopes, _, following, *maps), motion = given
        flat, unflat = ravel_pytree(node)

        def reached(node: Array) -> tuple[Array, Array]:
            found = stage(problem, at, unflat(node), w, y)
            return ravel_pytree(found.after)[0], found.residual

        pull = jax.vjp(reached, flat)[1]
        unprojected = _unprojected(problem, after[1], following, *maps)
        both = jax.vmap(pull)((jnp.stack([after[0], unprojected]), motion))[0] + slopes[0]
        return both, both

    begun = jnp.broadcast_to(last, (2, last.size))
    _, nodes = scan_in_one_kernel(given_body, begun, (given, motion), reverse=True)
    nodes = jnp.concatenate([nodes, begun[None]])
    bending, model = (Costates(jax.vmap(unflat)(nodes[:, k]), motion[:, k]) for k in range(2))
    return exact, bending, model, by_w


def _unprojected(
    problem: OptimalControl, worth: Array, node: Node, rates: Array, forth: Array, flexibility: Array
) -> Array:
    """Worth of a node from that of the same with its velocities projected, as vectors."""
    flat, unflat = ravel_pytree(node)
    worth_left = worth_of_left(unflat(worth), forth, flexibility)

    def projected(node: Array) -> tuple[Array, Array]:
        reached, left = split_node(problem, unflat(node), rates, worth_left)
        return ravel_pytree(reached)[0], left

    return jax.vjp(projected, flat)[1]((worth, jnp.ones(())))[0]
