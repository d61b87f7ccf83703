"""What shells and solids refuse, for every kind of element: with its number and what to do."""

import numpy as np
import pytest

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
    pytest.param(mesh, {"material": material, "bending": bending}, id=f"{kind}, {material.kind}, {bending}")
    for kind, mesh in SURFACES.items()
    for material in (SOFT, LAMINATE)
    for bending in (True, False)
]


def compiled(part):
    scene = nc.Scene()
    scene.add(part)
    return scene.compile()


def refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


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


@pytest.mark.parametrize("element", SOLIDS)
def test_solids(element):
    """Turned inside out, flat, with a node twice, with nodes of no cell or at the same place."""
    kind, law = SOLIDS[element]
    mesh = nc.mesh.box((1.0, 1.0, 1.0), (2, 1, 1), element=kind)

    def solid(nodes, cells):
        return compiled(nc.Solid(nc.mesh.Mesh(nodes, cells), material=law, element=element, name="block"))

    said = r"'block': element 1, on the nodes \[.*\], is degenerate or turned inside out: list"
    refused(lambda: solid(mesh.nodes, replaced(mesh.cells, 1, mirrored(mesh, 1))), said)
    flat, own, first = mesh.nodes.copy(), mesh.cells[1], np.unique(mesh.cells[0])
    apart = np.setdiff1d(own, first)
    # Its other nodes are brought into the plane of a face that it shares, and drawn together there.
    shared = flat[np.intersect1d(own, first)]
    middle = shared.mean(axis=0)
    normal = np.linalg.svd(shared - middle)[2][2]
    away = flat[apart] - middle
    height = (away @ normal)[:, None]
    along = away - height * normal
    flat[apart] = middle + 0.4 * along + 0.1 * height * np.cross(normal, (0.3, 0.5, 0.8))
    refused(lambda: solid(flat, mesh.cells), said.replace("element 1", r"element \d"))
    twice = replaced(mesh.cells, 1, [*own[:-1], own[0]])
    refused(lambda: solid(mesh.nodes, twice), "cell 1 has a node twice: .* list each once")
    count = len(mesh.nodes)
    more = np.concatenate([mesh.nodes, [(5.0, 5.0, 5.0)]])
    refused(lambda: solid(more, mesh.cells), rf"nodes \[{count}\] are in no cell .*leave them out")
    node = next(n for n in own if n in first)
    split = replaced(mesh.cells, 1, np.where(own == node, count, own))
    twin = np.concatenate([mesh.nodes, mesh.nodes[node : node + 1]])
    refused(lambda: solid(twin, split), f"nodes {node} and {count} are at the same place, .* merge them")


@pytest.mark.parametrize(("mesh", "given"), LAYERS)
def test_shells_and_membranes(mesh, given):
    """Without area, not convex, with a node twice, of no cell, at the same place; wrong thicknesses."""

    def layer(nodes, cells, thickness=0.1, **more):
        found = nc.mesh.Mesh(nodes, cells)
        return compiled(nc.Shell(found, thickness=thickness, name="plate", **given, **more))

    one = mesh.cells[1]
    line = mesh.nodes.copy()
    line[one[2:]] = (line[one[0]] + line[one[1]]) * 0.5
    line[one[3]] = line[one[0]] * 0.25 + line[one[1]] * 0.75
    without = (
        r"cell 1 .*\[.*\], has no area; list" if given["bending"] else "element 1, .* degenerate .*: list"
    )
    refused(lambda: layer(line, mesh.cells), without)
    refused(
        lambda: layer(mesh.nodes, replaced(mesh.cells, 1, one[[0, 1, 1, 2]])), "cell 1 has a node twice: .*"
    )
    more = np.concatenate([mesh.nodes, [(5.0, 5.0, 5.0)]])
    refused(lambda: layer(more, mesh.cells), r"nodes \[9\] are in no cell .*leave them out")
    split = replaced(mesh.cells, 1, np.where(one == 4, 9, one))
    twin = np.concatenate([mesh.nodes, mesh.nodes[4:5]])
    refused(lambda: layer(twin, split), "nodes 4 and 9 are at the same place, .* merge them")
    refused(lambda: layer(mesh.nodes, mesh.cells, 0.0), r"thickness \[m\] is 0.0; pass a positive number")
    thick = np.full(len(mesh.cells), 0.1)
    thick[1] = -0.1
    refused(lambda: layer(mesh.nodes, mesh.cells, thick), r"thickness \[m\] is .*-0.1.*; pass .*positive")
    system, _ = layer(mesh.nodes, mesh.cells)
    refused(lambda: system.set("plate", thickness=-0.1), "'plate': thickness is -0.1; pass positive")
    scene = nc.Scene()
    turned = replaced(mesh.cells, 1, one[[1, 0, 3, 2]] if len(set(one)) == 4 else one[[1, 0, 2, 2]])
    upright = {"directors": np.tile((0, 0, 1.0), (9, 1))} if given["bending"] else {}
    skin = scene.add(
        nc.Shell(nc.mesh.Mesh(mesh.nodes, turned), thickness=0.1, name="plate", **given, **upright)
    )
    both = r"'plate': cells \d and \d of the mesh are listed in turn one way and the other; list all"
    refused(lambda: scene.add(nc.Pressure(skin, 1.0)), both)


