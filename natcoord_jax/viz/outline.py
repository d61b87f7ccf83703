"""Meshes that pictures are made of: the shapes of bodies, and glyphs of joints, springs and forces.

A mesh is points and the numbers of those around each face. It is the one description of a shape, for figures,
films and the 3D view alike.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from natcoord_jax.bodies.shapes import Box, Cylinder, Ellipsoid, Placed, Sphere, Surface
from natcoord_jax.system import System

THINNEST = 0.03
"""Least edge of a solid, relative to its longest: plates and rods stay visible."""
ALIKE = 0.02
"""How far two principal second moments may differ for a round solid, relative to the largest."""
ROUND = (Cylinder, Sphere, Ellipsoid)
"""Shapes whose spin is not seen without a mark."""
TURNS, AROUND_WIRE, AROUND_TURN = 7, 3, 10
"""Of a coil: turns, corners around its wire, pieces of a turn."""


def equal_inertia(block: Float[np.ndarray, "4 4"]) -> tuple[Surface, bool]:
    """Mesh of the plainest solid with a body's mass and inertia, in body axes, and whether it is round.

    That is a sphere, a cylinder or a box, as two or three of the principal second moments are alike or none.
    Half edges a of a box have the central second moments M a^2 / 3, radii those M r^2 / 4 and M r^2 / 5.

    Args:
        block: mass block (15) of the body.
    """
    centre = centre_of(block)
    values, axes = np.linalg.eigh(block[1:, 1:] / block[0, 0] - np.outer(centre, centre))
    values = np.maximum(values, 0.0)
    small, middle, large = values
    alike = ALIKE * large
    if large - small <= alike:
        shape, size, order = Sphere(1.0), np.full(3, np.sqrt(5 * large)), (0, 1, 2)
    elif middle - small <= alike:
        radius = np.sqrt(2 * (small + middle))
        shape, size, order = Cylinder(1.0, 2.0), np.array([radius, radius, np.sqrt(3 * large)]), (0, 1, 2)
    elif large - middle <= alike:
        radius = np.sqrt(2 * (middle + large))
        shape, size, order = Cylinder(1.0, 2.0), np.array([radius, radius, np.sqrt(3 * small)]), (1, 2, 0)
    else:
        shape, size, order = Box((2.0, 2.0, 2.0)), np.sqrt(3 * values), (0, 1, 2)
    size = np.maximum(size, THINNEST * size.max())
    points, faces = shape.surface()
    return (centre + (points * size) @ axes[:, order].T, faces), isinstance(shape, ROUND)


def centre_of(block: np.ndarray) -> np.ndarray:
    """Centre of mass of a body in its axes [m]; of one without mass, between two joints, its point."""
    return block[0, 1:] / (block[0, 0] or 1.0)


def bodies_of(system: System, numbers: Iterable[int]) -> dict[int, tuple[Surface, bool] | None]:
    """Meshes of some bodies in their axes, and whether they are round; None of a point mass, without extent.

    That is the shape that it was given; of others the plainest solid with their inertia.
    """
    found: dict[int, tuple[Surface, bool] | None] = {}
    points, mass = set(system.structure.points), np.asarray(system.mass)
    for number in numbers:
        block, shape = mass[number], system.structure.shapes[number]
        if shape is not None:
            round_ = isinstance(shape, Placed) and isinstance(shape.shape, ROUND)
            found[number] = shape.surface(), round_
        elif number in points or not np.any(np.abs(block[1:, 1:]) > 0):
            found[number] = None
        else:
            found[number] = equal_inertia(block)
    return found


def marked(surface: Surface) -> tuple[Surface, Float[np.ndarray, " faces"]]:
    """A round body, and the brightness of its faces: quarters about its axis in turn, so that spin is seen.

    Ends of cylinders are cut into quarters, too.
    """
    points, faces = surface
    cut = []
    for face in map(np.asarray, faces):
        if len(face) <= 4:
            cut.append(face)
            continue
        quarter = len(face) // 4
        points = np.concatenate([points, points[face].mean(axis=0)[None]])
        around = np.append(face, face[0])
        cut += [np.append(around[k : k + quarter + 1], len(points) - 1) for k in range(0, len(face), quarter)]
    middle = surface[0].mean(axis=0)
    # The axis of a body of revolution is that which its points spread about alone.
    spread, axes = np.linalg.eigh(np.cov((surface[0] - middle).T))
    alone = 2 if spread[2] - spread[1] > spread[1] - spread[0] else 0
    across = np.delete(axes, alone, axis=1)
    # Quarters begin at the first corner.
    first = (surface[0][0] - middle) @ across
    if np.linalg.norm(first) > 1e-9:
        first /= np.linalg.norm(first)
        across = across @ np.array([[first[0], -first[1]], [first[1], first[0]]])
    places = np.stack([(points[face].mean(axis=0) - middle) @ across for face in cut])
    return (points, cut), np.where(places[:, 0] * places[:, 1] > 0, 1.0, 0.72)


def within(surface: Surface, point: Float[np.ndarray, "3"]) -> bool:
    """Whether a point is in the box around a mesh, or nearly."""
    lower, upper = surface[0].min(axis=0), surface[0].max(axis=0)
    margin = 0.08 * float(np.max(upper - lower))
    return bool(np.all((point > lower - margin) & (point < upper + margin)))


def ball(radius: float) -> Surface:
    """A sphere about the origin."""
    return Sphere(radius).surface()


def bar(radius: float, start: np.ndarray, end: np.ndarray) -> Surface:
    """A round bar between two points."""
    length = float(np.linalg.norm(end - start))
    points, faces = Cylinder(radius, length).surface()
    third = (end - start) / length
    first = np.cross(third, np.eye(3)[np.abs(third).argmin()])
    first /= np.linalg.norm(first)
    return 0.5 * (start + end) + points @ np.stack([first, np.cross(third, first), third]), faces


def tube(path: Float[np.ndarray, "k 3"], radii: Float[np.ndarray, " k"], around: int) -> Surface:
    """A tube along a path near the third axis, closed at its ends."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross(along, np.where(np.abs(along[:, :1]) < 0.9, np.eye(3)[0], np.eye(3)[1]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.linspace(0.0, 2 * np.pi, around, endpoint=False)
    rim = np.cos(angle)[:, None, None] * first + np.sin(angle)[:, None, None] * np.cross(along, first)
    points = (path + radii[:, None] * rim).swapaxes(0, 1).reshape(-1, 3)
    here = np.arange(around)
    piece = np.stack([here, np.roll(here, -1), around + np.roll(here, -1), around + here], axis=1)
    faces = [around * k + face for k in range(len(path) - 1) for face in piece]
    return points, [*faces, here, around * (len(path) - 1) + here]


