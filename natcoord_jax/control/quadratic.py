"""The quadratic model of a problem around a motion: linear dynamics, curvature of the Lagrangian, by step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from natcoord_jax.control.costates import Charts, Costates, Jacobians, Multipliers, scored_end
from natcoord_jax.control.differences import Point, columns, sizes
from natcoord_jax.control.iterate import Derivatives, Model
from natcoord_jax.control.phases import most_unknowns
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Unknowns,
    end,
    entering,
    first_node,
    moving_places,
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
        worth: of the node after it.
        multipliers: of its residual and of its bounds.
        jacobian: of its equations.
        forth: from small numbers to the node before it.
        back: to small numbers from the node after it.
    """

    at: Slice
    node: Node
    w: Array
    y: Array
    worth: Node
    multipliers: tuple[Array, Array]
    jacobian: Jacobians
    forth: Array
    back: Array


def _quick(problem: OptimalControl) -> tuple[np.ndarray, slice]:
    """Places of velocities and rates of rotors in a node as a vector, and in small numbers."""
    places, count = moving_places(problem), most_unknowns(problem.systems)[1]
    return places, slice(count, count + places.size)


def _slow(step: Step, quick: slice) -> tuple[Array, Array, Array]:
    """Directions of node, w and y, one a column, in which everything but velocities changes."""
    m, n = step.w.size, step.y.size
    nodes = jnp.concatenate([step.forth[:, : quick.start], step.forth[:, quick.stop :]], axis=1)
    own = jnp.eye(m + n, dtype=nodes.dtype)
    own = jnp.concatenate([jnp.zeros((m + n, nodes.shape[1]), nodes.dtype), own], axis=1)
    return jnp.pad(nodes, ((0, 0), (0, m + n))), own[:m], own[m:]


def _stage_slopes(problem: OptimalControl, scale: Point, step: Step) -> tuple[Array, Array, Array]:
    """Derivatives of small numbers after a step and of excesses in [z, w, y], and the Lagrangian's curvature.

    Velocities at its start enter the step (57) linearly, so that among themselves only cost, bounds and what
    is carried along for them bend.
    They are most of the numbers, and are left to symmetry.
    """
    flat, unflat = ravel_pytree(step.node)
    worth, (by_residual, by_excess) = ravel_pytree(step.worth)[0], step.multipliers
    (places, quick), size, x = _quick(problem), problem.state.q.size, step.node.x.size
    a = quick.start

    def own(chi: Array, w: Array, y: Array, moving: Array | None = None) -> tuple[Array, Any]:
        found = stage(problem, step.at, unflat(chi), w, y, moving=moving)
        after = ravel_pytree(found.after)[0]
        # Of positions their displacement, all others as they are.
        small = jnp.concatenate([step.back[:a, :size] @ after[:size], after[places], after[x:]])
        lagrangian = worth[:x] @ after[:x] + by_residual @ found.residual
        value = found.cost + by_excess @ found.excess + worth[x:] @ after[x:]
        return value, (lagrangian, small, found.excess)

    def slope(*point: Array) -> Array:
        def lagrangian(*point: Array) -> Array:
            value, (more, *_) = own(*point)
            return value + more

        by_chi, by_w, by_y = jax.grad(lagrangian, argnums=(0, 1, 2))(*point)
        displaced = by_chi[:x] @ step.forth[:x, :a]
        return jnp.concatenate([displaced, by_chi[places], by_chi[x:], by_w, by_y])

    def fast(v: Array) -> Array:
        return jax.grad(lambda v: own(flat, step.w, step.y, v)[0])(v)

    def reached(*point: Array) -> tuple[Array, Array]:
        return own(*point)[1][1:]

    # Exact: conditions of the goal that depend on each other would be told apart by rounding.
    point, moved = (flat, step.w, step.y), _slow(step, quick)
    along = jax.vmap(lambda *d: jax.jvp(reached, point, d)[1], in_axes=1, out_axes=1)(*moved)
    by_v = jax.jacfwd(lambda v: reached(flat, step.w, step.y, v))(flat[places])
    found = columns(slope, point, moved, scale)
    unit = jnp.eye(places.size, dtype=flat.dtype)
    among = columns(fast, (flat[places],), (unit,), (scale.node[places],))
    after, excess = (jnp.concatenate([x[:, :a], v, x[:, a:]], axis=1) for x, v in zip(along, by_v))
    across, first, last = found[quick], found[:a], found[quick.stop :]
    hessian = jnp.block([
        [first[:, :a], across[:, :a].T, first[:, a:]],
        [across[:, :a], among, across[:, a:]],
        [last[:, :a], across[:, a:].T, last[:, a:]],
    ])  # fmt: skip
    return after, excess, 0.5 * (hessian + hessian.T)


