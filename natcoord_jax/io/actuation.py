"""Actuators from MuJoCo's compiled model."""

from dataclasses import replace
from typing import Any

import numpy as np

from natcoord_jax.io.description import UNBOUNDED, ActuatorData, JointData
from natcoord_jax.io.links import KINDS, Poses, joint_name, pair
from natcoord_jax.io.notes import Notes, mujoco


def actuator_name(model: Any, number: int) -> str:
    """Name of an actuator, also where the file gives none."""
    return model.actuator(number).name or f"actuator {number + 1}"


def input_index(model: Any, number: int) -> int:
    """Where the control of an actuator is in `ctrl` of MuJoCo."""
    addresses = getattr(model, "actuator_ctrladr", None)  # since MuJoCo 4 an actuator may have several
    return number if addresses is None else int(addresses[number])


def read_actuators(
    model: Any, poses: Poses, joints: dict[str, JointData], notes: Notes
) -> tuple[tuple[ActuatorData, ...], list[int]]:
    """What is mapped, and the numbers of these actuators in the file."""
    found, numbers = [], []
    for number in range(len(model.actuator_trntype)):
        name, kinds = actuator_name(model, number), _kinds(model, number)
        reason = _switched_off(model, number) or _refused(model, number, kinds)
        made = reason or _transmitted(model, poses, number, kinds["transmission"], _law(model, number))
        if isinstance(made, str):
            notes.left_out(name, made)
            continue
        if kinds["dynamics"] != "NONE":
            notes.changed(name, "its activation follows at once: it is the input, instead of the control")
        found.append(made)
        numbers.append(number)
    return _with_efforts(found, joints, notes), numbers


def fixed_tendon(model: Any, tendon: int) -> dict[str, float] | None:
    """Joints and their coefficients of a tendon that is a sum of coordinates; None for one through space."""
    package, factors = mujoco(), {}
    first = int(model.tendon_adr[tendon])
    for place in range(first, first + int(model.tendon_num[tendon])):
        if model.wrap_type[place] != package.mjtWrap.mjWRAP_JOINT:
            return None
        name = joint_name(model, int(model.wrap_objid[place]))
        factors[name] = factors.get(name, 0.0) + float(model.wrap_prm[place])
    return factors


def _kinds(model: Any, number: int) -> dict[str, str]:
    """MuJoCo's names of what an actuator is made of."""
    package = mujoco()
    values = {
        "transmission": (package.mjtTrn, model.actuator_trntype),
        "dynamics": (package.mjtDyn, model.actuator_dyntype),
        "gain": (package.mjtGain, model.actuator_gaintype),
        "bias": (package.mjtBias, model.actuator_biastype),
    }
    return {what: kind(int(x[number])).name.rpartition("_")[2] for what, (kind, x) in values.items()}


def _switched_off(model: Any, number: int) -> str | None:
    """Whether the file switches an actuator off, alone or with all others."""
    if model.opt.disableflags & mujoco().mjtDisableBit.mjDSBL_ACTUATION:
        return "the file switches actuation off"
    group = int(model.actuator_group[number])
    if 0 <= group < 31 and int(model.opt.disableactuator) & (1 << group):
        return f"the file switches its group off, {group}"
    return None


def _refused(model: Any, number: int, kinds: dict[str, str]) -> str | None:
    """Why an actuator is not mapped, as far as its law is concerned."""
    if model.actuator_plugin[number] >= 0:
        return "it is a plugin of MuJoCo's"
    if kinds["dynamics"] not in ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT"):
        return f"activation dynamics {kinds['dynamics']} are not mapped"
    if kinds["gain"] not in ("FIXED", "AFFINE") or kinds["bias"] not in ("NONE", "AFFINE"):
        return f"gain {kinds['gain']} and bias {kinds['bias']}: only affine ones are mapped"
    for several in ("ctrlnum", "outnum"):
        if getattr(model, f"actuator_{several}", np.ones(number + 1))[number] > 1:
            return "it has several controls or outputs, of which none is mapped"
    extras = ("actuator_delay", "actuator_damping", "actuator_dampingpoly", "actuator_armature")
    for extra in extras:
        if np.any(getattr(model, extra, np.zeros(number + 1))[number]):
            return f"it has {extra.rpartition('_')[2]} of its own, which is not mapped"
    return None


