"""The parts of a robot in a scene: bodies, joints, and effects on them."""

from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.bodies.rigid import RigidBody
from natcoord_jax.core.bodies import TRIAD, Body
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.markers import Attachment, Direction, Point
from natcoord_jax.core.recipe import Builder
from natcoord_jax.effects.actuators import AffineActuator, JointForce, SphericalTorque, WrenchInput
from natcoord_jax.effects.constraints import PointOnPoint
from natcoord_jax.effects.joints import Coupling, Fixed, Prismatic, Revolute, Spherical
from natcoord_jax.effects.loads import Gravity, PointForce
from natcoord_jax.effects.springs import (
    Armature,
    JointDamper,
    JointFriction,
    JointPotential,
    JointSpring,
    JointStops,
    SphericalDamper,
    SphericalSpring,
)
from natcoord_jax.io.description import (
    UNBOUNDED,
    ActuatorData,
    Description,
    EqualityData,
    FrameData,
    JointData,
    LinkData,
)


@dataclass
class Parts:
    """Handles of what a robot is made of in a scene.

    Attributes:
        robot: all numbers of its file.
        scene: where it is.
        prefix: of all names.
        place: where the origin of the file is [m], and the axes of the file there [-].
        carriers: of each link the bodies after each of its joints, the last of them the link.
        joints: by name in the file.
        inputs: by name in the file.
        taken: names in use.
    """

    robot: Description
    scene: Builder
    prefix: str
    place: tuple[np.ndarray, np.ndarray]
    carriers: list[list[Handle]] = field(default_factory=list)
    joints: dict[str, Handle] = field(default_factory=dict)
    inputs: dict[str, Handle] = field(default_factory=dict)
    taken: set[str] = field(default_factory=set)

    def named(self, name: str, kind: str) -> str:
        """A name in the scene; files may give a body, a joint and an actuator the same."""
        found = name if name not in self.taken else f"{name} {kind}"
        while found in self.taken:
            found += "'"
        self.taken.add(found)
        return f"{self.prefix}{found}"

    def body(self, link: int) -> Handle:
        """Of a link."""
        return ground if link < 0 else self.carriers[link][-1]

    def in_scene(self, point: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A frame of the file's world in the scene."""
        origin, own = self.place
        return origin + own @ point, own @ axes

    def placed(self, frame: FrameData) -> tuple[Handle, np.ndarray, np.ndarray]:
        """A frame in the scene: its body, point and axes in the pose of the file."""
        point, axes = self.in_scene(frame.position, frame.rotation)
        if frame.link >= 0:
            link = self.robot.links[frame.link]
            origin, own = self.in_scene(link.position, link.rotation)
            point, axes = origin + own @ frame.position, own @ frame.rotation
        return self.body(frame.link), point, axes


def build(robot: Description, scene: Builder, prefix: str, place: tuple[np.ndarray, np.ndarray]) -> Parts:
    """Add everything of a robot to a scene."""
    parts = Parts(robot, scene, prefix, place)
    for link in robot.links:
        parts.carriers.append(_add_link(parts, link))
    for link, bodies in zip(robot.links, parts.carriers):
        before = parts.body(link.parent)
        for joint, body in zip(link.joints, bodies):
            _add_joint(parts, link, joint, before, body)
            before = body
    for equality in robot.equalities:
        _add_equality(parts, equality)
    for actuator in robot.actuators:
        handle = scene.add(_actuator(parts, actuator))
        parts.inputs[actuator.name] = handle
    _add_gravity(parts)
    return parts


def _add_link(parts: Parts, link: LinkData) -> list[Handle]:
    """The bodies of a link: one without mass after each of its joints but the last."""
    point, axes = parts.in_scene(link.position, link.rotation)
    handles = []
    for joint in link.joints[:-1]:
        name = parts.named(f"{link.name} after {joint.name}", "body")
        handles.append(parts.scene.add(_without_mass(point, axes, name)))
    name = parts.named(link.name, "body")
    if link.mass == 0.0:
        body = _without_mass(point, axes, name)
    else:
        # A point mass has the second moment of a point.
        moment: dict[str, Any] = {"second_moment": link.mass * np.outer(link.com, link.com)}
        moment = {"inertia": link.inertia} if np.any(link.inertia) else moment
        body = RigidBody(mass=link.mass, com=link.com, position=point, orientation=axes, name=name, **moment)
    handles.append(parts.scene.add(replace_fields(body, shape=link.surface)))
    return handles


def _without_mass(point: np.ndarray, axes: np.ndarray, name: str) -> Body:
    still = as_array(np.zeros(3))
    return Body(as_array(np.zeros((4, 4))), as_array(point), as_array(axes), still, still, TRIAD, None, name)


def _add_joint(parts: Parts, link: LinkData, joint: JointData, parent: Handle, child: Handle) -> None:
    """A joint with its spring, damper, friction, stops and rotor."""
    if joint.kind == "free":
        return
    origin, own = parts.in_scene(link.position, link.rotation)
    point, axis = origin + own @ joint.point, own @ joint.axis
    name = parts.named(joint.name, "joint")
    if joint.kind == "ball":
        parts.joints[joint.name] = parts.scene.add(Spherical(parent, child, point=point, name=name))
        if joint.damping:
            ends = Direction(parent, axis), Direction(child, axis)
            parts.scene.add(SphericalDamper(ends, damping=joint.damping, name=f"{name} damper"))
        if joint.stiffness:
            held = Attachment(parent, point, own), Attachment(child, point, own)
            parts.scene.add(SphericalSpring(held, stiffness=joint.stiffness, name=f"{name} spring"))
        return
    kind = Revolute if joint.kind == "hinge" else Prismatic
    made = kind(parent, child, point=point, axis=axis, zero=-joint.zero, name=name)
    handle = parts.joints[joint.name] = parts.scene.add(made)
    lower, upper = joint.range
    if joint.stiffness > 0:
        spring = JointSpring(handle, stiffness=joint.stiffness, rest=joint.rest, name=f"{name} spring")
        parts.scene.add(spring)
    elif joint.stiffness < 0:
        push = Pushing(joint.stiffness, joint.rest)
        parts.scene.add(JointPotential(handle, law=push, name=f"{name} spring"))
    if joint.damping:
        parts.scene.add(JointDamper(handle, damping=joint.damping, name=f"{name} damper"))
    if joint.friction:
        parts.scene.add(JointFriction(handle, friction=joint.friction, name=f"{name} friction"))
    if joint.armature:
        parts.scene.add(Armature(handle, inertia=joint.armature, name=f"{name} rotor"))
    if joint.stop:
        stops = {"lower": lower, "upper": upper, "stiffness": joint.stop}
        parts.scene.add(JointStops(handle, **stops, name=f"{name} stops"))


def _add_equality(parts: Parts, equality: EqualityData) -> None:
    name = parts.named(equality.name, "equality")
    if equality.kind == "joint":
        handles = tuple(parts.joints[joint] for joint in equality.joints)
        relation = Coupling(handles, factors=equality.factors, offset=equality.offset, name=name)
        parts.scene.add(relation)
        return
    (first, point, _), (second, other, _) = (parts.placed(frame) for frame in equality.frames)
    if equality.kind == "weld":
        parts.scene.add(Fixed(first, second, point=other, name=name))
    else:
        parts.scene.add(PointOnPoint((Point(first, point), Point(second, other)), name=name))


def _actuator(parts: Parts, actuator: ActuatorData) -> Any:
    """The effect behind an input."""
    name = parts.named(actuator.name, "actuator")
    (lower, upper), (least, most) = actuator.range, actuator.force
    bounds = {"lower": lower, "upper": upper, "name": name}
    if actuator.kind == "wrench" and actuator.frame is not None:
        body, point, axes = parts.placed(actuator.frame)
        markers = Point(body, point), *(Direction(body, axis) for axis in axes.T)
        load = actuator.gain[0] * actuator.gear
        return WrenchInput(markers, force=load[:3], torque=load[3:], **bounds)
    if actuator.kind == "ball":
        return _ball_torque(parts, actuator, bounds)
    joints = tuple(parts.joints[joint] for joint in actuator.joints)
    plain = not (np.any(actuator.bias) or np.any(actuator.gain[1:])) and len(joints) == 1
    if plain and actuator.range == actuator.force == UNBOUNDED:
        return JointForce(joints[0], gear=actuator.gear[0] * actuator.gain[0], name=name)
    law = {"gear": actuator.gear, "gain": actuator.gain, "bias": actuator.bias}
    return AffineActuator(joints, coordinate=(0,) * len(joints), least=least, most=most, **law, **bounds)


def _ball_torque(parts: Parts, actuator: ActuatorData, bounds: dict[str, Any]) -> SphericalTorque:
    """A torque along an axis of the link, its opposite on the parent; or along one of the parent."""
    named = (link for link in parts.robot.links for joint in link.joints if joint.name == actuator.joints[0])
    link = next(named)
    joint = parts.scene.find(parts.joints[actuator.joints[0]])
    axis = parts.in_scene(link.position, link.rotation)[1] @ actuator.gear
    ends = Direction(joint.child, axis), Direction(joint.parent, axis)
    gain, ends = (-1.0, ends[::-1]) if actuator.in_parent else (1.0, ends)
    return SphericalTorque(ends, gear=gain * float(actuator.gain[0]), **bounds)


def _add_gravity(parts: Parts) -> None:
    """Gravity of the file, which is that of the scene, unless the scene has one; lifted masses."""
    robot, scene = parts.robot, parts.scene
    has = any(isinstance(effect, Gravity) for effect in getattr(scene, "effects", {}).values())
    if not has and np.any(robot.gravity):
        scene.add(Gravity(vector=robot.gravity))
    for link, bodies in zip(robot.links, parts.carriers):
        for number, (point, mass) in enumerate(link.floats):
            name = parts.named(f"{link.name} lift {number + 1}", "lift")
            force = -mass * robot.gravity
            scene.add(PointForce((Point(bodies[-1], point, local=True),), force=force, name=name))


class Pushing(eqx.Module):
    """Energy of a spring that pushes away from a coordinate."""

    stiffness: Any
    rest: Any

    def __call__(self, coordinate: Any) -> Any:
        """Energy [J]."""
        return 0.5 * self.stiffness * (coordinate - self.rest) ** 2