def _stage_model(problem: OptimalControl, scale: Point, step: Step) -> tuple[Array, ...]:
    """Derivatives of one step in small numbers: dynamics, curvature, excesses, unknowns."""
    z, m = step.forth.shape[1], step.w.size
    by_z = step.jacobian.by_node @ step.forth
    to_y = -step.jacobian.inverses @ jnp.concatenate([by_z, step.jacobian.by_w], axis=1)
    after, excess, hessian = _stage_slopes(problem, scale, step)
    bent_y = hessian[z + m :, z + m :]
    slope_y = hessian[z + m :, : z + m] + bent_y @ to_y
    hessian = hessian[: z + m, : z + m] + hessian[: z + m, z + m :] @ to_y + to_y.T @ slope_y
    forward_y, excess_y = after[:, z + m :], excess[:, z + m :]
    forward, excess = after[:, : z + m] + forward_y @ to_y, excess[:, : z + m] + excess_y @ to_y
    return forward, hessian, excess, to_y, forward_y, excess_y, slope_y, bent_y


def model(
    problem: OptimalControl,
    path: Path,
    unknowns: Unknowns,
    multipliers: Multipliers,
    derivatives: Derivatives,
) -> Model:
    """The quadratic model around a motion, all steps at once."""
    bending, maps = derivatives.bending, derivatives.maps
    steps = Step(
        slices(problem),
        jax.tree.map(lambda x: x[:-1], path.nodes),
        entering(problem, unknowns.coefficients),
        unknowns.y,
        jax.tree.map(lambda x: x[1:], bending.nodes),
        (bending.residuals, multipliers.path),
        derivatives.jacobians,
        maps.forth[:-1],
        maps.back[1:],
    )
    scale = sizes(problem, path, unknowns)
    together = 1 if problem.later else TOGETHER
    each: Any = some_together(lambda step: _stage_model(problem, scale, step), steps, problem.steps, together)
    last, unflat = ravel_pytree(jax.tree.map(lambda x: x[-1], path.nodes))
    forth = maps.forth[-1]

    def scored(chi: Array) -> Array:
        return jax.grad(lambda c: scored_end(problem, multipliers, unflat(c)))(chi)

    def reached(chi: Array) -> tuple[Array, Array]:
        found = end(problem, unflat(chi))
        return found.missing, found.excess

    curved = jax.vmap(lambda d: jax.jvp(scored, (last,), (d,))[1], in_axes=1, out_axes=1)(forth)
    goal, last_excess = jax.vmap(lambda d: jax.jvp(reached, (last,), (d,))[1], in_axes=1, out_axes=1)(forth)
    first, first_hessian = _first_model(problem, unknowns, bending, maps)
    return Model(
        *each,
        last_hessian=forth.T @ curved,
        goal=goal,
        last_excess=last_excess,
        first=first,
        first_hessian=first_hessian,
    )


def some_together(function: Any, given: Any, steps: int, most: int = TOGETHER) -> Any:
    """Function of all steps, a few of them at a time: what is in between stays in the cache."""
    if most == 1:
        return jax.lax.map(function, given)
    size = max(k for k in range(1, most + 1) if steps % k == 0)
    pieces = jax.tree.map(lambda x: x.reshape(steps // size, size, *x.shape[1:]), given)
    found = jax.lax.map(jax.vmap(function), pieces)
    return jax.tree.map(lambda x: x.reshape(steps, *x.shape[2:]), found)


def _first_model(
    problem: OptimalControl, unknowns: Unknowns, bending: Costates, maps: Charts
) -> tuple[Array, Array]:
    """How the first node depends on what is free and on the leading coefficients, and how bent that is."""
    flat, unflat = ravel_pytree((unknowns.free, unknowns.coefficients[: problem.inputs.degree]))
    if not flat.size:
        return jnp.zeros((maps.back.shape[1], 0)), jnp.zeros((0, 0))
    value = ravel_pytree(jax.tree.map(lambda x: x[0], bending.nodes))[0]

    def node(given: Array) -> Array:
        return ravel_pytree(first_node(problem, *unflat(given)))[0]

    curved = jax.jacfwd(jax.grad(lambda given: value @ node(given)))(flat)
    return maps.back[0] @ jax.jacfwd(node)(flat), curved
