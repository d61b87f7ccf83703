"""Handles of shells and solids, and of their surfaces and edges."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from natcoord_jax.bodies.normals import check_turns
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.mesh import Mesh


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
