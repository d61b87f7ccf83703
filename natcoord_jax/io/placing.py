"""A state with a robot at given positions and rates of its joints."""

from typing import TYPE_CHECKING, Any

import numpy as np

from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.io.motion import at_rest, link_poses
from natcoord_jax.system import System

if TYPE_CHECKING:
    from natcoord_jax.io.robot import RobotHandle


def _given(value: Any, default: np.ndarray, what: str, unit: str) -> np.ndarray:
    found = default if value is None else np.asarray(value, float)
    if found.shape != default.shape:
        raise ValueError(f"{what} [{unit}] has shape {found.shape}; pass {default.shape}, in MuJoCo's layout")
    return found


def with_positions(robot: "RobotHandle", system: System, state: State, positions: Any, rates: Any) -> State:
    """See `RobotHandle.state`."""
    file = robot.description
    label = f"robot {robot.name!r}"
    if not is_concrete(state, positions, rates):
        raise ValueError(
            f"{label}: positions and rates [rad, m] are not known yet inside of a transformation; "
            "set joint coordinates there with system.with_coordinate"
        )
    q = _given(positions, file.positions, f"{label}: positions", "rad, m")
    v = _given(rates, np.zeros(file.rate_count), f"{label}: rates", "rad/s, m/s")
    rows, moving = (np.array(x) for x in (state.rows, state.row_rates))
    poses = link_poses(file, at_rest(*robot.place), q, v)
    for handles, frames in zip(robot.parts.carriers, poses):
        for handle, pose in zip(handles, frames):
            number = system.body_index(handle)
            rows[number], moving[number] = pose.rows()
    coordinates, turning = np.array(state.coordinates), np.zeros(len(state.coordinates))
    places = {name: k for k, name in enumerate(system.structure.coordinates)}
    for joint in file.joints.values():
        if joint.has_coordinate:
            place = places[(robot.parts.joints[joint.name].name, 0)]
            coordinates[place] = q[joint.position_index]
            turning[place] = v[joint.rate_index]
    stored = np.array(state.rates)
    for group in system.effects:
        if group.effect.rotors:
            for rotor, place in zip(np.asarray(group.rotors)[:, 0], np.asarray(group.coordinates)[:, 0]):
                if system.structure.coordinates[place][0] in robot.parts.joint_names:
                    stored[rotor] = turning[place]
    return replace_fields(
        state,
        q=as_array(rows.reshape(-1, 3)),
        v=as_array(moving.reshape(-1, 3)),
        coordinates=as_array(coordinates),
        rates=as_array(stored),
    )