def _law(model: Any, number: int) -> dict[str, Any]:
    """Gain, bias and ranges."""
    package = mujoco()
    gain, bias = np.array(model.actuator_gainprm[number][:3]), np.array(model.actuator_biasprm[number][:3])
    if model.actuator_gaintype[number] == package.mjtGain.mjGAIN_FIXED:
        gain[1:] = 0.0
    if model.actuator_biastype[number] == package.mjtBias.mjBIAS_NONE:
        bias[:] = 0.0
    control = input_index(model, number)
    clamped = not model.opt.disableflags & package.mjtDisableBit.mjDSBL_CLAMPCTRL
    limited, limits = clamped and model.actuator_ctrllimited[control], model.actuator_ctrlrange[control]
    if model.actuator_dyntype[number] != package.mjtDyn.mjDYN_NONE:
        limited, limits = model.actuator_actlimited[number], model.actuator_actrange[number]
    force = pair(model.actuator_forcerange[number]) if model.actuator_forcelimited[number] else UNBOUNDED
    return {"gain": gain, "bias": bias, "range": pair(limits) if limited else UNBOUNDED, "force": force}


def _transmitted(
    model: Any, poses: Poses, number: int, transmission: str, law: dict[str, Any]
) -> ActuatorData | str:
    """The actuator with what it acts on, or why that is not mapped."""
    name, target = actuator_name(model, number), int(model.actuator_trnid[number][0])
    addresses = getattr(model, "actuator_outadr", None)
    out = number if addresses is None else int(addresses[number])
    gear = np.array(model.actuator_gear[out])
    if transmission in ("JOINT", "JOINTINPARENT"):
        joint, kind = joint_name(model, target), KINDS[model.jnt_type[target]]
        if kind in ("hinge", "slide"):
            return ActuatorData(name, "coordinates", (joint,), gear[:1], **law)
        if kind == "free" or np.any(law["bias"]) or np.any(law["gain"][1:]):
            return f"it acts on the {kind} joint {joint} by more than a torque"
        return ActuatorData(
            name, "ball", (joint,), gear[:3], in_parent=transmission == "JOINTINPARENT", **law
        )
    if transmission == "TENDON":
        factors = fixed_tendon(model, target)
        if factors is None:
            return f"the tendon {model.tendon(target).name} runs through space, which is not mapped"
        along = gear[0] * np.array([*factors.values()])
        return ActuatorData(name, "coordinates", tuple(factors), along, **law)
    if transmission == "SITE" and model.actuator_trnid[number][1] < 0:
        if np.any(law["bias"]) or np.any(law["gain"][1:]):
            return "at a site only a force in proportion to the control is mapped"
        return ActuatorData(name, "wrench", (), gear, frame=poses.site(target), **law)
    return f"transmission {transmission} is not mapped"


def _with_efforts(
    actuators: list[ActuatorData], joints: dict[str, JointData], notes: Notes
) -> tuple[ActuatorData, ...]:
    """Cut off at the largest force of a joint where one actuator alone acts on it."""
    users: dict[str, int] = {}
    for actuator in actuators:
        for name in actuator.joints:
            users[name] = users.get(name, 0) + 1
    found = []
    for actuator in actuators:
        limits = [joints[name].effort for name in actuator.joints if joints[name].effort != UNBOUNDED]
        alone = len(actuator.joints) == 1 and users[actuator.joints[0]] == 1 and actuator.gear[0] != 0
        if limits and not alone:
            names = ", ".join(actuator.joints)
            notes.left_out(f"force range of {names}", "several actuators or joints share it")
        elif limits:
            low, high = np.sort(np.array(limits[0]) / actuator.gear[0])
            force = max(float(low), actuator.force[0]), min(float(high), actuator.force[1])
            actuator = replace(actuator, force=force)
        found.append(actuator)
    return tuple(found)
