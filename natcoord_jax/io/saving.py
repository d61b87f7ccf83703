"""A system as MJCF, so that MuJoCo can check it: bodies, joints, and effects on their coordinates."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.state import STATE, State
from natcoord_jax.io.notes import Note, Notes, in_words
from natcoord_jax.io.saving_effects import numbers, save_effects, save_loops
from natcoord_jax.io.saving_joints import Hung, hung_bodies, quaternion
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.system import System


class Saved(NamedTuple):
    """A system as MJCF.

    Attributes:
        text: MJCF, with the state as its keyframe.
        notes: what is left out or otherwise, by name, with the reason.
    """

    text: str
    notes: tuple[Note, ...]


@checked("nc.io.save_mjcf", system=SYSTEM, state=STATE, file=NAME | of("a path", Path), name=NAME)
def save_mjcf(system: System, state: State, file: str | Path | None = None, *, name: str = "system") -> Saved:
    """Write a system as MJCF.

    Rigid bodies, hinges, slides, ball, universal, cylindrical, planar and fixed joints, free bodies, gravity,
    springs, dampers, dry friction, stops (as limits), rotors, inputs on coordinates, relations between two
    coordinates, and loops closed by spherical or fixed joints are written; the rest is listed.

    Args:
        system: compiled system.
        state: it says where free bodies start, and becomes the keyframe "state".
        file: where to write it; None: nowhere.
        name: of the model.

    Returns:
        The text, and notes on what is left out or otherwise.

    Raises:
        ValueError: for a system with nodes that are no rigid bodies, or with a body without mass on which
            several hang, or that a wrench or a closed loop takes hold of.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), com=(1, 0, 0), name="arm"))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
        >>> saved = nc.io.save_mjcf(*scene.compile())
        >>> nc.io.load(saved.text).bodies
        ('arm',)
    """
    if system.structure.points or system.structure.directors:
        raise ValueError("save_mjcf: system has point masses or directors; MJCF has rigid bodies only")
    notes = Notes()
    root = Element("mujoco", {"model": name})
    SubElement(root, "compiler", {"angle": "radian", "inertiafromgeom": "false", "autolimits": "true"})
    world = SubElement(root, "worldbody")
    bodies = hung_bodies(system, state)
    joints = _write_bodies(system, bodies, world, notes)
    save_effects(system, root, joints, notes)
    save_loops(system, root, notes)
    key = _keyframe(state, bodies)
    SubElement(SubElement(root, "keyframe"), "key", {"name": "state", **key})
    listed = notes.listed()
    text = _written(root, listed)
    if file is not None:
        Path(file).write_text(text, encoding="utf-8")
    return Saved(text, listed)


def _written(root: Element, notes: tuple[Note, ...]) -> str:
    """The text, which begins with the notes."""
    lines = [line for mapped in (False, True) for line in in_words(notes, mapped)]
    if lines:
        root.insert(0, ElementTree.Comment(" " + "; ".join(lines).replace("--", "- -") + " "))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _write_bodies(
    system: System, bodies: list[Hung], world: Element, notes: Notes
) -> dict[tuple[str, int], Element]:
    """Bodies with their joints; the elements of these by our coordinate."""
    elements: dict[int, Element] = {-1: world}
    joints: dict[tuple[str, int], Element] = {}
    for body in bodies:
        attributes = {"name": body.name, "pos": numbers(body.point), "quat": numbers(quaternion(body.axes))}
        element = elements[body.number] = SubElement(elements[body.parent], "body", attributes)
        for joint in body.joints:
            made = SubElement(element, "joint", {"name": joint.name, "type": joint.kind})
            if joint.kind != "free":
                made.set("pos", numbers(joint.point))
            if joint.kind in ("hinge", "slide"):
                made.set("axis", numbers(joint.axis))
            if joint.coordinate is not None:
                joints[joint.coordinate] = made
        if body.unknown is not None:
            notes.left_out(body.unknown, f"a joint of this kind is not written, {body.name} is welded there")
        _write_inertia(element, np.asarray(system.mass)[body.number])
    return joints


def _write_inertia(element: Element, block: np.ndarray) -> None:
    """Mass, centre of mass and inertia about it from a mass block (15)."""
    mass = block[0, 0]
    centre = block[0, 1:] / mass
    second = block[1:, 1:] - mass * np.outer(centre, centre)
    tensor = np.trace(second) * np.eye(3) - second
    full = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    given = {"pos": numbers(centre), "mass": numbers(mass), "fullinertia": numbers(full)}
    element.insert(0, Element("inertial", given))


def _depth_first(bodies: list[Hung], parent: int) -> list[Hung]:
    """Bodies as MuJoCo counts them: each before those that hang on it, and these before the next."""
    found = []
    for body in bodies:
        if body.parent == parent:
            found += [body, *_depth_first(bodies, body.number)]
    return found


def _keyframe(state: State, bodies: list[Hung]) -> dict[str, str]:
    """The state in MuJoCo's layout."""
    ordered = _depth_first(bodies, -1)
    positions = [x for body in ordered for joint in body.joints for x in joint.position]
    rates = [x for body in ordered for joint in body.joints for x in joint.rate]
    return {"qpos": numbers(positions), "qvel": numbers(rates), "time": numbers(state.t)}
