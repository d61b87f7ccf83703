"""Effects of a system as MJCF: attributes of joints, actuators, equalities and options."""

from collections.abc import Callable
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import jax
import numpy as np

from natcoord_jax.effects.actuators import AffineActuator, JointForce, JointTorque, WrenchInput
from natcoord_jax.effects.constraints import PointOnPoint
from natcoord_jax.effects.joints import Coupling, Fixed, Revolute, Spherical
from natcoord_jax.effects.loads import Gravity
from natcoord_jax.effects.springs import Armature, JointDamper, JointFriction, JointSpring, JointStops
from natcoord_jax.io.notes import Notes
from natcoord_jax.model.groups import Group
from natcoord_jax.system import System

Joints = dict[tuple[str, int], Element]


def numbers(values: Any) -> str:
    """Numbers with all their digits."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def part(root: Element, name: str) -> Element:
    """A section of the file, made when first asked for."""
    found = root.find(name)
    return SubElement(root, name) if found is None else found


def _instances(group: Group) -> list[tuple[str, Any, int]]:
    """Name, effect and number of each instance of a group."""
    if group.effect.shared or group.source == "mass":
        return [(group.names[0], group.effect, 0)]
    each = [jax.tree.map(lambda x, k=k: np.asarray(x)[k], group.effect) for k in range(group.count)]
    return [(name, effect, k) for k, (name, effect) in enumerate(zip(group.names, each))]


def save_effects(system: System, root: Element, joints: Joints, notes: Notes) -> None:
    """All effects that MJCF has."""
    for group in system.effects:
        writer = WRITERS.get(type(group.effect))
        for name, effect, number in _instances(group):
            if isinstance(effect, Gravity):
                part(root, "option").set("gravity", numbers(effect.vector))
                continue
            on = [joints.get(system.structure.coordinates[c]) for c in np.asarray(group.coordinates)[number]]
            if isinstance(effect, JointTorque):
                on = [_hinge(system, joints, np.asarray(group.weights)[number], group.bodies[number])]
            if isinstance(effect, PointOnPoint | WrenchInput):
                write = _connect if isinstance(effect, PointOnPoint) else _wrench
                write(system, root, name, np.asarray(group.weights)[number], group.bodies[number], effect)
            elif writer is None or None in on or (not on and group.source == "coordinates"):
                notes.left_out(name, f"a {effect.kind} is not written")
            else:
                reason = writer(root, name, effect, on)
                if reason is not None:
                    notes.left_out(name, reason)
    if root.find("option") is None:
        SubElement(root, "option", {"gravity": "0 0 0"})
    if any(isinstance(group.effect, JointStops) for group in system.effects):
        notes.changed("stops", "they are limits, which MuJoCo makes soft by rules of its own")


def _hinge(system: System, joints: Joints, weights: np.ndarray, bodies: Any) -> Element | None:
    """The hinge about the axis, as carried by parent and child, that a motor turns the child about."""
    frames, ends = np.asarray(system.frames), np.asarray(system.joint_bodies)
    for name, index in sorted(joints):
        number = system.joint_index(name)
        same = np.array_equal(ends[number], bodies) and np.allclose(frames[number, :, 3], weights)
        if same and joints[name, index].get("type") == "hinge":
            return joints[name, index]
    return None


def _adding(attribute: str, field: str) -> Callable[[Element, str, Any, list[Any]], None]:
    """Writer that adds a field to what other effects have given a joint."""

    def write(root: Element, name: str, effect: Any, on: list[Any]) -> None:
        on[0].set(attribute, numbers(float(on[0].get(attribute, "0")) + float(getattr(effect, field))))

    return write


def _spring(root: Element, name: str, effect: Any, on: list[Any]) -> str | None:
    if on[0].get("stiffness"):
        return "the joint has another spring"
    on[0].set("stiffness", numbers(effect.stiffness))
    on[0].set("springref", numbers(effect.rest))
    return None


def _stops(root: Element, name: str, effect: Any, on: list[Any]) -> None:
    far = 1e6  # MJCF has no limit on one side only
    on[0].set("range", numbers(np.clip([effect.lower, effect.upper], -far, far)))


def _motor(root: Element, name: str, effect: Any, on: list[Any]) -> None:
    given = {"name": name, "joint": on[0].get("name", ""), "gear": numbers(effect.gear)}
    SubElement(part(root, "actuator"), "motor", given)


def _general(root: Element, name: str, effect: Any, on: list[Any]) -> str | None:
    """An affine actuator, on one coordinate or on a fixed tendon of several."""
    gear = np.ravel(effect.gear)
    law = {
        "gaintype": "affine", "gainprm": numbers(effect.gain),
        "biastype": "affine", "biasprm": numbers(effect.bias),
    }  # fmt: skip
    for attribute, pair in (
        ("ctrlrange", (effect.lower, effect.upper)), ("forcerange", (effect.least, effect.most))
    ):  # fmt: skip
        if np.all(np.isfinite(pair)):
            law[attribute] = numbers(pair)
        elif np.any(np.isfinite(pair)):
            return "it is bounded on one side only, which MJCF does not say"
    if len(on) == 1:
        target = {"joint": on[0].get("name", ""), "gear": numbers(gear)}
    else:
        tendon = SubElement(part(root, "tendon"), "fixed", {"name": f"{name} length"})
        for joint, factor in zip(on, gear):
            SubElement(tendon, "joint", {"joint": joint.get("name", ""), "coef": numbers(factor)})
        target = {"tendon": f"{name} length"}
    SubElement(part(root, "actuator"), "general", {"name": name, **target, **law})
    return None


def _relation(root: Element, name: str, effect: Any, on: list[Any]) -> str | None:
    """sum_k a_k c_k = b as c_0 = b / a_0 - a_1 / a_0 c_1."""
    factors = np.ravel(effect.factors)
    if len(on) > 2 or factors[0] == 0:
        return "a relation between more than two coordinates is not written"
    polynomial = [float(effect.offset) / factors[0], *(-factors[1:] / factors[0])]
    polynomial = numbers([*polynomial, 0.0, 0.0, 0.0, 0.0][:5])
    ends = {f"joint{k + 1}": joint.get("name", "") for k, joint in enumerate(on)}
    SubElement(part(root, "equality"), "joint", {"name": name, **ends, "polycoef": polynomial})
    return None


WRITERS: dict[type, Callable[[Element, str, Any, list[Any]], str | None]] = {
    JointSpring: _spring,
    JointDamper: _adding("damping", "damping"),
    JointFriction: _adding("frictionloss", "friction"),
    Armature: _adding("armature", "inertia"),
    JointStops: _stops,
    JointForce: _motor,
    JointTorque: _motor,
    AffineActuator: _general,
    Coupling: _relation,
}


def save_loops(system: System, root: Element, notes: Notes) -> None:
    """Joints that close loops: as connections of points, or welds."""
    for group in system.joints:
        if group.in_tree:
            continue
        for name, joint in zip(group.names, np.asarray(group.joints)[:, 0]):
            frames, bodies = np.asarray(system.frames)[joint], np.asarray(system.joint_bodies)[joint]
            if isinstance(group.effect, Spherical | Revolute):
                _connect(system, root, name, frames[:, 0], bodies)
                if isinstance(group.effect, Revolute):
                    _connect(system, root, f"{name} axis", frames[:, 0] + frames[:, 3], bodies)
            elif isinstance(group.effect, Fixed):
                _connect(system, root, name, frames, bodies)
            else:
                notes.left_out(name, f"a {group.effect.kind} that closes a loop is not written")
    if root.find("equality") is not None:
        notes.changed("equality constraints", "MuJoCo's are soft")


def _site(system: System, root: Element, name: str, weights: np.ndarray, body: int, axes: Any = None) -> None:
    """A point of a body by name, with axes (rows) in it."""
    names = system.structure.bodies
    bodies = {element.get("name"): element for element in root.iter("body")}
    owner = part(root, "worldbody") if body == len(names) else bodies.get(names[body])
    if owner is None:
        raise ValueError(f"save_mjcf: {name!r} is at {names[body]!r}, which has no mass [kg]; give it some")
    site = SubElement(owner, "site")
    site.set("name", name)
    site.set("pos", numbers(weights[1:]))
    if axes is not None:
        site.set("xyaxes", numbers([*axes[0], *axes[1]]))


def _wrench(system: System, root: Element, name: str, weights: np.ndarray, bodies: Any, effect: Any) -> None:
    """Force and torque at a frame of a body."""
    _site(system, root, f"{name} frame", weights[0], int(np.asarray(bodies)[0]), weights[1:, 1:])
    gear = {"name": name, "site": f"{name} frame", "gear": numbers([*effect.force, *effect.torque])}
    bounds = np.array([effect.lower, effect.upper])
    if np.all(np.isfinite(bounds)):
        gear["ctrlrange"] = numbers(bounds)
    SubElement(part(root, "actuator"), "motor", gear)


def _connect(
    system: System, root: Element, name: str, weights: np.ndarray, bodies: Any, effect: Any = None
) -> None:
    """Two points, or two frames, that stay together."""
    ends = {f"site{k + 1}": f"{name} end {k + 1}" for k in range(2)}
    frames = weights.ndim == 3
    for end, place, body in zip(ends.values(), weights, np.asarray(bodies)):
        point, axes = (place[0], place[1:, 1:]) if frames else (place, None)
        _site(system, root, end, point, int(body), axes)
    SubElement(part(root, "equality"), "weld" if frames else "connect", {"name": name, **ends})