@pytest.mark.parametrize("bending", [True, False])
def test_quadrilaterals_that_are_not_convex(bending):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0.2, 0.2, 0), (0, 1, 0)], float)
    mesh = nc.mesh.Mesh(corners, [(0, 1, 2, 3)])
    shell = nc.Shell(mesh, thickness=0.1, material=SOFT, bending=bending, name="plate")
    refused(
        lambda: compiled(shell), r"'plate': element 0, .*\[0, 1, 2, 3\], is degenerate or not convex: list"
    )


@pytest.mark.parametrize("kind", SURFACES)
def test_directors(kind):
    """At a fold without them; along the surface, to both sides, and not one for each node."""
    mesh = SURFACES[kind]
    up = np.tile((0.0, 0, 1), (9, 1))

    def shell(mesh, **given):
        return compiled(nc.Shell(mesh, thickness=0.1, material=SOFT, name="plate", **given))

    folded = nc.mesh.Mesh(
        mesh.nodes[:, [0, 1, 1]] * np.where(mesh.nodes[:, :1] > 0.5, (0, 1, 0), (1, 1, 0))
        + np.where(mesh.nodes[:, :1] > 0.5, (0.5, 0, 0), (0, 0, 0))
        + (mesh.nodes[:, :1] - 0.5) * np.where(mesh.nodes[:, :1] > 0.5, (0, 0, 1), (0, 0, 0)),
        mesh.cells,
    )
    refused(lambda: shell(folded), r"'plate': at node \d the surface is folded, .* `directors`.*nc.Fold")
    shell(folded, directors=np.tile((-1.0, 0, 1), (9, 1)))
    beside = "'plate': element 0, .* has directors along it, or to both of its sides: pass"
    refused(lambda: shell(mesh, directors=np.tile((1.0, 0, 0), (9, 1))), beside)
    refused(lambda: shell(mesh, directors=up * np.where(np.arange(9) == 4, -1, 1)[:, None]), beside)
    refused(lambda: shell(mesh, directors=up[:3]), r"directors \[-\] has shape \(3, 3\)")
    refused(lambda: shell(mesh, directors=0.0 * up), r"directors \[-\] are zero")
    shell(mesh, directors=-up)


@pytest.mark.parametrize("law", [SOFT, RUBBER, nc.TransverselyIsotropic, PLY])
def test_poissons_ratio(law):
    """Of a material, and one that is changed later."""
    if law is PLY:
        refused(lambda: nc.Orthotropic(E1=1.0, E2=4.0, nu12=0.6, G12=1.0), "below E1 / E2 = 0.25")
        return
    fibres = {"fibre_stiffness": 1.0, "direction": (1, 0, 0)} if law is nc.TransverselyIsotropic else {}
    kind = law if fibres else type(law)
    for nu in (0.5, 0.7, -1.0):
        refused(
            lambda nu=nu: kind(E=1.0, nu=nu, **fibres), r"nu \[-\] is .*; pass a number between -1 and 1/2"
        )
    box = nc.mesh.box((1.0, 1.0, 1.0), (1, 1, 1))
    part = nc.Solid(box, material=kind(E=1.0, nu=0.3, density=1.0, **fibres), name="block")
    system, _ = compiled(part)
    refused(lambda: system.set("block", nu=0.5), "element 0 of .* 'block' has Poisson's ratio .*: pass")


JOINTS = {"Fixed": {}, **dict.fromkeys(("Revolute", "Prismatic", "Cylindrical"), {"axis": (0, 0, 1)})}


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("part", ["shell", "membrane", "solid"])
def test_joints_that_hold_axes_on_a_single_node(part, joint):
    """It has none to be held, and no drilling stiffness; a ball joint is one of points."""

    def stick(joint, given):
        scene = nc.Scene()
        if part == "solid":
            body = scene.add(nc.Solid(nc.mesh.box((1.0, 1.0, 1.0), (1, 1, 1)), material=SOFT, name="body"))
        else:
            layer = {"thickness": 0.1, "material": SOFT, "bending": part == "shell", "name": "body"}
            body = scene.add(nc.Shell(SQUARE, **layer))
        stick = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(1, 1, 1), name="stick"))
        scene.add(getattr(nc, joint)(stick, body.nodes[4], **given))
        return scene.compile()

    only = r"'body nodes\[4\]' has a (director|point) only, no axes .*; clamp it to a rigid body \(nc.Clamp\)"
    refused(lambda: stick(joint, JOINTS[joint]), only)
    stick("Spherical", {})
