"""The quadratic model of a problem around a motion: exact gradients, curvature of the Lagrangian, by step."""

from operator import itemgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.costates import Charts, Costates, Multipliers, node_projected, scored_end
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Stage,
    Unknowns,
    end,
    entering,
    first_node,
    slices,
    stage,
)

TOGETHER = 5
"""Steps whose models are formed together."""


class Model(eqx.Module):
    """Linear dynamics and quadratic costs in small numbers z (see `tangent`), w and what is free.

    z holds changes of the state, of what is free and of the register; w those of entering coefficients.

    Attributes:
        forward: z_k+1 = forward [z_k, w_k] + offset, (steps, z, z + m).
        offset: from the residuals (steps, z).
        hessian: of the Lagrangian in [z, w] (steps, z + m, z + m).
        gradient: linear terms in [z, w] (steps, z + m).
        excess: derivative of the excesses (steps, h, z + m).
        excess_offset: from the residuals (steps, h).
        last_hessian: of the terminal Lagrangian (z, z).
        goal: derivative of the goal (c, z).
        last_excess: derivative of the terminal excesses (e, z).
        first: z_0 per what is free and leading coefficients (z, f).
        first_hessian: (f, f).
        first_gradient: (f,).
    """

    forward: Float[Array, "steps z zm"]
    offset: Float[Array, "steps z"]
    hessian: Float[Array, "steps zm zm"]
    gradient: Float[Array, "steps zm"]
    excess: Float[Array, "steps h zm"]
    excess_offset: Float[Array, "steps h"]
    last_hessian: Float[Array, "z z"]
    goal: Float[Array, "c z"]
    last_excess: Float[Array, "e z"]
    first: Float[Array, "z f"]
    first_hessian: Float[Array, "f f"]
    first_gradient: Float[Array, " f"]


def _scored(found: Stage, worth: tuple) -> Array:
    """Lagrangian of one step."""
    after, residual, path = worth
    carried = sum(jnp.sum(a * b) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(found.after)))
    return found.cost + carried + residual @ found.residual + path @ found.excess


def _projection_model(
    problem: OptimalControl, node: Node, worth: Node, flexibility: Array, forth: Array
) -> tuple[Node, Array, Array]:
    """Worth of a node before its velocities are projected, and the curvature of the projection.

    The projection is linear in velocities, so that only displacements and what is free bend it.

    Args:
        problem: the problem.
        node: the node.
        worth: of the projected node.
        flexibility: see `projected`.
        forth: from small numbers to the node.

    Returns:
        The worth; the displacements D and unit changes of what is free; and H D with the second derivative H.
    """
    flat, unflat = ravel_pytree((node.x, node.free))

    def value(given: Array) -> Array:
        x, free = unflat(given)
        reached = node_projected(problem, Node(x, free, node.register), flexibility)
        return worth.x @ reached.x

    count, size = flexibility.shape[0], node.x.size
    displaced = jnp.pad(forth[:size, :count], ((0, flat.size - size), (0, 0)))
    units = jnp.eye(flat.size, dtype=flat.dtype)[:, size:]
    along = jnp.concatenate([displaced, units], axis=1)
    slope = jax.grad(value)(flat)
    curved = jax.vmap(lambda d: jax.jvp(jax.grad(value), (flat,), (d,))[1], in_axes=1, out_axes=1)(along)
    by_x, by_free = unflat(slope)
    return Node(by_x, worth.free + by_free, worth.register), along, curved


def _stage_model(
    problem: OptimalControl,
    at: Slice,
    node: Node,
    w: Array,
    y: Array,
    worth: tuple,
    inverse: Array,
    residual: Array,
    forth: Array,
    back: Array,
    following: Node,
    forth_after: Array,
    flexibility: Array,
) -> tuple[Array, ...]:
    """Derivatives of one step in small numbers: dynamics, curvature, excesses; last column the offset."""
    flat, unflat = ravel_pytree(node)
    size, channels = flat.size, w.size
    before_projection, bending, curved = _projection_model(
        problem, following, worth[0], flexibility, forth_after
    )

    def residuals(chi: Array, w: Array, y: Array) -> Array:
        return stage(problem, at, unflat(chi), w, y).residual

    def slopes(chi: Array, w: Array, y: Array) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
        """Slopes of the Lagrangian of the step, and its node and excesses at the end."""

        def scored(chi: Array, w: Array, y: Array) -> tuple[Array, tuple[Array, Array]]:
            found = stage(problem, at, unflat(chi), w, y)
            value = _scored(found, (before_projection, *worth[1:]))
            return value, (ravel_pytree(found.after)[0], found.excess)

        return jax.grad(scored, argnums=(0, 1, 2), has_aux=True)(chi, w, y)

    count = forth.shape[1] + channels
    directions = jax.scipy.linalg.block_diag(forth, jnp.eye(channels, dtype=flat.dtype))
    chi_dirs, w_dirs = directions[:size], directions[size:]
    still = jnp.zeros_like(y)
    moved = jax.vmap(
        lambda dc, dw: jax.jvp(residuals, (flat, w, y), (dc, dw, still))[1], in_axes=1, out_axes=1
    )(chi_dirs, w_dirs)
    y_dirs = -inverse @ jnp.concatenate([moved, residual[:, None]], axis=1)
    chi_dirs, w_dirs = (jnp.pad(x, ((0, 0), (0, 1))) for x in (chi_dirs, w_dirs))

    def along(dc: Array, dw: Array, dy: Array) -> tuple:
        by, ends = jax.jvp(slopes, (flat, w, y), (dc, dw, dy))[1]
        return *ends, *by

    after, excess, by_chi, by_w, by_y = jax.vmap(along, in_axes=1, out_axes=1)(chi_dirs, w_dirs, y_dirs)
    hessian = chi_dirs.T @ by_chi + w_dirs.T @ by_w + y_dirs.T @ by_y
    forward = back @ after
    motions, loose = flexibility.shape[0], node.free.size
    amounts = jnp.concatenate([forward[:motions], forward[2 * motions : 2 * motions + loose]])
    mixed = (curved.T @ after[: curved.shape[0]]).T @ amounts
    hessian = hessian + mixed + mixed.T - amounts.T @ (bending.T @ curved) @ amounts
    return forward[:, :count], forward[:, count], hessian[:count, :count], hessian[:count, count], excess


