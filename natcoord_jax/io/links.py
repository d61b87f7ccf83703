"""Links and joints from MuJoCo's compiled model."""

from dataclasses import replace
from typing import Any

import numpy as np

from natcoord_jax.io.description import UNBOUNDED, FrameData, JointData, LinkData, Range
from natcoord_jax.io.notes import Notes, mujoco
from natcoord_jax.io.source import Source

KINDS = ("free", "ball", "slide", "hinge")
"""In the order of MuJoCo's numbers."""


class Poses:
    """Where everything is in the pose of the file, and which link every body of the file belongs to."""

    def __init__(self, model: Any) -> None:
        package = mujoco()
        data = package.MjData(model)
        data.qpos[:] = model.qpos0
        package.mj_kinematics(model, data)
        self.model = model
        self.points = np.array(data.xpos)
        self.axes = np.array(data.xmat).reshape(-1, 3, 3)
        self.centres = np.array(data.xipos)
        self.principal = np.array(data.ximat).reshape(-1, 3, 3)
        self.site_points = np.array(data.site_xpos).reshape(-1, 3)
        self.site_axes = np.array(data.site_xmat).reshape(-1, 3, 3)
        weld = np.array(model.body_weldid)
        # Mocap bodies are welded to nothing and have no joints: here they are part of the ground.
        self.heads = [b for b in range(1, model.nbody) if weld[b] == b and model.body_jntnum[b] > 0]
        number = {head: k for k, head in enumerate(self.heads)}
        self.link_of = [number.get(int(head), -1) for head in weld]

    def frame(self, body: int, point: np.ndarray, axes: np.ndarray) -> FrameData:
        """A frame of the world, as carried by the link of a body."""
        link = self.link_of[body]
        if link < 0:
            return FrameData(-1, np.array(point), np.array(axes))
        origin, own = self.points[self.heads[link]], self.axes[self.heads[link]]
        return FrameData(link, own.T @ (point - origin), own.T @ axes)

    def site(self, number: int) -> FrameData:
        """A site, as carried by its link."""
        body = int(self.model.site_bodyid[number])
        return self.frame(body, self.site_points[number], self.site_axes[number])

    def in_body(self, body: int, point: np.ndarray, axes: np.ndarray | None = None) -> FrameData:
        """A frame of a body of the file, as carried by its link."""
        own = self.axes[body]
        return self.frame(body, self.points[body] + own @ point, own if axes is None else own @ axes)


def body_name(model: Any, body: int) -> str:
    """Name of a body, also where the file gives none."""
    return model.body(body).name or f"body {body}"


def joint_name(model: Any, joint: int) -> str:
    """Name of a joint, also where the file gives none."""
    name = model.joint(joint).name
    if name:
        return name
    owner = int(model.jnt_bodyid[joint])
    body, first = body_name(model, owner), int(model.body_jntadr[owner])
    kind = KINDS[model.jnt_type[joint]]
    return f"{body} {kind}" + (f" {joint - first + 1}" if model.body_jntnum[owner] > 1 else "")


def read_links(source: Source, poses: Poses) -> tuple[LinkData, ...]:
    """All links, parents first."""
    model, links = source.model, []
    for number, head in enumerate(poses.heads):
        members = [b for b in range(1, model.nbody) if poses.link_of[b] == number]
        mass, com, inertia = _together(poses, head, members)
        if {body_name(model, b) for b in members} & source.massless and mass < 1e-12:
            mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        first, count = int(model.body_jntadr[head]), int(model.body_jntnum[head])
        joints = [_joint(source, joint) for joint in range(first, first + count)]
        gravity = [(b, float(model.body_gravcomp[b] * model.body_mass[b])) for b in members]
        lifted = tuple((poses.in_body(b, model.body_ipos[b]).position, m) for b, m in gravity if m)
        links.append(
            LinkData(
                name=body_name(model, head),
                parent=poses.link_of[int(model.body_parentid[head])],
                position=poses.points[head],
                rotation=poses.axes[head],
                mass=mass,
                com=com,
                inertia=inertia,
                joints=tuple(joints),
                members=tuple(body_name(model, b) for b in members),
                floats=lifted,
            )
        )
    return tuple(links)


