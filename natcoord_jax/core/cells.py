"""Cells of meshes: nodes by natural coordinates, faces, and the flat pieces that a curved face is drawn by.

Nodes are in the order of VTK: corners, then middles of edges, then of faces, then of the cell.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

CORNERS = np.array([(x, y, z) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
SIDES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
"""Corners of the faces of a hexahedron, in turn as seen from outside."""
MIDDLES = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1), (0, 0, 0)], float)
TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
TETRAHEDRON_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
TETRAHEDRON_SIDES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))


@dataclass(frozen=True, eq=False)
class Cell:
    """A kind of cells.

    Attributes:
        name: of many.
        nodes: natural coordinates (k, 3).
        faces: numbers of the nodes of each face: corners in turn as seen from outside, middles of its edges,
            its middle.
        powers: of the natural coordinates, of the polynomials that the shape functions are made of.
    """

    name: str
    nodes: Float[np.ndarray, "k 3"]
    faces: tuple[tuple[int, ...], ...]
    powers: tuple[tuple[int, int, int], ...]

    @property
    def facets(self) -> tuple[tuple[int, ...], ...]:
        """Faces in pieces between neighbouring nodes, four each; of triangles the last is there twice."""
        return tuple(piece for face in self.faces for piece in pieces(face))


def pieces(face: tuple[int, ...]) -> list[tuple[int, ...]]:
    """A face in pieces between neighbouring nodes, four each; of triangles the last is there twice."""
    if len(face) == 4:
        return [face]
    count = 3 if len(face) == 6 else 4
    corners, edges = face[:count], face[count : 2 * count]
    before = edges[-1:] + edges[:-1]
    if len(face) == 9:
        return [(a, e, face[8], b) for a, e, b in zip(corners, edges, before)]
    inner = edges if count == 4 else (*edges, edges[-1])
    return [(a, e, b, b) for a, e, b in zip(corners, edges, before)] + [inner]


def _curved(
    nodes: Float[np.ndarray, "k 3"], sides: tuple[tuple[int, ...], ...]
) -> tuple[tuple[int, ...], ...]:
    """Faces with those nodes that are in the middle of their edges, and of themselves."""
    found = []
    for side in sides:
        ends = nodes[list(side)]
        wanted = [*0.5 * (ends + np.roll(ends, -1, axis=0)), *([ends.mean(axis=0)] if len(side) == 4 else [])]
        near = [np.flatnonzero(np.all(nodes == x, axis=1)) for x in wanted]
        found.append((*side, *(int(n[0]) for n in near if len(n))))
    return tuple(found)


def _powers(most: int, degree: int, quadratic: int = 3) -> tuple[tuple[int, int, int], ...]:
    """Of polynomials up to a degree in each coordinate and in all, few of which are squared."""
    every = np.ndindex(most + 1, most + 1, most + 1)
    return tuple(p for p in every if sum(p) <= degree and sum(k > 1 for k in p) <= quadratic)


def _halfway(nodes: np.ndarray, edges: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.concatenate([nodes, [0.5 * (nodes[a] + nodes[b]) for a, b in edges]])


_TWENTY = _halfway(CORNERS, EDGES)
_ALL = np.concatenate([_TWENTY, MIDDLES])
_TEN = _halfway(TETRAHEDRON, TETRAHEDRON_EDGES)

CELLS = {
    8: Cell("hexahedra", CORNERS, SIDES, _powers(1, 3)),
    10: Cell("quadratic tetrahedra", _TEN, _curved(_TEN, TETRAHEDRON_SIDES), _powers(2, 2)),
    20: Cell("hexahedra of twenty nodes", _TWENTY, _curved(_TWENTY, SIDES), _powers(2, 4, 1)),
    27: Cell("hexahedra of 27 nodes", _ALL, _curved(_ALL, SIDES), _powers(2, 6)),
}
"""Kinds of cells of solids by the number of their nodes."""


def shapes(cell: Cell, at: Float[np.ndarray, "g 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Shape functions (g, k) and their derivatives by the natural coordinates (g, k, 3).

    Args:
        cell: kind of cells.
        at: natural coordinates.
    """
    powers = np.array(cell.powers)
    coefficients = np.linalg.inv(np.prod(cell.nodes[:, None] ** powers, axis=2))
    values = np.prod(at[:, None] ** powers, axis=2)
    slopes = []
    for axis in range(3):
        lower = powers - (np.arange(3) == axis) * (powers > 0)
        slopes.append(powers[:, axis] * np.prod(at[:, None] ** lower, axis=2))
    return values @ coefficients, np.einsum("xgp,pk->gkx", np.stack(slopes), coefficients)


@lru_cache
def quadrature(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (g, 3) and weights (g,) for elements of so many nodes: all their modes have stiffness."""
    if nodes == 10:
        far, near = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
        return np.full((4, 3), near) + (far - near) * np.eye(4, 3, -1), np.full(4, 1 / 24)
    x, w = np.polynomial.legendre.leggauss(2 if nodes == 8 else 3)
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, np.einsum("i,j,k->ijk", w, w, w).reshape(-1)


@lru_cache
def mass_quadrature(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (g, 3) and weights (g,) that are exact for products of two shape functions."""
    if nodes != 10:
        return quadrature(nodes)
    # Of a cube, one side of which shrinks to an edge and another to a point.
    x, w = np.polynomial.legendre.leggauss(4)
    x, w = (x + 1) / 2, w / 2
    a, b, c = (y.reshape(-1) for y in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).reshape(-1) * (1 - a) ** 2 * (1 - b)
    return np.stack([a, b * (1 - a), c * (1 - a) * (1 - b)], axis=1), weights


def met_once(faces: Int[np.ndarray, "f k"]) -> Int[np.ndarray, "f k"]:
    """Faces, or edges, that belong to one cell only, by their nodes."""
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]
