"""Forward kinematics: where the links are, and how they move, from positions and rates of the joints."""

from typing import NamedTuple

import numpy as np

from natcoord_jax.io.description import Description, JointData, LinkData


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


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about an axis (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation of (w, x, y, z), which is made a unit quaternion first."""
    w, v = q[0] / np.linalg.norm(q), np.asarray(q[1:]) / np.linalg.norm(q)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


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
        axes = base.axes @ from_quaternion(q[3:7])
        return Pose(base.point + base.axes @ q[:3], axes, base.axes @ v[:3], axes @ v[3:6])
    direction = pose.axes @ joint.axis
    if joint.kind == "slide":
        by = direction * (q[0] - joint.zero)
        velocity = pose.velocity + np.cross(pose.spin, by) + direction * v[0]
        return Pose(pose.point + by, pose.axes, velocity, pose.spin)
    anchor = pose.axes @ joint.point
    if joint.kind == "hinge":
        axes, spin = pose.axes @ turn(joint.axis, q[0] - joint.zero), pose.spin + direction * v[0]
    else:
        axes = pose.axes @ from_quaternion(q[:4])
        spin = pose.spin + axes @ v[:3]
    arm = axes @ joint.point
    velocity = pose.velocity + np.cross(pose.spin, anchor) - np.cross(spin, arm)
    return Pose(pose.point + anchor - arm, axes, velocity, spin)
