"""Equations of a step in the joint null space: rates of the spanning tree and multipliers of loops.

Unknowns y: mean rates w of the tree's free motions, stage by stage, then the multipliers (times the step)
of the joints that close loops and of relations between coordinates. Residual: the momentum balance of the
step (57) projected on the free motions, P^T [M sum_j (A^-1)_ij (V_j - v_0) - h F_i - G_i^T lambda_i],
then the rates of the constraints. Working with rates and multipliers times h keeps the equations of one
size as h goes to zero.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.response import (
    Situation,
    body_rows,
    gather,
    respond,
    situation,
    stations,
)
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.assembly.tree import gather_slots, project, sweep_motion, tangent
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.maths.vectors import cross


def active_groups(system: System) -> tuple[Group, ...]:
    """Groups that take part in the equations: all effects and the joints that close loops."""
    return (*system.effects, *(g for g in system.joints if not g.in_tree))


class ReducedStep(eqx.Module):
    """Everything about one step that does not depend on the unknowns."""

    system: System
    start: Float[Array, "bodies 4 3"]
    velocity: Float[Array, "bodies 4 3"]
    frames: Float[Array, "bodies 2 4 4"]
    situations: tuple[Situation, ...]
    h: Float[Array, ""]
    tableau: Tableau = eqx.field(static=True)


def prepare(system: System, state: State, u: Array, h: Array, tableau: Tableau) -> ReducedStep:
    """Gather what the step needs, once."""
    start = body_rows(state.q)
    return ReducedStep(
        system,
        start,
        body_rows(state.v),
        system.tree.frames(system.frames),
        tuple(situation(system, g, state, u, h) for g in active_groups(system)),
        h,
        tableau,
    )


def split(step: ReducedStep, y: Float[Array, " unknowns"]) -> tuple[Array, list[Array]]:
    """Rates (s, unknowns) and multipliers of each active group (n, s, m)."""
    s = step.tableau.stages
    count = step.system.structure.unknowns * s
    w = y[:count].reshape(s, step.system.structure.unknowns)
    multipliers, position = [], count
    for group in active_groups(step.system):
        size = group.count * s * group.effect.multipliers
        shape = (group.count, s, group.effect.multipliers)
        multipliers.append(y[position : position + size].reshape(shape))
        position += size
    return w, multipliers


def inertia(
    mass: Float[Array, "bodies 4 4"], rates: Float[Array, "s bodies 4 3"]
) -> Float[Array, "s bodies 4 3"]:
    """Rows of m v."""
    return jnp.sum(mass[:, :, :, None] * rates[:, :, None], axis=3)


def stage_points(step: ReducedStep, velocity: Float[Array, "s bodies 3"]) -> Float[Array, "s bodies 3"]:
    """Reference points at the stages."""
    coefficients = step.h * jnp.asarray(step.tableau.a, velocity.dtype)
    return step.start[:, 0] + jnp.sum(coefficients[:, :, None, None] * velocity, axis=1)


def wrench(
    rows: Float[Array, "s bodies 4 3"], directors: Float[Array, "s bodies 3 3"]
) -> tuple[Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]:
    """Force and torque about the reference point of forces on rows: r_phi and sum d_i x r_i (26, 31)."""
    return rows[:, :, 0], jnp.sum(cross(directors, rows[:, :, 1:]), axis=2)


def residual(step: ReducedStep, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
    """Residual of the step [N s, N m s; m/s, 1/s for constraints]."""
    system, tableau, h = step.system, step.tableau, step.h
    w, multipliers = split(step, y)
    motion, geometry = sweep_motion(
        system.tree, step.frames, step.start, gather_slots(system.tree, w), h, tableau
    )
    rates = jnp.concatenate(
        [motion.velocity[:, :, None], cross(motion.spin[:, :, None], motion.directors)], axis=2
    )
    difference = rates - step.velocity
    if tableau.stages == 1:
        change = tableau.a_inverse[0][0] * difference
    else:
        change = jnp.einsum("ij,jbrc->ibrc", jnp.asarray(tableau.a_inverse), difference)
    momentum = inertia(system.mass, change)
    torque = jnp.zeros_like(motion.spin)
    rows = []
    groups = active_groups(system)
    if groups:
        points = stage_points(step, motion.velocity)
        at = stations(step.start, points, motion.directors, motion.velocity, motion.spin)
        bodies = step.start.shape[0]
        for group, where, lam in zip(groups, step.situations, multipliers):
            answer = respond(group, where, gather(group, at), lam, tableau)
            forces = jnp.moveaxis(answer.forces, 1, 0)
            turning = jnp.moveaxis(answer.torques, 1, 0)
            impulse = lam.shape[-1] > 0 and group.source == "joint"
            scale = 1.0 if impulse else h
            total = jnp.zeros((tableau.stages, bodies + 1, 4, 3), w.dtype).at[:, group.bodies].add(forces)
            spun = jnp.zeros((tableau.stages, bodies + 1, 3), w.dtype).at[:, group.bodies].add(turning)
            momentum = momentum - scale * total[:, :bodies]
            torque = torque - scale * spun[:, :bodies]
            rows.append(answer.rows.reshape(-1))
    force, moment = wrench(momentum, motion.directors)
    generalised = project(system.tree, geometry, force, moment + torque)[0]
    return jnp.concatenate([generalised.reshape(-1), *rows])


def inertia_matrix(step: ReducedStep) -> Float[Array, "unknowns unknowns"]:
    """P^T M P of the tree at the start of the step: the Jacobian's leading part is twice that."""
    system = step.system
    one = gauss(1)
    count = system.structure.unknowns
    zero = jnp.zeros((1, count), step.start.dtype)
    _, geometry = sweep_motion(
        system.tree, step.frames, step.start, gather_slots(system.tree, zero), 0.0 * step.h, one
    )
    directors = step.start[None, :, 1:]

    def column(unit):
        velocity, spin = tangent(system.tree, geometry, gather_slots(system.tree, unit[None]))
        rates = jnp.concatenate([velocity[:, :, None], cross(spin[:, :, None], directors)], axis=2)
        force, moment = wrench(inertia(system.mass, rates), directors)
        return project(system.tree, geometry, force, moment)[0][0]

    return jax.vmap(column)(jnp.eye(count, dtype=step.start.dtype))


def increment(step: ReducedStep, y: Float[Array, " unknowns"]):
    """Stage velocities of all rows, and the motion with the ground: what the end of the step is made of."""
    w, multipliers = split(step, y)
    motion, geometry = sweep_motion(
        step.system.tree,
        step.frames,
        step.start,
        gather_slots(step.system.tree, w),
        step.h,
        step.tableau,
    )
    points = stage_points(step, motion.velocity)
    at = stations(step.start, points, motion.directors, motion.velocity, motion.spin)
    return at, multipliers
