"""Cells of a box on a lattice of points."""

from itertools import permutations
from typing import Any

import numpy as np
from jaxtyping import Int

from natcoord_jax.core.cells import CELLS, TETRAHEDRON_EDGES

ELEMENTS = {"hexahedron8": 8, "hexahedron20": 20, "hexahedron27": 27, "tetrahedron10": 10}
"""Numbers of the nodes of the cells that a box is made of, by name."""


def _tetrahedra() -> Int[np.ndarray, "6 10 3"]:
    """Six in a cube of side two, along its diagonal, which fit those of its neighbours; their nodes."""
    found = []
    for first, second, third in permutations(range(3)):
        step = 2 * np.eye(3, dtype=int)
        corners = np.cumsum([(0, 0, 0), step[first], step[second], step[third]], axis=0)
        if np.linalg.det(corners[1:]) < 0:
            corners = corners[[0, 2, 1, 3]]
        found.append([*corners, *((corners[a] + corners[b]) // 2 for a, b in TETRAHEDRON_EDGES)])
    return np.array(found)


def cells_of_box(counts: tuple[int, int, int], element: str) -> tuple[tuple[int, ...], np.ndarray]:
    """Points along each axis of a lattice, and the numbers of the points of every cell.

    Args:
        counts: of boxes that are one cell, or six tetrahedra, along each axis.
        element: a key of `ELEMENTS`.
    """
    order = 1 if element == "hexahedron8" else 2
    size = tuple(order * count + 1 for count in counts)
    nodes = CELLS[ELEMENTS[element]].nodes
    own = _tetrahedra() if element == "tetrahedron10" else ((nodes + 1) * order // 2).astype(int)[None]
    corners = order * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    places = corners[:, :, None] + own
    return size, np.ravel_multi_index(np.moveaxis(places, -1, 0), size).reshape(-1, own.shape[1])


def divisions(size: Any, counts: Any) -> list[np.ndarray]:
    """Places along each axis of a lattice with so many cells."""
    return [np.linspace(0.0, float(length), int(count) + 1) for length, count in zip(size, counts)]
