"""Handles of shells and solids, and of their surfaces and edges; normals at the nodes of these, and folds."""

from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mesh import Mesh

FOLD = 45.0
"""Angle [degrees] between cells and their mean normal at a node beyond which a surface is folded there."""


@eager_numpy
def normals_at(nodes: Float[Array, "n 3"], cells: Int[np.ndarray, "m 4"]) -> Float[Array, "n 3"]:
    """Mean normals of the cells at the nodes, by their areas."""
    corners = nodes[cells]
    areas = cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # The last node of a triangle, which is listed twice, counts once.
    counted = jnp.concatenate([jnp.ones((len(cells), 3)), cells[:, 3:] != cells[:, 2:3]], axis=1)
    total = jnp.zeros_like(nodes).at[cells].add(counted[:, :, None] * areas[:, None])
    size = jnp.sqrt(jnp.sum(total**2, axis=1, keepdims=True))
    return total / jnp.where(size > 0, size, 1.0)


def check_folds(mesh: Mesh, normals: Array, name: str) -> None:
    """Refuse surfaces without directors at a fold.

    Raises:
        ValueError: with the node.
    """
    if not is_concrete(normals, mesh.nodes):
        return
    corners = np.asarray(mesh.nodes)[mesh.cells]
    own = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    size = np.linalg.norm(own, axis=1)
    if np.any(size == 0):
        cell = int(np.argmin(size))
        raise ValueError(
            f"shell {name!r}: cell {cell} of the mesh, of the nodes {mesh.cells[cell].tolist()}, has no "
            "area; list its nodes in turn round it, or leave it out"
        )
    cosines = np.sum((own / size[:, None])[:, None] * np.asarray(normals)[mesh.cells], axis=2)
    if cosines.min() < np.cos(np.radians(FOLD)):
        node = int(mesh.cells.flat[np.argmin(cosines)])
        raise ValueError(
            f"shell {name!r}: at node {node} the surface is folded, or its cells are listed in turn one "
            "way and the other; list all of them the same way, pass `directors` (n, 3), or make one "
            "shell of each side of the fold and join them by nc.Fold"
        )


def check_turns(mesh: Mesh, name: str) -> None:
    """Refuse surfaces whose two sides are not told apart: what presses on one would not.

    Raises:
        ValueError: with two cells.
    """
    sides = np.stack([mesh.cells, np.roll(mesh.cells, -1, axis=1)], axis=2)
    owner = np.repeat(np.arange(len(sides)), 4)[(sides[:, :, 0] != sides[:, :, 1]).ravel()]
    sides = sides[sides[:, :, 0] != sides[:, :, 1]]
    _, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    if count.max() > 1:
        one, other = owner[number.ravel() == np.argmax(count)][:2]
        raise ValueError(
            f"shell {name!r}: cells {one} and {other} of the mesh are listed in turn one way and the other; "
            "list all of them the same way, so that the surface has two sides"
        )


@dataclass(frozen=True)
class MeshHandle(Handle):
    """A reference to a shell or a solid in a scene: as an effect for sensors and energies, and to its nodes.

    Attributes:
        nodes: of the mesh, a set that is indexed, sliced and selected by position; joints, loads, springs and
            sensors take its nodes as any body.
        mesh: as it was given.
        material: of it.
        thickness: of a shell at its cells (cells,) [m]; None: it is a solid.
        bends: whether its nodes have directors: a shell that resists bending.
    """

    nodes: NodeSet = field(compare=False)
    mesh: Mesh = field(compare=False)
    material: Any = field(compare=False, repr=False, default=None)
    thickness: Any = field(compare=False, repr=False, default=None)
    bends: bool = field(compare=False, repr=False, default=False)

    def set(self, name: str) -> NodeSet:
        """The nodes of a set of the mesh, as "left".

        Raises:
            ValueError: for a name that there is not, naming those that there are.
        """
        if name not in self.mesh.sets:
            raise ValueError(f"{self.name!r} has no nodes {name!r}; its mesh has {sorted(self.mesh.sets)}")
        return self.nodes[self.mesh.sets[name]]

    def face(self, name: str | None = None) -> "Surface":
        """Faces of a solid by their name in the mesh, as "x1"; without one all that are outside, or a shell.

        Raises:
            ValueError: for a name that there is not, naming those that there are, and for a shell whose cells
                are listed in turn one way and the other.
        """
        shell = self.mesh.cells.shape[1] == 4
        if shell:
            check_turns(self.mesh, self.name)
        if name is None:
            return Surface(self, self.mesh.cells if shell else self.mesh.outside)
        if name not in self.mesh.faces:
            known = sorted(self.mesh.faces) or "none by name"
            raise ValueError(f"{self.name!r} has no faces {name!r}; its mesh has {known}")
        return Surface(self, self.mesh.faces[name])

    def edge(self, name: str) -> "Edge":
        """The edge of a shell along a set of its nodes, as "right".

        Raises:
            ValueError: for a name that there is not, a set without an edge, a solid, or a membrane.
        """
        nodes = self.set(name).numbers
        if not self.bends:
            raise ValueError(f"{self.name!r} has no edges with directors; take those of a shell that bends")
        sides = self.mesh.edges
        sides = sides[np.isin(sides, nodes).all(axis=1)]
        if not len(sides):
            raise ValueError(
                f"{self.name!r}: the nodes {name!r} are no edge: none of them are neighbours on the outline"
            )
        return Edge(self, sides)

    def surface(self, side: str) -> "Surface":
        """A shell as it is touched from one side: "outside", where its directors point, or "inside".

        Raises:
            ValueError: for a solid, or another side.
        """
        turns = {"outside": 1, "inside": -1}
        if self.thickness is None or side not in turns:
            raise ValueError(
                f"{self.name!r}: there is no side {side!r}; pass 'outside' or 'inside' of a shell, and take "
                "face(...) of a solid"
            )
        return Surface(self, self.mesh.cells[:, :: turns[side]], one_sided=True)

    def nearest(self, position: Any) -> Handle:
        """The node nearest to a position in the assembled pose [m]."""
        away = np.asarray(self.nodes.positions) - np.asarray(position, float)
        return self.nodes[int(np.argmin(np.sum(away**2, axis=1)))]


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of a solid, or a shell.

    Attributes:
        handle: of the solid or the shell.
        faces: numbers of the nodes of each of them (f, 4), (f, 6), (f, 8) or (f, 9), as of `nc.mesh.Mesh`.
        one_sided: whether a shell is touched from outside only.
    """

    handle: MeshHandle
    faces: Int[np.ndarray, "f k"]
    one_sided: bool = False

    def __repr__(self) -> str:
        return f"<{len(self.faces)} faces of {self.handle.name!r}>"


@dataclass(frozen=True, eq=False)
class Edge:
    """A part of the outline of a shell.

    Attributes:
        handle: of the shell.
        sides: numbers of the nodes of each side of a cell on it (s, 2), in turn round the cell.
    """

    handle: MeshHandle
    sides: Int[np.ndarray, "s 2"]

    def __repr__(self) -> str:
        return f"<{len(self.sides)} sides of {self.handle.name!r}>"