def coil() -> Surface:
    """A coil spring along the third axis, from 0 to 1, of radius one across."""
    s = np.linspace(0.12, 0.88, TURNS * AROUND_TURN)
    angle = np.linspace(0.0, 2 * np.pi * TURNS, len(s))
    wound = np.stack([np.cos(angle), np.sin(angle), s], axis=1)
    ends = np.array([[0, 0, 0], [0, 0, 0.1]]), np.array([[0, 0, 0.9], [0, 0, 1.0]])
    path = np.concatenate([ends[0], wound, ends[1]])
    points, faces = tube(path, np.zeros(len(path)), AROUND_WIRE)
    # The wire is round across only: along, the coil is stretched by any factor.
    angle = np.linspace(0.0, 2 * np.pi, AROUND_WIRE, endpoint=False)
    rim = 0.16 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return points + np.tile(rim, (len(path), 1)), faces


def arrow() -> Surface:
    """An arrow along the third axis, from 0 to 1, of radius one across."""
    path = np.array([[0, 0, 0], [0, 0, 0.7], [0, 0, 0.701], [0, 0, 1.0]])
    return tube(path, np.array([0.4, 0.4, 1.0, 0.02]), 10)


def turning_arrow() -> Surface:
    """An arrow around the third axis, right-handed, of radius one."""
    angle = np.concatenate([np.linspace(0.0, 1.3 * np.pi, 14), [1.3 * np.pi, 1.55 * np.pi]])
    thick = np.concatenate([np.full(14, 0.09), [0.26, 0.01]])
    # A tube along the third axis, bent: its ends and faces stay what they are.
    straight, faces = tube(np.stack([0 * angle, 0 * angle, np.arange(16.0)], axis=1), thick, 8)
    turn, out = angle[np.round(straight[:, 2]).astype(int)], 1 + straight[:, 0]
    return np.stack([out * np.cos(turn), out * np.sin(turn), straight[:, 1]], axis=1), faces
