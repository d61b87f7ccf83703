"""What to draw of a system: boxes with the inertia of the bodies, joints as points with axes."""

import numpy as np
from jaxtyping import Float

from natcoord_jax.assembly.system import System

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
THINNEST = 0.02
"""Least edge of a box, relative to its longest: plates and rods stay visible."""


def inertia_boxes(system: System) -> Float[np.ndarray, "bodies 8 4"]:
    """Marker weights of the corners of the uniform box with each body's mass and inertia.

    A uniform box with half edges a_i has the central second moments M a_i^2 / 3.
    """
    boxes = []
    for block in np.asarray(system.mass):
        centre = block[0, 1:] / block[0, 0]
        central = block[1:, 1:] / block[0, 0] - np.outer(centre, centre)
        values, axes = np.linalg.eigh(central)
        half = np.sqrt(3 * np.maximum(values, 0.0))
        half = np.maximum(half, THINNEST * half.max())
        corners = centre + (CORNERS * half) @ axes.T
        boxes.append(np.concatenate([np.ones((8, 1)), corners], axis=1))
    return np.stack(boxes)


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
