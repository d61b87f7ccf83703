"""Robots beside MuJoCo: mass matrix, gravity torques and accelerations at random states."""

from dataclasses import dataclass

import jax
import mujoco
import numpy as np

import natcoord_jax as nc

SOFT = ("CONTACT", "LIMIT", "FRICTIONLOSS", "EQUALITY", "CONSTRAINT")
"""What MuJoCo has as soft constraints: switched off on both sides."""
HARD = ("limits", "friction", "equalities", "visuals")


@dataclass
class Agreement:
    """Largest differences over the states, relative to the largest number of each."""

    mass: float
    gravity: float
    acceleration: float
    condition: float = 1.0
    """Of the mass matrix, the largest."""


def actuator_name(model, number):
    """As our inputs are called."""
    return model.actuator(number).name or f"actuator {number + 1}"


def control_of(data, number):
    """The control of an actuator, of which MuJoCo has had several for one since 4.0."""
    addresses = getattr(data.model, "actuator_ctrladr", None)
    return data.ctrl[number if addresses is None else int(addresses[number])]


def comparable(robot):
    """MuJoCo's model without what is not mapped; all of that is in the notes of the robot."""
    model = robot.description.model
    for name in SOFT:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    model.opt.density = model.opt.viscosity = 0.0
    model.tendon_stiffness[:] = model.tendon_damping[:] = model.tendon_armature[:] = 0.0
    for joint in range(model.njnt):
        kind, first = model.jnt_type[joint], model.jnt_dofadr[joint]
        rates = slice(first, first + (6, 3, 1, 1)[kind])
        if kind < 2:
            model.dof_armature[rates] = 0.0
        if kind == 0:
            model.dof_damping[rates] = model.jnt_stiffness[joint] = 0.0
    for number in range(len(model.actuator_trntype)):
        if actuator_name(model, number) not in robot.inputs:
            model.actuator_gainprm[number] = model.actuator_biasprm[number] = 0.0
            model.actuator_gaintype[number] = model.actuator_biastype[number] = 0
    model.actuator_dynprm[:] = 0.0
    return model


def random_data(model, rng):
    """A random state with random controls, activations and torques."""
    data, moved = mujoco.MjData(model), np.array(model.qpos0)
    mujoco.mj_integratePos(model, moved, rng.normal(size=model.nv), 1.0)
    data.qpos[:], data.qvel[:] = moved, rng.normal(size=model.nv)
    data.ctrl[:], data.act[:] = rng.normal(size=model.nu), rng.normal(size=model.na)
    return data


def inputs_of(robot, system, data, rng):
    """Our inputs for the same: controls or activations, and torques of motors that the file does not have."""
    model, values = data.model, np.zeros(len(system.structure.inputs))
    numbers = {actuator_name(model, k): k for k in range(len(model.actuator_trntype))}
    for place, name in enumerate(robot.inputs):
        if name in numbers:
            number = numbers[name]
            active = model.actuator_actadr[number]
            values[place] = control_of(data, number) if active < 0 else data.act[active]
        else:
            values[place] = data.qfrc_applied[robot.joints[name].rate_index] = rng.normal()
    return values


def dynamics(robot, system, handle, start, positions):
    """Mass matrix and gravity torques, from the mass blocks of the compiled system."""
    velocities = np.array([
        np.asarray(handle.state(system, start, positions, rates).v).reshape(-1, 4, 3)
        for rates in np.eye(robot.description.rate_count)
    ])  # fmt: skip
    blocks = np.asarray(system.mass)
    mass = np.einsum("ilac,lab,jlbc->ij", velocities, blocks, velocities)
    for joint in robot.joints.values():
        mass[joint.rate_index, joint.rate_index] += joint.armature
    pull = np.einsum("ilac,la,c->i", velocities, blocks[:, 0], robot.description.gravity)
    return mass, -pull


def accelerations_of(robot, data):
    """Second derivatives of the rows of the links (links, 4, 3), from MuJoCo's."""
    model, rows = data.model, []
    mujoco.mj_rnePostConstraint(model, data)
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for link in robot.description.links:
        body, twist = model.body(link.name).id, np.zeros(6)
        mujoco.mj_objectAcceleration(model, data, kind, body, twist, 0)
        turning, moving = twist[:3].copy(), twist[3:] + robot.description.gravity
        mujoco.mj_objectVelocity(model, data, kind, body, twist, 0)
        spin, axes = twist[:3].copy(), data.xmat[body].reshape(3, 3).T
        bent = np.cross(turning, axes) + np.cross(spin, np.cross(spin, axes))
        rows.append(np.vstack([moving, bent]))
    return np.array(rows)


def off(one, other, least=1e-300):
    """Largest difference relative to the largest number."""
    scale = max(np.max(np.abs(other), initial=0.0), least)
    return float(np.max(np.abs(one - other), initial=0.0) / scale)


def agreement(robot, *, states=10, seed=0):
    """How far a robot, read without soft constraints, is from MuJoCo."""
    scene, rng, model = nc.Scene(), np.random.default_rng(seed), comparable(robot)
    handle = scene.add(robot)
    system, start = scene.compile()
    agreed, ours, theirs, inputs = Agreement(0.0, 0.0, 0.0), [], [], []
    for _ in range(states):
        data = random_data(model, rng)
        inputs.append(inputs_of(robot, system, data, rng))
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        mass, gravity = dynamics(robot, system, handle, start, data.qpos)
        agreed.mass = max(agreed.mass, off(mass, full))
        agreed.condition = max(agreed.condition, float(np.linalg.cond(full)))
        ours.append(handle.state(system, start, data.qpos, data.qvel))
        theirs.append(accelerations_of(robot, data))
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        agreed.gravity = max(agreed.gravity, off(gravity, data.qfrc_bias, np.max(full)))
    batch = jax.tree.map(lambda *x: np.stack(x), *ours)
    rows = np.asarray(system.instant(batch, np.array(inputs)).accelerations)
    rows = rows.reshape(states, -1, 4, 3)
    places = [system.body_index(handle.bodies[link.name]) for link in robot.description.links]
    agreed.acceleration = max(off(a[places], b) for a, b in zip(rows, theirs))
    return agreed
