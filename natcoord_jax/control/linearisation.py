"""First derivatives at a motion, and what is missing to the conditions of optimality."""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from natcoord_jax.control.costates import Multipliers, charts, costates, step_jacobians
from natcoord_jax.control.iterate import Derivatives, Errors, Slacks, largest
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Unknowns,
    each_step,
    entering,
    first_node,
    slices,
    stage,
)
from natcoord_jax.core.compiled import compiled


def nodes_before(path: Path) -> Node:
    """Nodes before every step."""
    return jax.tree.map(lambda x: x[:-1], path.nodes)


def first_gradient(problem: OptimalControl, unknowns: Unknowns, worth: Array) -> Array:
    """Gradient in what is free and in the leading coefficients, from the worth of the first node."""
    leading = unknowns.coefficients[: problem.inputs.degree]
    flat, unflat = ravel_pytree((unknowns.free, leading))
    if not flat.size:
        return jnp.zeros(0)
    return jax.grad(lambda x: worth @ ravel_pytree(first_node(problem, *unflat(x)))[0])(flat)


def _gradient_scale(problem: OptimalControl, unknowns: Unknowns, path: Path, sigma: Array) -> Array:
    """Largest derivative of cost and bounds by a coefficient that enters: what their sum must cancel."""
    w = entering(problem, unknowns.coefficients)

    def direct(at, node, w, y, sigma):
        def values(w: Array) -> tuple[Array, Array]:
            found = stage(problem, at, node, w, y)
            return found.cost, found.excess

        by_cost, by_excess = jax.jacfwd(values)(w)
        return jnp.abs(by_cost) + sigma @ jnp.abs(by_excess)

    sizes = each_step(problem, direct, slices(problem), nodes_before(path), w, unknowns.y, sigma)
    scale = jnp.max(sizes)
    return jnp.where(scale > 0, scale, 1.0)


@compiled
def linearised(
    problem: OptimalControl,
    unknowns: Unknowns,
    multipliers: Multipliers,
    slacks: Slacks,
    path: Path,
    unit: Array,
) -> Derivatives:
    """First derivatives at a motion, and what is missing to the conditions of optimality."""
    jacobians = step_jacobians(problem, path, unknowns)
    maps = charts(problem, path.nodes)
    worth, bending, by_w = costates(problem, path, unknowns, multipliers, jacobians)
    by_first = first_gradient(problem, unknowns, ravel_pytree(jax.tree.map(lambda x: x[0], worth.nodes))[0])
    count = unknowns.free.size
    scale = _gradient_scale(problem, unknowns, path, multipliers.path)
    if not problem.system.structure.inputs:
        # What is decided then acts on nothing but its own cost, and is zero up to round-off.
        scale = unit
    by_coefficients = largest(by_w[:: problem.inputs.every], by_first[count:]) / scale
    stationarity = jnp.maximum(by_coefficients, largest(by_first[:count]) / unit)
    corrections = largest(jnp.einsum("kij,kj->ki", jacobians.inverses, path.stages.residual))
    size = largest(unknowns.y)
    errors = Errors(
        stationarity,
        corrections / jnp.where(size > 0, size, 1.0),
        largest(path.end.missing),
        largest(path.stages.excess + slacks.path, path.end.excess + slacks.end),
        largest(slacks.path * multipliers.path, slacks.end * multipliers.end) / unit,
    )
    return Derivatives(jacobians, maps, worth, bending, by_w, by_first, errors)


def cost_unit(problem: OptimalControl, unknowns: Unknowns, path: Path) -> Array:
    """Unit of the cost: its value, or that of inputs at half their range."""
    w = entering(problem, unknowns.coefficients)

    def curvature(at, node, w, y):
        cost = jax.hessian(lambda w: stage(problem, at, node, w, y).cost)(w)
        steep = jax.jacfwd(lambda w: stage(problem, at, node, w, y).excess)(w)
        return jnp.max(jnp.abs(jnp.diagonal(cost))), steep

    bent, steep = each_step(problem, curvature, slices(problem), nodes_before(path), w, unknowns.y)
    slopes = largest(steep)
    whole_range = 0.5 * jnp.sum(bent) / jnp.where(slopes > 0, slopes, 1.0) ** 2
    unit = jnp.maximum(jnp.abs(path.cost), jnp.where(slopes > 0, whole_range, 0.0))
    return jnp.where(unit > 0, unit, 1.0)
