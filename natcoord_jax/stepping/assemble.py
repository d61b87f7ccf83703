"""Assembly of a state: positions and velocities projected onto the constraints."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.assembly.coordinates import coordinate_values, state_rates
from natcoord_jax.assembly.diagnostics import rows_with_ground
from natcoord_jax.assembly.projection import Projection
from natcoord_jax.assembly.system import System
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import REASONS, Result, SimulationError
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import orthonormalise
from natcoord_jax.stepping.newton import newton

TOLERANCE = 1e-14
"""Accuracy of the projection relative to the extent of the system."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(make: Any, system: System, state: State) -> tuple[Array, Array]:
    """Unknowns and result code of a projection, differentiated implicitly."""
    return newton(make(system, state), TOLERANCE)


@_solve.defjvp
def _solve_jvp(make: Any, primals: tuple, tangents: tuple):
    y, code = _solve(make, *primals)
    moved = jax.jvp(lambda *args: make(*args).residual(y)[0], primals, tangents)[1]
    equations = make(*primals)
    y_dot = -equations.differentiable(equations.jacobian(y)).solve(moved)
    return (y, code), (y_dot, jnp.zeros(code.shape, jax.dtypes.float0))


def nearest_coordinates(system: System, state: State) -> Array:
    """Joint coordinates of the positions, each angle taken in the turn nearest to the stored one."""
    values = coordinate_values(system, rows_with_ground(state.q))
    for group in system.coordinates:
        if group.axis.unit == "rad":
            turns = jnp.round((state.coordinates - values)[group.index] / (2 * jnp.pi))
            values = values.at[group.index].add(2 * jnp.pi * turns)
    return values


@briefly
def _assembled(system: System, state: State) -> tuple[State, Array]:
    state, code = with_admissible_positions(system, state)
    state, rate_code = with_admissible_velocities(system, state)
    return state, jnp.maximum(code, rate_code)


@briefly
def with_admissible_positions(system: System, state: State) -> tuple[State, Array]:
    """State with orthonormal directors and positions that obey the constraints; and a result code."""
    rows = state.q.reshape(-1, 4, 3)
    squared = jnp.concatenate([rows[:, :1], orthonormalise(rows[:, 1:])], axis=1).reshape(-1, 3)
    state = replace_fields(state, q=squared)
    y, code = _solve(Projection.of_positions, system, state)
    state = replace_fields(state, q=state.q + Projection.of_positions(system, state).moved(y))
    return replace_fields(state, coordinates=nearest_coordinates(system, state)), code


def with_admissible_velocities(system: System, state: State) -> tuple[State, Array]:
    """State whose velocities, projected in the metric of the mass, obey the constraints; a result code."""
    w, code = _solve(Projection.of_velocities, system, state)
    state = replace_fields(state, v=Projection.of_velocities(system, state).moved(w))
    return replace_fields(state, rates=_rotor_rates(system, state)), code


def _rotor_rates(system: System, state: State) -> Array:
    """Rates of the joint coordinates that carry rotors."""
    if not state.rates.shape[0]:
        return state.rates
    every, rates = state_rates(system, state), state.rates
    for group in system.effects:
        if group.effect.rotors:
            rates = rates.at[group.rotors[:, 0]].set(every[group.coordinates[:, 0]])
    return rates


def assemble(system: System, state: State) -> State:
    """Project positions and velocities onto the constraints.

    Directors are made orthonormal, positions move along the constraint normals, velocities are projected in
    the metric of the mass, drives and relations between coordinates included; coordinates and rotor rates
    follow. Pure, jittable and implicitly differentiable, with respect to the state and to every parameter
    that moves geometry.

    Args:
        system: compiled system.
        state: any state near an admissible one.

    Returns:
        The assembled state; where no admissible state is found, all NaN inside jit.

    Raises:
        SimulationError: in an eager call, if no admissible state is found nearby.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), angular_velocity=(0, 0, 1)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 0, 1)))
        >>> system, state = scene.compile()
        >>> state = nc.assemble(system, state)
    """
    assembled, code = _assembled(system, state)
    if is_concrete(code):
        result = Result(int(code))
        if result != Result.SUCCESSFUL:
            raise SimulationError(
                f"no admissible state was found near this one ({REASONS[result]}); start closer to one",
                result,
                assembled,
            )
        return assembled
    return jax.tree.map(lambda x: jnp.where(code == 0, x, jnp.nan), assembled)
