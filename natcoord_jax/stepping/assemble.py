"""Assembly of a state: positions and velocities brought to obey the constraints."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import REASONS, Result, SimulationError
from natcoord_jax.core.state import STATE, State
from natcoord_jax.maths.rotations import orthonormalise
from natcoord_jax.mechanics.admissible_velocities import with_admissible_velocities
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.projection import moving, twists_of
from natcoord_jax.mechanics.violations import GAP, worst_violation
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.closing import closed
from natcoord_jax.system import System


@briefly
def _assembled(system: System, state: State) -> tuple[State, Array]:
    found, code = with_admissible_positions(system, state)
    found, rate_code = with_admissible_velocities(system, found, state_rates(system, state))
    return replace_fields(found, held=None), jnp.maximum(code, rate_code)


def with_admissible_positions(system: System, state: State) -> tuple[State, Array]:
    """State with orthonormal directors and positions that obey the constraints; and a result code.

    Bodies keep their velocities and angular velocities.
    """
    rows = state.rows
    squared = jnp.concatenate([rows[:, :1], orthonormalise(rows[:, 1:])], axis=1).reshape(-1, 3)
    state = replace_fields(state, q=squared)
    twists = twists_of(system, state)
    found, code = closed(system, replace_fields(state, v=jnp.zeros_like(state.v)))
    return moving(found, twists), code


@checked(system=SYSTEM, state=STATE)
def assemble(system: System, state: State) -> State:
    """Bring positions and velocities to obey the constraints, from wherever they are.

    Directors are made orthonormal; bodies are turned and shifted until joints, drives and relations between
    coordinates are obeyed, each step at least expense of mass; then velocities are projected in the metric of
    the mass. Coordinates and rates that `System.with_coordinate` has set are kept where the constraints allow
    it (an eager call warns of coordinates that are not), and angles are counted over all turns on the way.
    Rotor rates follow. Pure, jittable and differentiable in every mode, with respect to the state and to
    every parameter that moves geometry.

    Args:
        system: compiled system.
        state: any state.

    Returns:
        The assembled state; where no admissible state is found, all NaN inside jit.

    Raises:
        SimulationError: in an eager call, if no admissible state is found: with the joint, drive or coupling
            that stays open, and by how much.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm, wheel = (scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0))) for _ in range(2))
        >>> hinge, axle = (scene.add(nc.Revolute(nc.ground, body)) for body in (arm, wheel))
        >>> gear = scene.add(nc.Coupling((axle, hinge), factors=(1.0, -20.0)))
        >>> system, state = scene.compile()
        >>> state = nc.assemble(system, system.with_coordinate(state, hinge, 0.5))
        >>> state.coordinates.round(9).tolist()
        [0.5, 10.0]
    """
    assembled, code = _assembled(system, state)
    if is_concrete(code):
        result = Result(int(code))
        if result != Result.SUCCESSFUL:
            raise SimulationError(_failure(system, assembled, result), result, assembled)
        if state.held is not None:
            _warn_of_what_moved(system, state, np.asarray(state.held[0]), assembled)
        return assembled
    return jax.tree.map(lambda x: jnp.where(code == 0, x, jnp.nan), assembled)


def _warn_of_what_moved(system: System, state: State, held: np.ndarray, assembled: State) -> None:
    """Say which coordinates were set to what the constraints do not allow."""
    for k, (name, _) in enumerate(system.structure.coordinates):
        given, found = float(state.coordinates[k]), float(assembled.coordinates[k])
        if held[k] and abs(found - given) > 1e3 * GAP * (1.0 + abs(given)):
            unit = next(g.axis.unit for g in system.coordinates if k in np.asarray(g.index))
            warnings.warn(
                f"the constraints do not allow joint {name!r} to be at {given:.6g} {unit}, where it was set; "
                f"it was assembled at {found:.6g} {unit}",
                stacklevel=3,
            )


def _failure(system: System, state: State, result: Result) -> str:
    """Why a state could not be assembled, in words."""
    if result == Result.NONFINITE:
        return f"the state cannot be assembled: {REASONS[result]}; check its positions and the parameters"
    open_part = worst_violation(system, state)
    if open_part is not None:
        return (
            f"the state cannot be assembled: {open_part} stays open by {open_part.size:.3g} {open_part.unit} "
            "in the nearest state that was found; check its lengths and targets against those of the parts "
            "that it is joined to, or set coordinates on another side of where it sticks"
        )
    moving = worst_violation(system, state, rates=True)
    return f"the velocities cannot be made to obey the constraints: {moving} misses its rate by " + (
        f"{moving.size:.3g} {moving.unit}; check drives that ask for what others or the position forbid"
        if moving is not None
        else "little"
    )
