"""Meshes from files, by gmsh."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.cells import CELLS
from natcoord_jax.core.kinds import of
from natcoord_jax.mesh import Mesh

FILE = of("a path", str, Path)

HEXAHEDRA = "mesh it with hexahedra or, by Mesh.ElementOrder = 2, with tetrahedra of ten nodes"
REMEDIES = {
    ("Tetrahedron", 4): f"tetrahedra of four nodes are too stiff; {HEXAHEDRA}",
    ("Triangle", 6): "shells have straight edges; mesh it by Mesh.ElementOrder = 1",
    ("Quadrilateral", 8): "shells have straight edges; mesh it by Mesh.ElementOrder = 1",
    ("Quadrilateral", 9): "shells have straight edges; mesh it by Mesh.ElementOrder = 1",
}
KNOWN = {("Triangle", 3), ("Quadrilateral", 4), ("Tetrahedron", 10), ("Hexahedron", 8)}
KNOWN |= {("Hexahedron", 20), ("Hexahedron", 27)}


@checked("io.read_mesh", file=FILE)
def read_mesh(file: str | Path) -> Mesh:
    """A mesh from a file of gmsh, or another that gmsh reads (.msh, .inp, .bdf, .unv, .vtk).

    The cells are those of the highest dimension that there are. Physical groups of volumes become parts, of
    surfaces of a volume faces and sets of nodes, of curves and points sets of nodes, under their names;
    groups without a name under their number. Nodes that no cell has, as the centres of arcs, are left out.

    Args:
        file: its path.

    Raises:
        ImportError: without gmsh, with the line to install it.
        ValueError: for a file without cells, or with cells that there are no elements for, with what to do.

    Example:
        >>> import natcoord_jax as nc
        >>> import natcoord_jax.io
        >>> block = nc.io.read_mesh("part.msh")  # doctest: +SKIP
    """
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise ImportError(
            f'nc.io.read_mesh reads files by gmsh: python -m pip install "natcoord-jax[mesh]" ({error})'
        ) from error
    if not Path(file).is_file():
        raise ValueError(f"io.read_mesh: there is no file {str(file)!r}")
    ours = not gmsh.isInitialized()
    if ours:
        gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(file))
        return _mesh(gmsh.model, str(file))
    finally:
        gmsh.model.remove()
        if ours:
            gmsh.finalize()


def _mesh(model: Any, file: str) -> Mesh:
    """The current model of gmsh."""
    dimension, kind = _kind_of_cells(model, file)
    elements, corners = model.mesh.getElementsByType(kind)
    count, local = model.mesh.getElementProperties(kind)[3:5]
    cells = np.asarray(corners, int).reshape(-1, count)
    if dimension == 3:
        # gmsh numbers middles of edges and faces in its own order.
        places = np.reshape(local, (count, 3))
        away = np.sum(np.abs(CELLS[count].nodes[:, None] - places), axis=2)
        cells = cells[:, np.argmin(away, axis=1)]
    tags, nodes, _ = model.mesh.getNodes()
    kept = np.unique(cells)
    number = np.full(int(max(tags)) + 1, -1)
    number[kept] = np.arange(len(kept))
    place = np.empty((len(number), 3))
    place[np.asarray(tags, int)] = np.reshape(nodes, (-1, 3))
    cells, elements = number[cells], np.asarray(elements, int)
    mesh = Mesh(place[kept], cells)
    sets, faces, parts = {}, {}, {}
    for at, group in model.getPhysicalGroups():
        name = model.getPhysicalName(at, group) or str(group)
        if at == dimension:
            own = [
                tag
                for entity in model.getEntitiesForPhysicalGroup(at, group)
                for tags_of_kind in model.mesh.getElements(at, entity)[1]
                for tag in tags_of_kind
            ]
            parts[name] = np.flatnonzero(np.isin(elements, own))
            continue
        own = number[np.asarray(model.mesh.getNodesForPhysicalGroup(at, group)[0], int)]
        sets[name] = np.unique(own[own >= 0])
        if at == 2:
            faces[name] = _faces(model, group, number, mesh.outside)
    return Mesh(mesh.nodes, cells, sets, {name: x for name, x in faces.items() if len(x)}, parts)


def _kind_of_cells(model: Any, file: str) -> tuple[int, int]:
    """Dimension of the cells, and gmsh's number of their kind."""
    for dimension in (3, 2):
        kinds = list(model.mesh.getElementTypes(dimension))
        if not kinds:
            continue
        names = {int(k): model.mesh.getElementProperties(k) for k in kinds}
        found = {k: (p[0].split(" ")[0], int(p[3])) for k, p in names.items()}
        wrong = [cell for cell in found.values() if cell not in KNOWN]
        if wrong:
            said = REMEDIES.get(wrong[0], f"there are no elements for them; {HEXAHEDRA}")
            raise ValueError(
                f"io.read_mesh: {file!r} has cells '{wrong[0][0]}' of {wrong[0][1]} nodes: {said}"
            )
        if len(found) > 1:
            both = " and ".join(f"'{name}' of {count} nodes" for name, count in found.values())
            raise ValueError(
                f"io.read_mesh: {file!r} has cells {both}; a mesh has cells of one kind: mesh it with one, "
                "or save them to files of their own and join them by nc.Tie"
            )
        return dimension, kinds[0]
    raise ValueError(
        f"io.read_mesh: {file!r} has no cells; mesh it (gmsh -3 -order 2) and save it with them: by default "
        "only cells in physical groups are saved, once there is any group"
    )


def _faces(model: Any, group: int, number: np.ndarray, outside: Int[np.ndarray, "f k"]) -> np.ndarray:
    """Faces of a group of surfaces, in turn as seen from outside, whatever their direction in the file is."""
    width, own = outside.shape[1], []
    for entity in model.getEntitiesForPhysicalGroup(2, group):
        for kind, corners in zip(*model.mesh.getElements(2, entity)[::2]):
            if model.mesh.getElementProperties(kind)[3] == width:
                own.append(number[np.asarray(corners, int)].reshape(-1, width))
    known = {
        tuple(row) for row in np.sort(np.concatenate([np.zeros((0, width), int), *own]), axis=1).tolist()
    }
    return outside[[tuple(row) in known for row in np.sort(outside, axis=1).tolist()]]
