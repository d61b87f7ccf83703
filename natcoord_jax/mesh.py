"""Meshes: nodes, cells between them, and names of their edges and faces; for `nc.Shell` and `nc.Solid`."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from jaxtyping import Int

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.cells import CELLS, met_once
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.kinds import Choice, Several, of
from natcoord_jax.core.lattice import ELEMENTS, cells_of_box, divisions
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.maths.places import places, twins

NAMED = of("a dictionary of names", dict)

HEXAHEDRON = CELLS[8].faces
"""Corners of the six faces of a hexahedron, in turn as seen from outside."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Nodes and cells.

    Attributes:
        nodes: positions (n, 3) [m].
        cells: numbers of the nodes of each cell (m, 4) in turn round a quadrilateral, of a triangle the last
            one twice; (m, 3) of triangles alone, kept in that form; (m, 8) of a hexahedron four in turn round
            one face, then those above them; (m, 20) or (m, 27) of a hexahedron and (m, 10) of a tetrahedron
            with nodes in the middles of edges, or of faces and the cell, too, as in VTK.
        sets: numbers of nodes by name, as of edges and faces.
        faces: nodes (f, 4), or (f, 8), (f, 9), (f, 6), of the faces of such cells by name: corners in turn as
            seen from outside, middles of edges, the middle of the face.
        parts: numbers of cells by name.

    Raises:
        ValueError: for cells of nodes that there are not, nodes without a cell, or two at the same place.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> square = nc.mesh.Mesh(np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), [(0, 1, 2, 3)])
        >>> square
        <mesh: 4 nodes, 1 quadrilaterals>
    """

    nodes: Any
    cells: Int[np.ndarray, "m k"]
    sets: dict[str, np.ndarray] = field(default_factory=dict)
    faces: dict[str, np.ndarray] = field(default_factory=dict)
    parts: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nodes = np.asarray(self.nodes, float) if is_concrete(self.nodes) else self.nodes
        object.__setattr__(self, "nodes", nodes)
        cells = np.asarray(self.cells)
        if cells.ndim == 2 and cells.shape[1] == 3:
            cells = cells[:, [0, 1, 2, 2]]
        object.__setattr__(self, "cells", cells)
        if nodes.ndim != 2 or nodes.shape[1] != 3:
            raise ValueError(f"mesh: nodes [m] has shape {nodes.shape}; pass (n, 3)")
        if self.cells.ndim != 2 or self.cells.shape[1] not in KINDS or self.cells.dtype.kind not in "iu":
            raise ValueError(
                f"mesh: cells has shape {self.cells.shape} of {self.cells.dtype}; pass whole numbers (m, 4) "
                "of quadrilaterals, (m, 3) of triangles, (m, 8), (m, 20) or (m, 27) of hexahedra, or (m, 10) "
                "of tetrahedra"
            )
        _check(nodes, self.cells)

    def __repr__(self) -> str:
        named = f"; {', '.join(sorted(self.sets))}" if self.sets else ""
        return f"<mesh: {len(self.nodes)} nodes, {len(self.cells)} {KINDS[self.cells.shape[1]]}{named}>"

    @property
    def outside(self) -> Int[np.ndarray, "f k"]:
        """Faces of cells of solids that belong to one cell only, in turn as seen from outside."""
        faces = CELLS[self.cells.shape[1]].faces
        return met_once(np.concatenate([self.cells[:, list(face)] for face in faces]))

    @property
    def edges(self) -> Int[np.ndarray, "s 2"]:
        """Sides of quadrilaterals and triangles that belong to one cell only, in turn round it."""
        every = np.concatenate([self.cells[:, [k, (k + 1) % 4]] for k in range(4)])
        return met_once(every[every[:, 0] != every[:, 1]])

    def part(self, name: str) -> "Mesh":
        """The cells of a part alone, as a mesh with what it has of the sets and faces.

        Raises:
            ValueError: for a name that there is not, naming those that there are.
        """
        if name not in self.parts:
            raise ValueError(f"mesh: there is no part {name!r}; it has {sorted(self.parts) or 'none'}")
        cells = self.cells[self.parts[name]]
        kept = np.unique(cells)
        number = np.full(len(self.nodes), -1)
        number[kept] = np.arange(len(kept))
        sets = {key: number[np.intersect1d(x, kept)] for key, x in self.sets.items()}
        faces = {key: number[x[np.isin(x, kept).all(axis=1)]] for key, x in self.faces.items()}
        mine = {key: x for key, x in sets.items() if len(x)}
        return Mesh(self.nodes[kept], number[cells], mine, {key: x for key, x in faces.items() if len(x)})


KINDS = {4: "quadrilaterals", **{count: cell.name for count, cell in CELLS.items()}}


def _check(nodes: Any, cells: np.ndarray) -> None:
    if cells.size and not 0 <= cells.min() <= cells.max() < len(nodes):
        raise ValueError(
            f"mesh: cells has nodes from {cells.min()} to {cells.max()}; there are 0 to {len(nodes) - 1}"
        )
    order = np.sort(cells, axis=1)
    own = np.sum(order[:, 1:] == order[:, :-1], axis=1)
    if cells.shape[1] == 4:
        own = own - (cells[:, 2] == cells[:, 3])
    if own.any():
        cell = int(np.argmax(own > 0))
        raise ValueError(
            f"mesh: cell {cell} has a node twice: {cells[cell].tolist()}; list each once, of a triangle the "
            "last one twice"
        )
    unused = np.setdiff1d(np.arange(len(nodes)), cells)
    if unused.size:
        raise ValueError(
            f"mesh: nodes {unused[:8].tolist()} are in no cell and would have no mass; leave them out "
            "(`nc.mesh.cleaned` does)"
        )
    if is_concrete(nodes):
        both = twins(np.asarray(nodes))
        if both is not None:
            raise ValueError(
                f"mesh: nodes {both[0]} and {both[1]} are at the same place, so that the cells on them are "
                "not joined; merge them (`nc.mesh.cleaned` does)"
            )


@checked("mesh.cleaned", nodes=Numbers((None, 3)), cells=Numbers((None, None)), sets=NAMED, faces=NAMED)
def cleaned(
    nodes: Any, cells: Any, sets: dict[str, Any] | None = None, faces: dict[str, Any] | None = None
) -> Mesh:
    """A mesh of nodes some of which are at the same place, or in no cell: merged, and left out.

    Args:
        nodes: positions (n, 3) [m].
        cells: numbers of the nodes of each cell, see `Mesh`.
        sets: numbers of nodes by name.
        faces: corners of faces by name.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nodes = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0)]
        >>> nc.mesh.cleaned(nodes, [(0, 1, 2, 3), (4, 5, 6, 7)])
        <mesh: 6 nodes, 2 quadrilaterals>
    """
    place = np.asarray(nodes, float)
    first = places(place)
    found = first[np.asarray(cells)]
    kept = np.unique(found)
    number = np.full(len(place), -1)
    number[kept] = np.arange(len(kept))

    def renumbered(x: Any) -> np.ndarray:
        return number[first[np.asarray(x, int)]]

    named = {name: np.unique(renumbered(x)) for name, x in (sets or {}).items()}
    named = {name: x[x >= 0] for name, x in named.items()}
    return Mesh(place[kept], number[found], named, {k: renumbered(x) for k, x in (faces or {}).items()})


@checked("mesh.rectangle", size=Numbers((2,), sign="positive"), counts=Several(Whole(1), 2, 2))
def rectangle(size: Any, counts: tuple[int, int]) -> Mesh:
    """A rectangle in the plane z = 0, from the origin along x and y.

    Args:
        size: along x and y [m].
        counts: of quadrilaterals along x and y.

    Returns:
        A mesh with the sets "left", "right" (x), "bottom" and "top" (y).

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.mesh.rectangle((1.0, 0.5), (16, 8))
        <mesh: 153 nodes, 128 quadrilaterals; bottom, left, right, top>
    """
    x, y = divisions(size, counts)
    nodes = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1)
    number = np.arange(nodes[..., 0].size).reshape(nodes.shape[:2])
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    sets = {"left": number[0], "right": number[-1], "bottom": number[:, 0], "top": number[:, -1]}
    return Mesh(nodes.reshape(-1, 3), np.stack(corners, axis=-1).reshape(-1, 4), sets)


@checked("mesh.box")
def box(
    size: Annotated[Any, Numbers((3,), sign="positive")],
    counts: Annotated[tuple[int, int, int], Several(Whole(1), 3, 3)],
    element: Annotated[str, Choice(tuple(ELEMENTS))] = "hexahedron8",
) -> Mesh:
    """A box from the origin along x, y and z.

    Args:
        size: along x, y and z [m].
        counts: of hexahedra along x, y and z, or of boxes of six tetrahedra.
        element: "hexahedron8", "hexahedron20", "hexahedron27" or "tetrahedron10", by the number of nodes.

    Returns:
        A mesh with sets and faces "x0", "x1", "y0", "y1", "z0" and "z1".

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.mesh.box((1.0, 0.5, 0.5), (4, 2, 2))
        <mesh: 45 nodes, 16 hexahedra; x0, x1, y0, y1, z0, z1>
    """
    points, cells = cells_of_box(counts, element)
    lines = divisions(size, [n - 1 for n in points])
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    kept, cells = np.unique(cells, return_inverse=True)
    nodes, cells = nodes[kept], cells.reshape(-1, CELLS[ELEMENTS[element]].nodes.shape[0])
    sets = {
        f"{axis}{end}": np.flatnonzero(nodes[:, k] == lines[k][-end])
        for k, axis in enumerate("xyz")
        for end in (0, 1)
    }
    outside = Mesh(nodes, cells, sets).outside
    faces = {name: outside[np.isin(outside, x).all(axis=1)] for name, x in sets.items()}
    return Mesh(nodes, cells, sets, faces)


@checked("mesh.cylinder")
def cylinder(
    radius: Annotated[Any, Number("positive")],
    length: Annotated[Any, Number("positive")],
    counts: Annotated[tuple[int, int], Several(Whole(1), 2, 2)],
) -> Mesh:
    """The surface of a cylinder about the z axis, from z = 0 on, open at both ends; directors point outwards.

    Args:
        radius: [m].
        length: [m].
        counts: of quadrilaterals round the axis and along it.

    Returns:
        A mesh with the sets "bottom" and "top".

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.mesh.cylinder(0.1, 0.5, (16, 8))
        <mesh: 144 nodes, 128 quadrilaterals; bottom, top>
    """
    around, along = counts
    if around < 3:
        raise ValueError(f"mesh.cylinder: {around} cells round the axis enclose nothing; pass three or more")
    angle, z = 2 * np.pi * np.arange(around) / around, np.linspace(0.0, float(length), along + 1)
    radius = float(radius)
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    nodes = np.concatenate(
        [np.repeat(circle[:, None], along + 1, axis=1), np.broadcast_to(z[:, None], (around, along + 1, 1))],
        axis=-1,
    )
    number = np.arange(around * (along + 1)).reshape(around, along + 1)
    ahead = np.roll(number, -1, axis=0)
    corners = number[:, :-1], ahead[:, :-1], ahead[:, 1:], number[:, 1:]
    cells = np.stack(corners, axis=-1).reshape(-1, 4)
    return Mesh(nodes.reshape(-1, 3), cells, {"bottom": number[:, 0], "top": number[:, -1]})


@checked("mesh.sphere", radius=Number("positive"), count=Whole(1))
def sphere(radius: Any, count: int) -> Mesh:
    """The surface of a sphere about the origin, as a cube blown up; directors point outwards.

    Args:
        radius: [m].
        count: of quadrilaterals along each edge of the cube: six times its square in all.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.mesh.sphere(0.033, 4)
        <mesh: 98 nodes, 96 quadrilaterals>
    """
    cube = box((2.0, 2.0, 2.0), (count, count, count))
    # Equal angles as seen from the middle, not equal lengths, keep the cells alike.
    nodes = np.tan(np.pi / 4 * (cube.nodes - 1.0))
    nodes = float(radius) * nodes / np.maximum(np.linalg.norm(nodes, axis=1, keepdims=True), 1e-300)
    kept = np.unique(cube.outside)
    number = np.full(len(nodes), -1)
    number[kept] = np.arange(len(kept))
    return Mesh(nodes[kept], number[cube.outside])


__all__ = ["Mesh", "box", "cleaned", "cylinder", "rectangle", "sphere"]
