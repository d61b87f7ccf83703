"""What shells and solids refuse of their meshes, for every kind of element, with its number, in words."""

import numpy as np
import pytest
from test_flexible_errors import check_all, compiled

import natcoord_jax as nc

SOFT = nc.Elastic(E=1e4, nu=0.3, density=1e3)
RUBBER = nc.NeoHooke(E=1e4, nu=0.3, density=1e3)
PLY = nc.Orthotropic(E1=4e4, E2=1e4, nu12=0.3, G12=5e3, density=1e3)
LAMINATE = nc.Laminate(PLY, angles=[0.0, 1.0])
SOLIDS = {
    "Brick": ("hexahedron8", SOFT),
    "Hexahedron8": ("hexahedron8", RUBBER),
    "Hexahedron20": ("hexahedron20", RUBBER),
    "Hexahedron27": ("hexahedron27", RUBBER),
    "Hexahedron27P1": ("hexahedron27", RUBBER),
    "Tetrahedron10": ("tetrahedron10", RUBBER),
    "Tetrahedron10P0": ("tetrahedron10", RUBBER),
}
SQUARE = nc.mesh.rectangle((1.0, 1.0), (2, 2))
HALVES = np.concatenate([SQUARE.cells[:, [0, 1, 2, 2]], SQUARE.cells[:, [0, 2, 3, 3]]])
SURFACES = {"quadrilaterals": SQUARE, "triangles": nc.mesh.Mesh(SQUARE.nodes, HALVES, SQUARE.sets)}
LAYERS = [
    (mesh, {"material": material, "bending": bending})
    for mesh in SURFACES.values()
    for material in (SOFT, LAMINATE)
    for bending in (True, False)
]


def replaced(cells, number, cell):
    """Cells with another in the place of one."""
    cells = cells.copy()
    cells[number] = cell
    return cells


