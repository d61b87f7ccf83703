"""One step: solve its equations, then advance the state."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.block_tangent_space import Tangents, with_system
from natcoord_jax.mechanics.coordinates import stage_rates
from natcoord_jax.mechanics.end_impulses import obeying, released
from natcoord_jax.mechanics.equations import prepare, starting
from natcoord_jax.mechanics.impacts import after_impacts
from natcoord_jax.mechanics.kick import ends_of
from natcoord_jax.mechanics.response import Evaluation
from natcoord_jax.mechanics.step_equations import dense_solver
from natcoord_jax.mechanics.tangent_space import driven
from natcoord_jax.system import System


def advance(
    system: System,
    state: State,
    u: Array,
    h: Array,
    y: Float[Array, " unknowns"],
    tableau: Tableau,
    tangents: Tangents | None = None,
) -> tuple[Float[Array, " unknowns"], State, Tangents | None]:
    """Residual of the step's equations at `y`, the state at its end, and the tangent space there.

    Differentiable in everything. The tangent space at the start may be given, so that a chain of steps is a
    function of every one of them once; without a system in it, as it is carried along. None for schemes
    without kicks.
    """
    start_cache = starting(system, state, tableau, tangents, later=tangents is None)
    equations = prepare(system, state, u, h, tableau, start_cache)
    found = equations.evaluate(y)
    after = None if found.kick is None else with_system(found.kick.after, None)
    return found.residual, end_of_step(equations, found)[0], after


def end_of_step(equations: Any, found: Evaluation) -> tuple[State, Float[Array, ""]]:
    """State at the end of a step from its solved equations, and the largest half turn.

    Positions and velocities are advanced by increments (section 6 of the paper, written for stages):
    q_1 = q_0 + h sum b_i V_i and v_1 = v_0 + sum beta_i (V_i - v_0), the latter without kicks.
    """
    system, state, h, tableau = equations.system, equations.state, equations.h, equations.tableau
    at, groups = found.at, equations.groups
    bodies = len(system.structure.bodies)
    rates = at.rates[:, :bodies].reshape(tableau.stages, -1, 3)
    b = jnp.asarray(tableau.b)
    q = state.q + h * jnp.tensordot(b, rates, 1)
    coordinates, work = state.coordinates, state.work
    turning, ends = stage_rates(system, at, h), None
    if found.kick is not None:
        ends = ends_of(equations, at, found.kick)
    elif tableau.variational:
        ends = released(equations, found, turning)
    if system.coordinates:
        coordinates = coordinates + h * (b @ turning)
    start, rotors, extra = state.v, state.rates, None if ends is None else ends.work
    if tableau.dissipative:
        jumped = found.given.velocity
        start, rotors, extra = jumped.rows.reshape(state.v.shape), jumped.rotors, found.given.work
    if ends is None:
        v = start + tableau.gained(rates - start)
        carrying = [g.coordinates[:, 0] for g in groups if g.effect.rotors]
        if carrying:
            # Groups own consecutive pieces of the stored rates, in order.
            rotors = rotors + tableau.gained(turning[:, np.concatenate(carrying)] - rotors)
        if not tableau.dissipative and driven(system):
            ends = obeying(system, State(state.t + h, q, v, coordinates, rotors, work))
            extra = ends.work
    if ends is not None:
        v, rotors = ends.velocity.rows.reshape(state.v.shape), ends.velocity.rotors
    after = State(state.t + h, q, v, coordinates, rotors, work, state.dissipated, state.held)
    lost = {}
    if system.structure.inequalities:
        after, lost, driving = after_impacts(system, state, after, h, groups, found, tableau)
        extra = driving if extra is None else extra + driving
    working, relation = [], 0
    for number, (group, power) in enumerate(zip(groups, found.power)):
        if group.effect.works:
            done = (1.0 if group.effect.impulsive else h) * (power @ b)
            if number in lost:
                done = done + lost[number]
            if group.holds and extra is not None:
                done = done + extra[relation : relation + group.count]
            working.append(jnp.sum(done, keepdims=True) if group.is_set else done)
        if group.holds and group.source != "joint":
            relation += group.count * group.multipliers
    # The same of the work account.
    after = replace_fields(after, work=work + jnp.concatenate(working) if working else work)
    if state.elapsed is not None:
        after = replace_fields(after, elapsed=state.elapsed + h)
    if tableau.dissipative:
        dissipated = found.given.loss + (0.0 if state.dissipated is None else state.dissipated)
        after = replace_fields(after, dissipated=dissipated)
    half_turn = _half_turn(at.spin[:, :bodies], h, tableau)
    if ends is not None:
        half_turn = jnp.where(ends.sound, half_turn, jnp.inf)
    return after, half_turn


def _half_turn(spin: Float[Array, "s bodies 3"], h: Array, tableau: Tableau) -> Float[Array, ""]:
    """Tangent of half the largest angle that a body turns by, infinite from half a turn on.

    Cayley's rotation, whose pole that is, has |h omega / 2| itself for it; stages sum up to the angle nearly.
    """
    rates = jnp.sqrt(jnp.sum(spin**2, axis=-1))
    if tableau.stages == 1:
        return 0.5 * h * jnp.max(rates)
    half = 0.5 * h * jnp.max(jnp.asarray(tableau.b) @ rates)
    return jnp.where(half < 0.5 * jnp.pi, jnp.tan(half), jnp.inf)


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
    if equations.exact_by_formulas and not tableau.kick:
        return equations.differentiable(equations.jacobian(y))
    at_rest = jax.tree.map(jnp.zeros_like, state)
    columns = jax.vmap(lambda unit: along(at_rest, unit)[0], out_axes=1)(jnp.eye(y.shape[0], dtype=y.dtype))
    return dense_solver(equations, columns)
