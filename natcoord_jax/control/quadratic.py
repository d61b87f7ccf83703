"""The quadratic model of a problem around a motion: linear dynamics, curvature of the Lagrangian, by step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from natcoord_jax.control.costates import (
    Charts,
    Costates,
    Jacobians,
    Multipliers,
    projections,
    scored_end,
    split_node,
    worth_of_left,
)
from natcoord_jax.control.differences import Point, columns, sizes
from natcoord_jax.control.iterate import Derivatives, Model
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Unknowns,
    end,
    entering,
    first_node,
    slices,
    stage,
)

TOGETHER = 5
"""Steps whose models are formed together."""


class Step(NamedTuple):
    """What is known of one step of the motion.

    Attributes:
        at: its number, and the spline's machine.
        node: before it.
        w: coefficients that enter.
        y: its unknowns.
        rates: of the free motions at its end.
        worth: of the node after it, its velocities projected.
        left: worth of the momenta that the projection leaves out.
        multipliers: of its residual and of its bounds.
        jacobian: of its equations.
        forth: from small numbers to the node before it.
        back: to small numbers from the node after it.
        flexibility: inverse inertia of the free motions after it.
    """

    at: Slice
    node: Node
    w: Array
    y: Array
    rates: Array
    worth: Node
    left: Array
    multipliers: tuple[Array, Array]
    jacobian: Jacobians
    forth: Array
    back: Array
    flexibility: Array


def _stage_model(problem: OptimalControl, scale: Point, step: Step) -> tuple[Array, ...]:
    """Derivatives of one step in small numbers: dynamics, curvature, excesses.

    The rates after the step, its velocities projected, count as unknowns of the step like y, with the
    momenta that they leave out as their residual. The Lagrangian is linear in them.
    """
    flat, unflat = ravel_pytree(step.node)

    def lagrangian(chi: Array, w: Array, y: Array, rates: Array, left: Array) -> Array:
        found = stage(problem, step.at, unflat(chi), w, y)
        after, momenta = split_node(problem, found.after, rates, left)
        pairs = zip(jax.tree.leaves(step.worth), jax.tree.leaves(after))
        carried = sum(jnp.sum(a * b) for a, b in pairs) + momenta
        by_residual, by_excess = step.multipliers
        return found.cost + carried + by_residual @ found.residual + by_excess @ found.excess

    def reached(chi: Array, w: Array, y: Array) -> tuple[Array, Array]:
        found = stage(problem, step.at, unflat(chi), w, y)
        return ravel_pytree(found.after)[0], found.excess

    def slopes(chi: Array, w: Array, y: Array) -> tuple:
        return jax.grad(lagrangian, argnums=(0, 1, 2, 3, 4))(chi, w, y, step.rates, step.left)

    size, channels = flat.size, step.w.size
    directions = jax.scipy.linalg.block_diag(step.forth, jnp.eye(channels, dtype=flat.dtype))
    dchi, dw = directions[:size], directions[size:]
    dy = -step.jacobian.inverses @ (step.jacobian.by_node @ dchi + step.jacobian.by_w @ dw)
    point, moved = Point(flat, step.w, step.y), Point(dchi, dw, dy)
    bent = columns(slopes, point, moved, scale)
    along = jax.vmap(lambda *d: jax.jvp(reached, tuple(point), d)[1], in_axes=1, out_axes=1)
    after, excess = along(*moved)
    mixed = (step.flexibility @ bent[4]).T @ bent[3]
    hessian = dchi.T @ bent[0] + dw.T @ bent[1] + dy.T @ bent[2] + mixed + mixed.T
    # The momenta of the step itself: what it carries on normal to the constraints is no part of them.
    return step.back @ after, hessian, excess


def model(
    problem: OptimalControl,
    path: Path,
    unknowns: Unknowns,
    multipliers: Multipliers,
    derivatives: Derivatives,
) -> Model:
    """The quadratic model around a motion, all steps at once."""
    bent, maps = derivatives.bent, derivatives.maps
    before = jax.tree.map(lambda x: x[:-1], path.nodes)
    after = jax.tree.map(lambda x: x[1:], bent.nodes)
    w = entering(problem, unknowns.coefficients)
    steps = Step(
        slices(problem),
        before,
        w,
        unknowns.y,
        projections(problem, path.nodes, maps)[1:],
        after,
        jax.vmap(worth_of_left)(after, maps.forth[1:], maps.flexibility[1:]),
        (bent.residuals, multipliers.path),
        derivatives.jacobians,
        maps.forth[:-1],
        maps.back[1:],
        maps.flexibility[1:],
    )
    scale = sizes(problem, path, unknowns)
    each = _some_together(lambda step: _stage_model(problem, scale, step), steps, problem.steps)
    forward, hessian, excess = each
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
        hessian,
        excess,
        forth.T @ curved,
        goal,
        last_excess,
        first,
        first_hessian,
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