def mirrored(mesh, number):
    """A cell with its nodes in the order of its mirror image."""
    x = mesh.nodes[mesh.cells[number]]
    if len(x) == 10:
        return mesh.cells[number][[1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    image = x * (1, 1, -1) + 2 * x.mean(axis=0) * (0, 0, 1)
    return mesh.cells[number][[int(np.argmin(np.linalg.norm(x - place, axis=1))) for place in image]]


def flattened(mesh):
    """With the nodes of cell 1 brought into the plane of a face that it shares, and drawn to one side."""
    flat, first = mesh.nodes.copy(), np.unique(mesh.cells[0])
    apart = np.setdiff1d(mesh.cells[1], first)
    shared = flat[np.intersect1d(mesh.cells[1], first)]
    middle = shared.mean(axis=0)
    normal = np.linalg.svd(shared - middle)[2][2]
    away = flat[apart] - middle
    height = (away @ normal)[:, None]
    along = away - height * normal
    flat[apart] = middle + 0.4 * along + 0.1 * height * np.cross(normal, (0.3, 0.5, 0.8))
    return flat


def of_solids(element):
    """Turned inside out, flat, with a node twice, with nodes of no cell or at the same place."""
    kind, law = SOLIDS[element]
    mesh = nc.mesh.box((1.0, 1.0, 1.0), (2, 1, 1), element=kind)

    def solid(nodes, cells):
        return compiled(nc.Solid(nc.mesh.Mesh(nodes, cells), material=law, element=element, name="block"))

    said = r"'block': element 1, on the nodes \[.*\], is degenerate or turned inside out: list"
    cell, count = mesh.cells[1], len(mesh.nodes)
    twice = replaced(mesh.cells, 1, [*cell[:-1], cell[0]])
    more = np.concatenate([mesh.nodes, [(5.0, 5.0, 5.0)]])
    node = next(n for n in cell if n in mesh.cells[0])
    split = replaced(mesh.cells, 1, np.where(cell == node, count, cell))
    twin = np.concatenate([mesh.nodes, mesh.nodes[node : node + 1]])
    return [
        (lambda: solid(mesh.nodes, replaced(mesh.cells, 1, mirrored(mesh, 1))), said),
        (lambda: solid(flattened(mesh), mesh.cells), said.replace("element 1", r"element \d")),
        (lambda: solid(mesh.nodes, twice), "cell 1 has a node twice: .* list each once"),
        (lambda: solid(more, mesh.cells), rf"nodes \[{count}\] are in no cell .*leave them out"),
        (lambda: solid(twin, split), f"nodes {node} and {count} are at the same place, .* merge them"),
    ]


def test_meshes_of_solids():
    check_all([row for element in SOLIDS for row in of_solids(element)])


def of_layers(mesh, more):
    """Without area, with a node twice, of no cell, at the same place; wrong thicknesses; turned cells."""

    def layer(nodes, cells, thickness=0.1, **others):
        sheet = nc.mesh.Mesh(nodes, cells)
        return compiled(nc.Shell(sheet, thickness=thickness, name="plate", **more, **others))

    def under_pressure():
        turned = replaced(mesh.cells, 1, one[[1, 0, 3, 2]] if len(set(one)) == 4 else one[[1, 0, 2, 2]])
        upright = {"directors": np.tile((0, 0, 1.0), (9, 1))} if more["bending"] else {}
        sheet, scene = nc.mesh.Mesh(mesh.nodes, turned), nc.Scene()
        skin = scene.add(nc.Shell(sheet, thickness=0.1, name="plate", **more, **upright))
        scene.add(nc.Pressure(skin, 1.0))

    one, line = mesh.cells[1], mesh.nodes.copy()
    line[one[2:]] = (line[one[0]] + line[one[1]]) * 0.5
    line[one[3]] = line[one[0]] * 0.25 + line[one[1]] * 0.75
    bends = r"cell 1 .*\[.*\], has no area; list"
    without = bends if more["bending"] else "element 1, .* degenerate .*: list"
    split = replaced(mesh.cells, 1, np.where(one == 4, 9, one))
    twin = np.concatenate([mesh.nodes, mesh.nodes[4:5]])
    beyond = np.concatenate([mesh.nodes, [(5.0, 5.0, 5.0)]])
    twice, thick = replaced(mesh.cells, 1, one[[0, 1, 1, 2]]), np.full(len(mesh.cells), 0.1)
    thick[1] = -0.1
    positive = r"thickness \[m\] is .*-0.1.*; pass .*positive"
    turns = r"'plate': cells \d and \d of the mesh are listed in turn one way and the other; list all"
    system, _ = layer(mesh.nodes, mesh.cells)
    return [
        (lambda: layer(line, mesh.cells), without),
        (lambda: layer(mesh.nodes, twice), "cell 1 has a node twice: .*"),
        (lambda: layer(beyond, mesh.cells), r"nodes \[9\] are in no cell .*leave them out"),
        (lambda: layer(twin, split), "nodes 4 and 9 are at the same place, .* merge them"),
        (lambda: layer(mesh.nodes, mesh.cells, 0.0), r"thickness \[m\] is 0.0; pass a positive number"),
        (lambda: layer(mesh.nodes, mesh.cells, thick), positive),
        (lambda: system.set("plate", thickness=-0.1), "'plate': thickness is -0.1; pass a positive"),
        (under_pressure, turns),
    ]


@pytest.mark.slow
def test_meshes_of_shells_and_membranes():
    corners = np.array([(0, 0, 0), (1, 0, 0), (0.2, 0.2, 0), (0, 1, 0)], float)
    dart = nc.mesh.Mesh(corners, [(0, 1, 2, 3)])
    said = r"'plate': element 0, .*\[0, 1, 2, 3\], is degenerate or not convex: list"

    def hollow(bending):
        return compiled(nc.Shell(dart, thickness=0.1, material=SOFT, bending=bending, name="plate"))

    check_all([(lambda bending=bending: hollow(bending), said) for bending in (True, False)])
    check_all([row for mesh, more in LAYERS for row in of_layers(mesh, more)])


@pytest.mark.parametrize("kind", SURFACES)
def test_directors(kind):
    """At a fold without them; along the surface, to both sides, and not one for each node."""
    mesh, up = SURFACES[kind], np.tile((0.0, 0, 1), (9, 1))

    def shell(mesh, **more):
        return compiled(nc.Shell(mesh, thickness=0.1, material=SOFT, name="plate", **more))

    beyond = mesh.nodes[:, :1] > 0.5
    folded = nc.mesh.Mesh(
        mesh.nodes[:, [0, 1, 1]] * np.where(beyond, (0, 1, 0), (1, 1, 0))
        + np.where(beyond, (0.5, 0, 0), (0, 0, 0))
        + (mesh.nodes[:, :1] - 0.5) * np.where(beyond, (0, 0, 1), (0, 0, 0)),
        mesh.cells,
    )
    beside = "'plate': element 0, .* has directors along it, or to both of its sides: pass"
    both = up * np.where(np.arange(9) == 4, -1, 1)[:, None]
    fold = r"'plate': at node \d the surface is folded, .* `directors`.*nc.Fold"
    check_all(
        [
            (lambda: shell(folded), fold),
            (lambda: shell(mesh, directors=np.tile((1.0, 0, 0), (9, 1))), beside),
            (lambda: shell(mesh, directors=both), beside),
            (lambda: shell(mesh, directors=up[:3]), r"directors \[-\] has shape \(3, 3\)"),
            (lambda: shell(mesh, directors=0.0 * up), r"directors \[-\] is zero"),
        ]
    )
    shell(folded, directors=np.tile((-1.0, 0, 1), (9, 1)))
    shell(mesh, directors=-up)