def model(
    problem: OptimalControl,
    path: Path,
    unknowns: Unknowns,
    multipliers: Multipliers,
    bent: Costates,
    by_w: Float[Array, "steps m"],
    by_first: Float[Array, " f"],
    inverses: Float[Array, "steps n n"],
    maps: Charts,
) -> Model:
    """The quadratic model around a motion, all steps at once."""
    before = jax.tree.map(lambda x: x[:-1], path.nodes)
    after = jax.tree.map(lambda x: x[1:], bent.nodes)
    w = entering(problem, unknowns.coefficients)
    given = (slices(problem), before, w, unknowns.y, (after, bent.residuals, multipliers.path), inverses)
    following = jax.tree.map(itemgetter(slice(1, None)), path.nodes)
    given = (*given, path.stages.residual, maps.forth[:-1], maps.back[1:], following)
    given = (*given, maps.forth[1:], maps.flexibility[1:])
    each = _some_together(lambda x: _stage_model(problem, *x), given, problem.steps)
    forward, offset, hessian, shift, excess = each
    gradient = shift.at[:, -w.shape[1] :].add(by_w)
    last, unflat = ravel_pytree(jax.tree.map(lambda x: x[-1], path.nodes))
    forth = maps.forth[-1]

    def scored(chi: Array) -> Array:
        return jax.grad(lambda c: scored_end(problem, multipliers, unflat(c)))(chi)

    def reached(chi: Array) -> tuple[Array, Array]:
        found = end(problem, unflat(chi))
        return found.missing, found.excess

    curved = jax.vmap(lambda d: jax.jvp(scored, (last,), (d,))[1], in_axes=1, out_axes=1)(forth)
    goal, last_excess = jax.vmap(lambda d: jax.jvp(reached, (last,), (d,))[1], in_axes=1, out_axes=1)(forth)
    first, first_hessian = _first_model(problem, unknowns, bent, maps)
    return Model(
        forward,
        offset,
        hessian,
        gradient,
        excess[:, :, :-1],
        excess[:, :, -1],
        forth.T @ curved,
        goal,
        last_excess,
        first,
        first_hessian,
        by_first,
    )


def _some_together(function: Any, given: Any, steps: int) -> Any:
    """Function of all steps, a few of them at a time: what is in between stays in the cache."""
    size = max(k for k in range(1, TOGETHER + 1) if steps % k == 0)
    pieces = jax.tree.map(lambda x: x.reshape(steps // size, size, *x.shape[1:]), given)
    found = jax.lax.map(jax.vmap(function), pieces)
    return jax.tree.map(lambda x: x.reshape(steps, *x.shape[2:]), found)


def _first_model(
    problem: OptimalControl, unknowns: Unknowns, bent: Costates, maps: Charts
) -> tuple[Array, Array]:
    """How the first node depends on what is free and on the leading coefficients, and how bent that is."""
    flat, unflat = ravel_pytree((unknowns.free, unknowns.coefficients[: problem.inputs.degree]))
    if not flat.size:
        return jnp.zeros((maps.back.shape[1], 0)), jnp.zeros((0, 0))
    value = ravel_pytree(jax.tree.map(lambda x: x[0], bent.nodes))[0]

    def node(given: Array) -> Array:
        return ravel_pytree(first_node(problem, *unflat(given)))[0]

    curved = jax.jacfwd(jax.grad(lambda given: value @ node(given)))(flat)
    return maps.back[0] @ jax.jacfwd(node)(flat), curved