def _together(poses: Poses, head: int, members: list[int]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it of several bodies, in the frame of the first."""
    model, own = poses.model, poses.axes[head]
    masses = np.array([model.body_mass[b] for b in members])
    centres = np.array([own.T @ (poses.centres[b] - poses.points[head]) for b in members])
    total = float(masses.sum())
    if len(members) == 1:
        com = centres[0]
    else:
        com = masses @ centres / total if total > 0 else np.zeros(3)
    inertia = np.zeros((3, 3))
    for body, mass, centre in zip(members, masses, centres):
        axes, arm = own.T @ poses.principal[body], centre - com
        inertia += (axes * model.body_inertia[body]) @ axes.T
        inertia += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return total, com, 0.5 * (inertia + inertia.T)


def _joint(source: Source, number: int) -> JointData:
    """A joint with what acts on it."""
    model, name = source.model, joint_name(source.model, number)
    kind = KINDS[model.jnt_type[number]]
    place, rate = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
    plain = JointData(
        name=name,
        kind=kind,
        point=np.array(model.jnt_pos[number]),
        axis=np.array(model.jnt_axis[number]),
        position_index=place,
        rate_index=rate,
        stiffness=float(model.jnt_stiffness[number]),
        damping=float(model.dof_damping[rate]),
        velocity=source.velocities.get(name, np.inf),
    )
    _list_what_is_left(source.notes, model, number, plain)
    if not plain.has_coordinate:
        return plain
    limited = bool(model.jnt_limited[number])
    bounded = bool(model.jnt_actfrclimited[number])
    return replace(
        plain,
        zero=float(model.qpos0[place]),
        range=pair(model.jnt_range[number]) if limited else UNBOUNDED,
        stop=_stop(model, number) if limited else 0.0,
        effort=pair(model.jnt_actfrcrange[number]) if bounded else UNBOUNDED,
        rest=float(model.qpos_spring[place]),
        armature=float(model.dof_armature[rate]),
        friction=float(model.dof_frictionloss[rate]),
    )


def pair(limits: Any) -> Range:
    """Two numbers of MuJoCo's."""
    return float(limits[0]), float(limits[1])


def _stop(model: Any, number: int) -> float:
    """Stiffness of an elastic stop that gives way as far as MuJoCo's soft limit under a steady load.

    There the acceleration a_1 that the constraint leaves of a_0 obeys a_1 + d (b v + k r) = (1 - d) a_0,
    with the impedance d and, where it is largest, k = 1 / (d T^2 z^2) of time constant T and damping ratio
    z (documentation, "Solver parameters"). At rest that is a force d k / ((1 - d) A) per r, with the inverse
    A of the inertia.
    """
    first, second = model.jnt_solref[number]
    if first > 0 and not model.opt.disableflags & mujoco().mjtDisableBit.mjDSBL_REFSAFE:
        first = max(first, 2.0 * model.opt.timestep)
    impedance = float(np.clip(model.jnt_solimp[number][1], 1e-4, 0.9999))
    k = 1.0 / (impedance * (first * second) ** 2) if first > 0 else -first / impedance
    inverse = max(float(model.dof_invweight0[model.jnt_dofadr[number]]), 1e-15)
    return impedance * k / ((1.0 - impedance) * inverse)


def _list_what_is_left(notes: Notes, model: Any, number: int, joint: JointData) -> None:
    """What a joint has in the file that is not mapped."""
    rates = slice(joint.rate_index, joint.rate_index + {"free": 6, "ball": 3}.get(joint.kind, 1))
    checks = {
        "a spring that is no linear one": (getattr(model, "jnt_stiffnesspoly", None), number),
        "a damper that is no linear one": (getattr(model, "dof_dampingpoly", None), rates),
        "a spring that yields": (getattr(model, "jnt_springyield", None), number),
        "the margin of its limit": (model.jnt_margin, number),
    }
    if np.any(model.jnt_actfrclimited[number]):
        # (Beside them gravity is compensated, as it is here, whatever carries it.)
        checks["gravity that its actuators compensate"] = (model.jnt_actgravcomp, number)
    if not joint.has_coordinate:
        several = f"of a {joint.kind} joint, which has no single coordinate"
        checks |= {
            f"the armature {several}": (model.dof_armature, rates),
            f"the dry friction {several}": (model.dof_frictionloss, rates),
            f"the limit {several}": (model.jnt_limited, number),
        }
    if joint.kind == "free":
        checks["the damping of a free joint"] = (model.dof_damping, rates)
        checks["the spring of a free joint"] = (model.jnt_stiffness, number)
    for reason, (values, index) in checks.items():
        if values is not None and np.any(values[index]):
            notes.left_out(joint.name, reason)
