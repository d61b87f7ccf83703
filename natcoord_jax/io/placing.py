"""A state with a robot at given positions and rates of its joints, by forward kinematics."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from natcoord_jax.bodies.rigid import orientation
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.io.description import Description, JointData, LinkData
from natcoord_jax.system import System

if TYPE_CHECKING:
    from natcoord_jax.io.robot import RobotHandle


def _given(value: Any, default: np.ndarray, what: str, unit: str) -> np.ndarray:
    found = default if value is None else np.asarray(value, float)
    if found.shape != default.shape:
        raise ValueError(f"{what} [{unit}] has shape {found.shape}; pass {default.shape}, in MuJoCo's layout")
    if not np.all(np.isfinite(found)):
        raise ValueError(f"{what} [{unit}] is not finite: {found}; pass finite numbers")
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
    stored, own = np.array(state.rates), {handle.name for handle in robot.parts.joints.values()}
    for group in system.effects:
        if group.effect.rotors:
            for rotor, place in zip(np.asarray(group.rotors)[:, 0], np.asarray(group.coordinates)[:, 0]):
                if system.structure.coordinates[place][0] in own:
                    stored[rotor] = turning[place]
    return replace_fields(
        state,
        q=as_array(rows.reshape(-1, 3)),
        v=as_array(moving.reshape(-1, 3)),
        coordinates=as_array(coordinates),
        rates=as_array(stored),
    )


class Pose(NamedTuple):
    """A frame and its motion.

    Attributes:
        point: [m].
        axes: as columns [-].
        velocity: of the point [m/s].
        spin: angular velocity [rad/s], world components.
    """

    point: np.ndarray
    axes: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Point and directors (4, 3), and their velocities."""
        directors = self.axes.T
        rates = np.cross(self.spin, directors)
        return np.vstack([self.point, directors]), np.vstack([self.velocity, rates])


def at_rest(point: np.ndarray, axes: np.ndarray) -> Pose:
    """A frame that does not move."""
    return Pose(np.asarray(point, float), np.asarray(axes, float), np.zeros(3), np.zeros(3))


def rotation(value: Any) -> np.ndarray:
    """Matrix of a quaternion (w, x, y, z) of any length, or of an axis and an angle [rad]."""
    return np.asarray(orientation(value, "robot"))


def link_poses(robot: Description, base: Pose, positions: np.ndarray, rates: np.ndarray) -> list[list[Pose]]:
    """For each link the frames after each of its joints, the last of them the link's own.

    Args:
        robot: its links, parents first.
        base: frame that the file's world is placed at.
        positions: of all joints, in the layout of MuJoCo's `qpos`.
        rates: of all joints, in the layout of MuJoCo's `qvel`.
    """
    found: list[list[Pose]] = []
    for link in robot.links:
        if link.parent < 0:
            carrier, point, axes = base, link.position, link.rotation
        else:
            parent = robot.links[link.parent]
            carrier = found[link.parent][-1]
            point = parent.rotation.T @ (link.position - parent.position)
            axes = parent.rotation.T @ link.rotation
        found.append(_along(link, _carried(carrier, point, axes), base, positions, rates))
    return found


def _carried(carrier: Pose, point: np.ndarray, axes: np.ndarray) -> Pose:
    """A frame that is fixed in another."""
    arm = carrier.axes @ point
    velocity = carrier.velocity + np.cross(carrier.spin, arm)
    return Pose(carrier.point + arm, carrier.axes @ axes, velocity, carrier.spin)


def _along(link: LinkData, pose: Pose, base: Pose, positions: np.ndarray, rates: np.ndarray) -> list[Pose]:
    """The frames after each joint of a link."""
    found = []
    for joint in link.joints:
        pose = _moved(joint, pose, base, positions[joint.position_index :], rates[joint.rate_index :])
        found.append(pose)
    return found


def _moved(joint: JointData, pose: Pose, base: Pose, q: np.ndarray, v: np.ndarray) -> Pose:
    """A frame after one more joint."""
    if joint.kind == "free":
        axes = base.axes @ rotation(q[3:7])
        return Pose(base.point + base.axes @ q[:3], axes, base.axes @ v[:3], axes @ v[3:6])
    direction = pose.axes @ joint.axis
    if joint.kind == "slide":
        by = direction * (q[0] - joint.zero)
        velocity = pose.velocity + np.cross(pose.spin, by) + direction * v[0]
        return Pose(pose.point + by, pose.axes, velocity, pose.spin)
    anchor = pose.axes @ joint.point
    if joint.kind == "hinge":
        axes, spin = pose.axes @ rotation((joint.axis, q[0] - joint.zero)), pose.spin + direction * v[0]
    else:
        axes = pose.axes @ rotation(q[:4])
        spin = pose.spin + axes @ v[:3]
    arm = axes @ joint.point
    velocity = pose.velocity + np.cross(pose.spin, anchor) - np.cross(spin, arm)
    return Pose(pose.point + anchor - arm, axes, velocity, spin)
