"""One step: solve its equations, then advance the state."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.equations import prepare
from natcoord_jax.assembly.response import Evaluation, Stations
from natcoord_jax.assembly.system import CoordinateGroup, Group, System
from natcoord_jax.core.coordinate import pair_motion
from natcoord_jax.core.effect import Motion
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.stepping.factorise import differentiable_solver


def _coordinate_rates(group: CoordinateGroup, system: System, at: Stations, h: Array) -> Float[Array, "s n"]:
    """Rates of joint coordinates whose sum over the stages is the exact increment over h."""
    bodies = system.joint_bodies[group.joints]

    def one(place, start, rows, rates, spin):
        return group.axis.unit_load(pair_motion(place, Motion(start, rows, rates, spin), 0), h).rate

    motion = at.start[bodies], at.rows[:, bodies], at.rates[:, bodies], at.spin[:, bodies]
    with jax.named_scope("joint_coordinates"):
        return jax.vmap(one, in_axes=(0, 0, 1, 1, 1), out_axes=1)(system.frames[group.joints], *motion)


def advance(
    system: System, state: State, u: Array, h: Array, y: Float[Array, " unknowns"], tableau: Tableau
) -> tuple[Float[Array, " unknowns"], State, Float[Array, ""]]:
    """Residual of the step's equations at `y`, the state at its end, and the largest half turn.

    Differentiable in everything. The half turn |h omega / 2| of a body is the tangent of half the angle it
    turned: it grows without bound towards half a turn a step, the pole of Cayley's rotation.
    """
    equations = prepare(system, state, u, h, tableau)
    found = equations.evaluate(y)
    after, half_turn = end_of_step(system, state, h, equations.groups, found, tableau)
    return found.residual, after, half_turn


def end_of_step(
    system: System, state: State, h: Array, groups: Sequence[Group], found: Evaluation, tableau: Tableau
) -> tuple[State, Float[Array, ""]]:
    """State at the end of a step from its solved equations, and the largest half turn.

    Positions and velocities are advanced by increments (section 6 of the paper, written for stages):
    q_1 = q_0 + h sum b_i V_i and v_1 = v_0 + sum beta_i (V_i - v_0).
    """
    at = found.at
    bodies = len(system.structure.bodies)
    rates = at.rates[:, :bodies].reshape(tableau.stages, 4 * bodies, 3)
    b, beta = jnp.asarray(tableau.b), jnp.asarray(tableau.beta)
    q = state.q + h * jnp.tensordot(b, rates, 1)
    v = state.v + jnp.tensordot(beta, rates - state.v, 1)
    coordinates, rotors, work = state.coordinates, state.rates, state.work
    # Groups own consecutive pieces of the stored rates and of the work account, in order.
    stage_rates = jnp.zeros((tableau.stages, 0), q.dtype)
    if system.coordinates:
        every = [_coordinate_rates(group, system, at, h) for group in system.coordinates]
        stage_rates = jnp.concatenate(every, axis=1)[:, system.coordinate_order]
        coordinates = coordinates + h * (b @ stage_rates)
    turning, working = [], []
    for group, power in zip(groups, found.power):
        if group.effect.rotors:
            inner = stage_rates[:, group.coordinates[:, 0]] - rotors[group.rotors[:, 0]]
            turning.append(beta @ inner)
        if group.effect.works:
            working.append((1.0 if group.effect.impulsive else h) * (power @ b))
    rotors = rotors + jnp.concatenate(turning) if turning else rotors
    work = work + jnp.concatenate(working) if working else work
    after = State(state.t + h, q, v, coordinates, rotors, work)
    half_turn = 0.5 * h * jnp.sqrt(jnp.max(jnp.sum(at.spin[:, :bodies] ** 2, axis=-1)))
    return after, half_turn


def linear_solver(
    system: System, state: State, u: Array, h: Array, y: Array, tableau: Tableau, along: Callable
) -> Any:
    """Jacobian of the step's equations at `y`, ready to solve with it and with its transpose.

    Args:
        system: compiled system.
        state: state at the start.
        u: inputs.
        h: step [s].
        y: solution of the equations.
        tableau: the collocation method.
        along: linear map of (state, unknowns) to (residual, state at the end), for dense Jacobians.
    """
    equations = prepare(system, state, u, h, tableau)
    if system.structure.solver == "recursive":
        return differentiable_solver(equations, equations.jacobian(y))
    at_rest = jax.tree.map(jnp.zeros_like, state)
    columns = jax.vmap(lambda unit: along(at_rest, unit)[0], out_axes=1)(jnp.eye(y.shape[0], dtype=y.dtype))
    return differentiable_solver(equations, columns)
