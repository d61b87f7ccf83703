"""The spanning tree of a system as MuJoCo sees it: where each body hangs, and by which joints."""

from dataclasses import dataclass, field, replace

import numpy as np

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.state import State
from natcoord_jax.effects.joints import Cylindrical, Fixed, Planar, Prismatic, Revolute, Spherical, Universal
from natcoord_jax.maths.rotations import to_quaternion
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.system import System

JOINTS: dict[type, tuple[tuple[str, int, int], ...]] = {
    Fixed: (),
    Revolute: (("hinge", 2, 0),),
    Prismatic: (("slide", 2, 0),),
    Spherical: (("ball", 0, -1),),
    Cylindrical: (("slide", 2, 1), ("hinge", 2, 0)),
    Planar: (("slide", 0, 0), ("slide", 1, 1), ("hinge", 2, 2)),
    Universal: (("hinge", 2, 0), ("hinge", 0, 1)),
}
"""For each joint those of MuJoCo, from the parent on: kind, axis of the joint's frame, our coordinate."""

_quaternion = eager_numpy(to_quaternion)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix."""
    return np.asarray(_quaternion(as_array(rotation)))


@dataclass
class HungBy:
    """One of MuJoCo's joints.

    Attributes:
        name: its name.
        kind: "hinge", "slide", "ball" or "free".
        point: in the frame of the body [m].
        axis: in the frame of the body [-].
        coordinate: of ours, (joint, index), or None.
        position: its part of `qpos` [rad, m].
        rate: its part of `qvel` [rad/s, m/s].
    """

    name: str
    kind: str
    point: np.ndarray
    axis: np.ndarray
    coordinate: tuple[str, int] | None
    position: np.ndarray
    rate: np.ndarray


@dataclass
class Hung:
    """One of MuJoCo's bodies.

    Attributes:
        number: of ours.
        name: its name.
        parent: number of the body that it hangs on; -1: the world.
        point: of its frame in that of the parent, all coordinates zero [m].
        axes: likewise, as columns [-].
        joints: by which it hangs.
        unknown: name of a joint that cannot be written.
    """

    number: int
    name: str
    parent: int
    point: np.ndarray
    axes: np.ndarray
    joints: list[HungBy] = field(default_factory=list)
    unknown: str | None = None


def hung_bodies(system: System, state: State) -> list[Hung]:
    """All bodies with mass, parents first; those without hand their joints to the one that hangs on them.

    Raises:
        ValueError: for a body without mass on which several hang.
    """
    count = len(system.structure.bodies)
    parents = [int(p) if p < count else -1 for p in np.asarray(system.tree.parent)]
    order = sorted(range(count), key=lambda b: (_depth(parents, b), b))
    found = {number: _hung(system, state, number, parents[number]) for number in order}
    light = {number for number in order if not np.any(np.asarray(system.mass)[number])}
    for number in light:
        if sum(parent == number for parent in parents) > 1:
            name = system.structure.bodies[number]
            raise ValueError(
                f"save_mjcf: several bodies hang on {name!r}, which has no mass [kg]; give it some"
            )
    return [_with_those_above(found, light, found[number]) for number in order if number not in light]


def _depth(parents: list[int], body: int) -> int:
    return 0 if parents[body] < 0 else 1 + _depth(parents, parents[body])


def _with_those_above(found: dict[int, Hung], light: set[int], body: Hung) -> Hung:
    """A body with the joints of those without mass between it and its parent, in its own frame."""
    while body.parent in light:
        above = found[body.parent]
        joints = [
            replace(j, point=body.axes.T @ (j.point - body.point), axis=body.axes.T @ j.axis)
            for j in above.joints
        ]
        point, axes = above.point + above.axes @ body.point, above.axes @ body.axes
        unknown = body.unknown or above.unknown
        body = Hung(body.number, body.name, above.parent, point, axes, joints + body.joints, unknown)
    return body


def _kind_of(system: System, number: int) -> type | None:
    """Class of the joint that carries a body; None: it is free."""
    for group in system.joints:
        places = np.asarray(group.joints)[:, 0]
        if group.in_tree and number in places:
            return type(group.effect)
    return None


def _hung(system: System, state: State, number: int, parent: int) -> Hung:
    """One body with its joints."""
    name, rows = system.structure.bodies[number], np.asarray(state.rows)
    kind = _kind_of(system, number)
    if kind is None:
        return _free(system, state, number)
    # Point and axes (rows) of its joint in the parent's frame and in its own, which coincide for zeros.
    weights = np.asarray(system.frames)[number][np.asarray(system.tree.side)[number]]
    above, own = ((frame[0, 1:], frame[1:, 1:]) for frame in weights)
    axes = above[1].T @ own[1]
    body = Hung(number, name, parent, above[0] - axes @ own[0], axes)
    if kind not in JOINTS:
        body.unknown = system.structure.joints[number]
        return body
    joint, coordinates, rates = system.structure.joints[number], state.coordinates, state_rates(system, state)
    places = {key: k for k, key in enumerate(system.structure.coordinates)}
    forward = int(np.asarray(system.tree.side)[number, 1]) == 1
    # Seen from the child, motions come in the reverse order, and the other way round.
    for made, axis, index in JOINTS[kind] if forward else JOINTS[kind][::-1]:
        if index < 0:
            position, rate = _ball(rows, np.asarray(state.row_rates), number, parent, body)
            body.joints.append(HungBy(joint, made, own[0], own[1][axis], None, position, rate))
            continue
        place = places[(joint, index)]
        label = joint if len(JOINTS[kind]) == 1 else f"{joint} {index}"
        numbers = np.atleast_1d(coordinates[place]), np.atleast_1d(rates[place])
        direction = own[1][axis] * (1.0 if forward else -1.0)
        body.joints.append(HungBy(label, made, own[0], direction, (joint, index), *numbers))
    return body


def _free(system: System, state: State, number: int) -> Hung:
    """A body that floats, at where it is."""
    rows, rates = (np.asarray(x)[number] for x in (state.rows, state.row_rates))
    axes = rows[1:].T
    spin = 0.5 * np.sum(np.cross(rows[1:], rates[1:]), axis=0)
    name = system.structure.bodies[number]
    position, rate = np.concatenate([rows[0], quaternion(axes)]), np.concatenate([rates[0], axes.T @ spin])
    joint = HungBy(f"{name} free", "free", np.zeros(3), np.eye(3)[2], None, position, rate)
    return Hung(number, name, -1, rows[0], axes, [joint])


def _ball(
    rows: np.ndarray, rates: np.ndarray, number: int, parent: int, body: Hung
) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion from the pose where the frames coincide, and relative angular velocity in the body."""
    above, spin = np.eye(3), np.zeros(3)
    if parent >= 0:
        above = rows[parent, 1:].T
        spin = 0.5 * np.sum(np.cross(rows[parent, 1:], rates[parent, 1:]), axis=0)
    axes = rows[number, 1:].T
    own = 0.5 * np.sum(np.cross(rows[number, 1:], rates[number, 1:]), axis=0)
    return quaternion((above @ body.axes).T @ axes), axes.T @ (own - spin)
