"""One step: solve its equations, then advance the state."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.equations import prepare
from natcoord_jax.assembly.response import Stations, gather, respond, situation
from natcoord_jax.assembly.system import CoordinateGroup, System
from natcoord_jax.core.coordinate import pair_motion
from natcoord_jax.core.effect import Motion
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.stepping.factorise import differentiable_solver
from natcoord_jax.stepping.newton import Solution, Warm, cold, newton


def start_cold(system: System, state: State, u: Array, h: Array, tableau: Tableau) -> Warm:
    """Start of the first step of a rollout."""
    return cold(prepare(system, state, u, h, tableau), system.structure.solver)


def solve(
    system: System, state: State, u: Array, h: Array, tableau: Tableau, tolerance: float, warm: Warm
) -> Solution:
    """Unknowns of one step; no derivatives pass (see `advance` and the rollout)."""
    return newton(prepare(system, state, u, h, tableau), tolerance, system.structure.solver, warm)


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

    Positions and velocities are advanced by increments (section 6 of the paper, written for stages):
    q_1 = q_0 + h sum b_i V_i and v_1 = v_0 + sum beta_i (V_i - v_0).
    """
    equations = prepare(system, state, u, h, tableau)
    at, multipliers = equations.end_motion(y)
    bodies = len(system.structure.bodies)
    rates = at.rates[:, :bodies].reshape(tableau.stages, 4 * bodies, 3)
    b, beta = jnp.asarray(tableau.b), jnp.asarray(tableau.beta)
    q = state.q + h * jnp.tensordot(b, rates, 1)
    v = state.v + jnp.tensordot(beta, rates - state.v, 1)
    coordinates = state.coordinates
    stage_rates = jnp.zeros((tableau.stages, coordinates.shape[0]), q.dtype)
    for group in system.coordinates:
        found = _coordinate_rates(group, system, at, h)
        stage_rates = stage_rates.at[:, group.index].set(found)
    if system.coordinates:
        coordinates = coordinates + h * (b @ stage_rates)
    rotors, work = state.rates, state.work
    for group, lam in zip(equations.groups, multipliers):
        if group.effect.rotors:
            inner = stage_rates[:, group.coordinates[:, 0]] - rotors[group.rotors[:, 0]]
            rotors = rotors.at[group.rotors[:, 0]].add(beta @ inner)
        if group.effect.works:
            answer = respond(group, situation(system, group, state, u, h), gather(group, at), lam, tableau)
            work = work.at[group.works[:, 0]].add((1.0 if group.effect.impulsive else h) * (answer.power @ b))
    after = State(state.t + h, q, v, coordinates, rotors, work)
    half_turn = 0.5 * h * jnp.sqrt(jnp.max(jnp.sum(at.spin[:, :bodies] ** 2, axis=-1)))
    return equations.residual(y)[0], after, half_turn


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
