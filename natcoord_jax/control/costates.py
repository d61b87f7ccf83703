"""What changes of nodes and residuals are worth: the adjoint equations of a motion."""

from functools import partial
from operator import itemgetter
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.tangent import projected, tangent_maps
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


class Multipliers(eqx.Module):
    """Multipliers of the goal, of the bounds at every step, and of the bounds of what is free."""

    goal: Float[Array, "*batch c"]
    path: Float[Array, "*batch steps h"]
    end: Float[Array, "*batch e"]


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
    """Tangent maps of all nodes, what is free and the register added unchanged."""

    def one(node: Node) -> tuple[Array, Array, Array]:
        system, _ = problem.applied(node.free)
        forth, back, flexibility = tangent_maps(system, unpacked(problem.state, node.x, problem.state.t))
        others = jnp.eye(node.free.size + node.register.size, dtype=forth.dtype)
        block = jax.scipy.linalg.block_diag
        return block(forth, others), block(back, others), flexibility

    return Charts(*jax.vmap(one)(nodes))


def step_inverses(problem: OptimalControl, path: Path, unknowns: Unknowns) -> Float[Array, "steps n n"]:
    """Inverse of the Jacobian of every step's equations in its own unknowns."""

    def one(at: Slice, node: Node, w: Array, y: Array) -> Array:
        return jnp.linalg.inv(jax.jacfwd(lambda y: stage(problem, at, node, w, y).residual)(y))

    before = jax.tree.map(lambda x: x[:-1], path.nodes)
    return jax.vmap(one)(slices(problem), before, entering(problem, unknowns.coefficients), unknowns.y)


def node_projected(problem: OptimalControl, node: Node, flexibility: Array) -> Node:
    """Node with projected velocities."""
    system, _ = problem.applied(node.free)
    state = projected(system, unpacked(problem.state, node.x, problem.state.t), flexibility)
    return eqx.tree_at(lambda n: n.x, node, packed(state))


def scored_end(problem: OptimalControl, multipliers: Multipliers, node: Node) -> Array:
    """Lagrangian of the end."""
    found = end(problem, node)
    return found.cost + multipliers.goal @ found.missing + multipliers.end @ found.excess


def costates(
    problem: OptimalControl,
    path: Path,
    unknowns: Unknowns,
    multipliers: Multipliers,
    inverses: Array,
    maps: Charts,
) -> tuple[Costates, Costates, Float[Array, "steps m"]]:
    """Worth of nodes and residuals, such that the Lagrangian is stationary in all states and unknowns y.

    Returns:
        Costates, exact; those of steps with projected velocities, for the curvature; and the gradient of the
        Lagrangian in the entering coefficients, exact.
    """
    last = jax.grad(partial(scored_end, problem, multipliers))(jax.tree.map(lambda x: x[-1], path.nodes))

    def body(after: tuple[Node, Node], given: tuple) -> tuple[tuple[Node, Node], tuple]:
        at, node, w, y, sigma, inverse, following, flexibility = given
        back = jax.vjp(lambda n: node_projected(problem, n, flexibility), following)[1]
        both = jax.tree.map(lambda a, b: jnp.stack([a, b]), after[0], back(after[1])[0])

        def rest(node: Node, w: Array, y: Array) -> tuple[Array, Array, Node]:
            found = stage(problem, at, node, w, y)
            return found.cost, found.excess, found.after

        pull = jax.vjp(rest, node, w, y)[1]
        pull_residual = jax.vjp(lambda *x: stage(problem, at, *x).residual, node, w, y)[1]

        def through(after: Node) -> tuple[Node, Array, Array]:
            before, by_w, by_y = pull((jnp.ones(()), sigma, after))
            worth = -(by_y @ inverse)
            again = pull_residual(worth)
            return jax.tree.map(jnp.add, before, again[0]), by_w + again[1], worth

        before, by_w, worth = jax.vmap(through)(both)
        exact, model = (jax.tree.map(itemgetter(k), before) for k in range(2))
        return (exact, model), ((exact, worth[0]), (model, worth[1]), by_w[0])

    before, after = (jax.tree.map(itemgetter(s), path.nodes) for s in (slice(None, -1), slice(1, None)))
    w = entering(problem, unknowns.coefficients)
    given = (slices(problem), before, w, unknowns.y, multipliers.path, inverses, after, maps.flexibility[1:])
    _, (exact, model, by_w) = jax.lax.scan(body, (last, last), given, reverse=True)

    def whole(nodes: Node, residuals: Array) -> Costates:
        return Costates(jax.tree.map(lambda x, x1: jnp.concatenate([x, x1[None]]), nodes, last), residuals)

    return whole(*exact), whole(*model), by_w
