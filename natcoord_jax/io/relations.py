"""Equality constraints from MuJoCo's compiled model, and what else it has that is not mapped."""

from typing import Any

import numpy as np

from natcoord_jax.io.actuation import fixed_tendon
from natcoord_jax.io.description import EqualityData
from natcoord_jax.io.links import KINDS, Poses, body_name, joint_name
from natcoord_jax.io.notes import Notes, mujoco

COINCIDENT = 1e-9
"""By how much a weld may be off in the pose of the file [m, -]."""


def read_equalities(model: Any, poses: Poses, notes: Notes) -> tuple[EqualityData, ...]:
    """Connections, welds and relations between coordinates."""
    kinds, found = mujoco().mjtEq, []
    readers = {
        kinds.mjEQ_CONNECT: _connect,
        kinds.mjEQ_WELD: _weld,
        kinds.mjEQ_JOINT: _related_joints,
        kinds.mjEQ_TENDON: _related_tendons,
    }
    for number in range(model.neq):
        name = model.equality(number).name or f"equality {number + 1}"
        kind = kinds(int(model.eq_type[number]))
        read = readers.get(kind)
        if not model.eq_active0[number]:
            made: EqualityData | str = "it is not active in the file"
        elif read is None:
            made = f"equalities of type {kind.name.rpartition('_')[2].lower()} are not mapped"
        else:
            made = read(model, poses, number, name)
        if isinstance(made, str):
            notes.left_out(name, made)
        else:
            found.append(made)
    if found:
        notes.changed("equality constraints", "hold exactly; MuJoCo's are soft")
    return tuple(found)


def _ends(
    model: Any, poses: Poses, number: int, *places: np.ndarray, turned: np.ndarray | None = None
) -> tuple[Any, Any]:
    """Two frames of bodies, the first of them turned, or of sites, as carried by their links."""
    objects = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
    if model.eq_objtype[number] == mujoco().mjtObj.mjOBJ_SITE:
        ends = [
            poses.frame(int(model.site_bodyid[s]), poses.site_points[s], poses.site_axes[s]) for s in objects
        ]
    else:
        ends = [poses.in_body(*frame) for frame in zip(objects, places, (turned, None))]
    return ends[0], ends[1]


def _connect(model: Any, poses: Poses, number: int, name: str) -> EqualityData | str:
    data = model.eq_data[number]
    ends = _ends(model, poses, number, data[:3], data[3:6])
    if ends[0].link == ends[1].link:
        return "both ends are of the same body"
    return EqualityData(name, "connect", frames=ends)


def _weld(model: Any, poses: Poses, number: int, name: str) -> EqualityData | str:
    data, turned = model.eq_data[number], np.zeros(9)
    mujoco().mju_quat2Mat(turned, data[6:10])
    ends = _ends(model, poses, number, data[3:6], data[:3], turned=turned.reshape(3, 3))
    if ends[0].link == ends[1].link:
        return "both ends are of the same body"
    places = [_placed(poses, end) for end in ends]
    if max(np.max(np.abs(a - b)) for a, b in zip(*places)) > COINCIDENT:
        return "it asks for another pose than that of the file; pose the bodies so that it holds"
    return EqualityData(name, "weld", frames=ends)


def _placed(poses: Poses, frame: Any) -> tuple[np.ndarray, np.ndarray]:
    """Point and axes in the world, in the pose of the file."""
    if frame.link < 0:
        return frame.position, frame.rotation
    head = poses.heads[frame.link]
    return poses.points[head] + poses.axes[head] @ frame.position, poses.axes[head] @ frame.rotation


def _related_joints(model: Any, poses: Poses, number: int, name: str) -> EqualityData | str:
    """Y - y_0 = a_0 + a_1 (x - x_0), the higher coefficients zero."""
    polynomial = np.array(model.eq_data[number][:5])
    if np.any(polynomial[2:]):
        return "only linear relations between joints are mapped"
    joints = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
    joints = [j for j in joints if j >= 0]
    if any(KINDS[model.jnt_type[j]] in ("free", "ball") for j in joints):
        return "one of its joints neither turns about nor slides along one axis"
    factors = (1.0, -float(polynomial[1]))[: len(joints)]
    begun = [float(model.qpos0[model.jnt_qposadr[j]]) for j in joints]
    offset = float(polynomial[0] + np.dot(factors, begun))
    names = tuple(joint_name(model, j) for j in joints)
    return EqualityData(name, "joint", joints=names, factors=factors, offset=offset)


def _related_tendons(model: Any, poses: Poses, number: int, name: str) -> EqualityData | str:
    """The same between tendons that are sums of coordinates."""
    polynomial = np.array(model.eq_data[number][:5])
    if np.any(polynomial[2:]):
        return "only linear relations between tendons are mapped"
    tendons = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
    factors, offset = {}, float(polynomial[0])
    for tendon, sign in zip([t for t in tendons if t >= 0], (1.0, -float(polynomial[1]))):
        parts = fixed_tendon(model, tendon)
        if parts is None:
            return "a tendon of it runs through space"
        offset += sign * float(model.tendon_length0[tendon])
        for joint, factor in parts.items():
            factors[joint] = factors.get(joint, 0.0) + sign * factor
    kept = {joint: factor for joint, factor in factors.items() if factor}
    return EqualityData(name, "joint", joints=tuple(kept), factors=tuple(kept.values()), offset=offset)


def list_the_rest(model: Any, notes: Notes) -> None:
    """What a robot has no place for."""
    contacts = int(np.sum((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    disabled = mujoco().mjtDisableBit.mjDSBL_CONTACT | mujoco().mjtDisableBit.mjDSBL_CONSTRAINT
    if (contacts > 1 or model.npair) and not model.opt.disableflags & disabled:
        notes.left_out(
            f"contact of {contacts} geoms",
            "contacts of a file are not read; add nc.Contact between its bodies",
        )
    for tendon in range(model.ntendon):
        name = model.tendon(tendon).name or f"tendon {tendon + 1}"
        acting = "stiffness stiffnesspoly damping dampingpoly frictionloss armature limited actfrclimited"
        values = {what: getattr(model, f"tendon_{what}", None) for what in acting.split()}
        has = [what for what, x in values.items() if x is not None and np.any(x[tendon])]
        if has:
            notes.left_out(f"{', '.join(has)} of {name}", "of tendons only actuators are mapped")
    if model.opt.density or model.opt.viscosity:
        notes.left_out("fluid", "the forces of a medium around the bodies are not mapped")
    for body in range(1, model.nbody):
        if model.body_mocapid[body] >= 0:
            notes.changed(body_name(model, body), "a mocap body stays where it is in the file")
    for count, what in ((model.nsensor, "sensors"), (model.nplugin, "plugins"), (model.nflex, "flexes")):
        if count:
            reason = "read what you need with system.sense" if what == "sensors" else "they are not mapped"
            notes.left_out(f"{count} {what}", reason)
