"""What to draw of a system: shapes of the bodies or boxes with their inertia, joints, beams."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.assembly.system import Group, System
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.shapes import CORNERS, FACES
from natcoord_jax.core.names import Names

THINNEST = 0.02
"""Least edge of a box, relative to its longest: plates and rods stay visible."""


def inertia_boxes(system: System) -> Float[np.ndarray, "bodies 8 4"]:
    """Marker weights of the corners of the uniform box with each body's mass and inertia.

    A uniform box with half edges a_i has the central second moments M a_i^2 / 3. Of bodies without mass it is
    a point.
    """
    boxes = []
    for block in np.asarray(system.mass):
        if not block.any():
            boxes.append(np.tile([1.0, 0.0, 0.0, 0.0], (8, 1)))
            continue
        centre = block[0, 1:] / block[0, 0]
        central = block[1:, 1:] / block[0, 0] - np.outer(centre, centre)
        values, axes = np.linalg.eigh(central)
        half = np.sqrt(3 * np.maximum(values, 0.0))
        half = np.maximum(half, THINNEST * half.max())
        corners = centre + (CORNERS * half) @ axes.T
        boxes.append(np.concatenate([np.ones((8, 1)), corners], axis=1))
    return np.stack(boxes)


def surfaces(system: System) -> list[tuple[Float[np.ndarray, "n 4"], list[np.ndarray]]]:
    """Marker weights of the points of what is drawn of each body, and the faces between them.

    That is the shape that it was given; of others the box with their inertia.
    """
    found = []
    for box, shape in zip(inertia_boxes(system), system.structure.shapes):
        points, faces = (box[:, 1:], list(FACES)) if shape is None else shape.surface()
        found.append((np.concatenate([np.ones((len(points), 1)), points], axis=1), faces))
    return found


def with_ground(q: Float[np.ndarray, "t rows 3"]) -> Float[np.ndarray, "t bodies_and_ground 4 3"]:
    """Rows by body, those of the ground last."""
    ground = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    rows = q.reshape(len(q), -1, 4, 3)
    return np.concatenate([rows, np.broadcast_to(ground, (len(q), 1, 4, 3))], axis=1)


def joint_places(system: System, rows: Float[np.ndarray, "t bodies 4 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Points (t, joints, 3) [m] and axes (t, joints, 3) [-] of the named joints, as carried by the parent."""
    named = [j for j, name in enumerate(system.structure.joints) if name]
    frames = np.asarray(system.frames)[named, 0]
    parents = np.asarray(system.joint_bodies)[named, 0]
    vectors = np.einsum("jma,tjac->tjmc", frames, rows[:, parents])
    return vectors[:, :, 0], vectors[:, :, 3]


RIM = 12
"""Most corners of the rim of a section."""


def _chains(system: System) -> list[Group]:
    """Effects between frames of bodies that make a chain of these and store energy: elements of beams."""
    groups = (g for g in system.effects if g.effect.couples and g.effect.stores)
    return [g for g in groups if g.weights is not None and g.weights.ndim == 4]


def _beam_of(element: str) -> str:
    """Name of the beam that an element belongs to: elements are called "beam/element 0" and so on."""
    return element.rpartition("/")[0]


def is_node(system: System, body: str) -> bool:
    """Whether a body is a node of a set, or a beam's own, which is drawn as part of that."""
    if isinstance(system.structure.bodies, Names) and body.endswith("]"):
        return True
    names = {_beam_of(name) for group in _chains(system) for name in group.names}
    beam, _, rest = body.rpartition("/")
    return bool(beam) and beam in names and rest.startswith("node ")


def element_faces(
    system: System, rows: Float[np.ndarray, "t bodies 4 3"]
) -> Float[np.ndarray, "t faces 4 3"]:
    """Faces of shells, and those of solids that no two of them share [m].

    Args:
        system: compiled system.
        rows: by body, those of the ground last.
    """
    found = [np.zeros((len(rows), 0, 4, 3))]
    for group in system.effects:
        if group.effect.faces and group.weights is not None:
            weights, bodies = np.asarray(group.weights), np.asarray(group.bodies)
            own = weights if weights.ndim == 3 else weights[:, :, 0]
            places = np.einsum("nka,tnkac->tnkc", own, rows[:, bodies])
            corners = np.array(group.effect.faces)
            # Nodes that are clamped to one body have its number: faces are told apart by their middles.
            middles = np.round(places[0][:, corners].mean(axis=2).reshape(-1, 3), 9)
            _, back, count = np.unique(middles, axis=0, return_inverse=True, return_counts=True)
            outer = count[back.reshape(-1)] == 1
            found.append(places[:, :, corners].reshape(len(rows), -1, 4, 3)[:, outer])
    return np.concatenate(found, axis=1)


def _round_section(system: System, beam: str) -> Float[np.ndarray, "n 2"]:
    """Rim of the full ellipse with the mass and inertia of the beam's nodes."""
    angles = np.linspace(0.0, 2 * np.pi, RIM, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for number, name in enumerate(system.structure.bodies):
        if name.startswith(f"{beam}/node "):
            block = np.asarray(system.mass)[number]
            return circle * 2 * np.sqrt(np.diag(block)[1:3] / block[0, 0])
    return 0.01 * circle


def beam_rims(
    system: System, rows: Float[np.ndarray, "t bodies 4 3"], beams: Sequence[BeamHandle] = ()
) -> Float[np.ndarray, "t faces 4 3"]:
    """Swept sections of all beams as quadrilaterals between the rims of neighbouring nodes [m].

    Args:
        system: compiled system.
        rows: by body, those of the ground last.
        beams: handles, whose sections are known; the other beams are round.
    """
    outlines: dict[str, Any] = {b.name: np.asarray(b.outline) for b in beams if b.outline is not None}
    quads = [np.zeros((len(rows), 0, 4, 3))]
    for group in _chains(system):
        frames = np.einsum("nkma,tnkac->tnkmc", np.asarray(group.weights), rows[:, np.asarray(group.bodies)])
        for number, name in enumerate(group.names):
            beam = _beam_of(name)
            if beam not in outlines:
                outlines[beam] = _round_section(system, beam)
            rim = outlines[beam][:: -(-len(outlines[beam]) // RIM)]
            here = frames[:, number]
            across = np.einsum("ri,tkic->tkrc", rim, here[:, :, 1:3]) + here[:, :, :1]
            following = np.roll(across, -1, axis=2)
            corners = (across[:, :-1], across[:, 1:], following[:, 1:], following[:, :-1])
            quads.append(np.stack(corners, axis=3).reshape(len(rows), -1, 4, 3))
    return np.concatenate(quads, axis=1)
