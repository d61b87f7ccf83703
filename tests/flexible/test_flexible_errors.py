"""What beams, shells, solids, their sections, loads and nodes refuse, in words: tables, nothing is run."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flexible_scenes import LAWS, LINE, NUMBERS

import natcoord_jax as nc

METAL = nc.Elastic(E=2e5, nu=0.3, density=1200.0)
PLY = nc.Orthotropic(E1=140e9, E2=10e9, nu12=0.3, G12=5e9, density=1600.0)
SECTION = nc.Section.of_numbers(**NUMBERS)
STIFF, MASSES = np.diag([1e4, 1e4, 1e5, 10.0, 10.0, 8.0]), np.diag([1.0, 1e-4, 1e-4])
SKEWED = STIFF + 5.0 * np.diag([0.0, 0.0, 0.0, 1.0, 0.0], k=1)
SQUARE = nc.mesh.rectangle((1.0, 1.0), (2, 2))
UP, OUT = nc.Direction(nc.ground, (0, 0, 1)), nc.Direction(nc.ground, (1, 0, 0))
GROUND = nc.Point(nc.ground)


def check_all(table):
    """Every call of a table of (call, message) is refused with its message: those that are not are listed."""
    wrong = []
    for number, (call, message) in enumerate(table):
        try:
            call()
        except (ValueError, TypeError, IndexError) as error:
            if not re.search(message, str(error)):
                wrong.append(f"{number}: {message!r} is not in {str(error)!r}")
        else:
            wrong.append(f"{number}: {message!r}: nothing was refused")
    assert not wrong, "\n".join(wrong)


def compiled(*parts):
    scene = nc.Scene()
    for part in parts:
        scene.add(part)
    return scene.compile()


def added(make):
    """What is made of a scene is added to it, and all is compiled."""
    scene = nc.Scene()
    scene.add(make(scene))
    return scene.compile()


def beam(curve=LINE, **more):
    return nc.Scene().add(nc.Beam(SECTION, curve, **{"elements": 2} | more))


# --- beams --------------------------------------------------------------------------------------------------


def test_beams_that_cannot_be():
    steel = {"E": 2e11, "density": 7800.0}
    directors = {"law": lambda strains: strains[0], "interpolation": nc.DirectorInterpolation(order=1)}
    check_all(
        [
            (lambda: nc.Section.of_numbers(**NUMBERS | {"EA": -1.0}), "EA"),
            (lambda: nc.TubularSection(radius=0.02, thickness=0.03, **steel), "thickness"),
            (lambda: nc.CircularSection(radius=0.02, nu=-2.0, **steel), r"nu \[-\] is -2.0"),
            (lambda: nc.Section(SKEWED, MASSES), r"stiffness \[.*\] is not symmetric"),
            (lambda: nc.Section(-STIFF, MASSES), r"stiffness \[.*\] has negative eigenvalues"),
            (lambda: nc.Section(STIFF, -MASSES), r"inertia \[.*\] has negative eigenvalues"),
            (lambda: nc.Section(STIFF, MASSES + 0.1 * np.eye(3, k=1)), r"inertia \[.*\] is not symmetric"),
            (lambda: beam([(0, 0, 0)]), r"curve \[m\] has shape"),
            (lambda: beam([(0, 0, 0), (0, 0, 0)]), "coincide"),
            (lambda: beam(elements=0), "elements is 0"),
            (lambda: beam(lambda s: jnp.stack([s, 0 * s, 0 * s])), "length"),
            (lambda: nc.DirectorInterpolation(order=4), "order is 4"),
            (lambda: beam(**directors), "law= needs interpolation"),
            (lambda: beam(stations=(0.3,)).at(0.4), "stations="),
            (
                lambda: added(
                    lambda scene: nc.Beam(SECTION, LINE, elements=2, start=scene.add(nc.PointMass(mass=1.0)))
                ),
                "which has no orientation",
            ),
        ]
    )
    station = beam(stations=(0.3,))
    assert station.at(0.3) in station.nodes


def line_load(**load):
    scene = nc.Scene()
    scene.add(nc.LineLoad(scene.add(nc.Beam(SECTION, LINE, elements=2)), **load))
    return scene.compile()


def test_loads_on_beams_that_cannot_be():
    clamp = nc.Attachment(nc.ground, (0, 0, 0), np.eye(3))
    check_all(
        [
            (lambda: line_load(following=True), "neither force"),
            (lambda: line_load(force=(1.0, 2.0)), r"force.*N/m"),
            (lambda: nc.Scene().add(nc.LineLoad(nc.ground, force=(0, 0, 1))), "what scene.add"),
            (lambda: nc.PointForce((clamp,), force=(0, 0, 1)), "pass 1 nc.Point"),
            (lambda: nc.PointForce((UP,), force=(0, 0, 1)), "pass 1 nc.Point"),
            (
                lambda: nc.PointForce((GROUND,), force=(0, 0, 1), following=True),
                "1 nc.Point and 3 nc.Direction",
            ),
        ]
    )


# --- shells and solids --------------------------------------------------------------------------------------


def square(**more):
    return nc.Shell(SQUARE, **{"thickness": 0.1, "material": METAL, "name": "plate"} | more)


def box(cells, flip=False, material=LAWS["neo-Hooke"], **more):
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1), element=cells)
    if flip:
        mesh = nc.mesh.Mesh(mesh.nodes * np.array([1.0, 1.0, -1.0]), mesh.cells)
    return compiled(nc.Solid(mesh, material=material, name="block", **more))


FOLDED = nc.mesh.Mesh(
    np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (1, 1, 1)]),
    [(0, 1, 2, 3), (1, 4, 5, 2)],
)


def test_materials_that_cannot_be():
    fibres = {"fibre_stiffness": 1.0, "direction": (1, 0, 0)}
    between, table = "above -1 and below 0.5", []
    for kind, more in ((nc.Elastic, {}), (nc.NeoHooke, {}), (nc.TransverselyIsotropic, fibres)):
        for nu in (0.5, 0.7, -1.0):
            said = rf"nu \[-\] is .*; pass a finite number {between}"
            table.append((lambda kind=kind, more=more, nu=nu: kind(E=1.0, nu=nu, **more), said))
    without = fibres | {"direction": (0, 0, 0)}
    check_all(
        [
            *table,
            (lambda: nc.NeoHooke(E=1.0, nu=0.5), "as 0.4999"),
            (lambda: nc.Orthotropic(E1=1.0, E2=4.0, nu12=0.6, G12=1.0), "whose square is not below E1 / E2"),
            (
                lambda: nc.Laminate(PLY, angles=[0.0, 1.0], fractions=[0.4, 0.5]),
                "fractions .* do not add up to one",
            ),
            (lambda: nc.Ogden(moduli=(1.0,), exponents=(1.0, 2.0), bulk_modulus=1.0), "as many of both"),
            (
                lambda: nc.TransverselyIsotropic(E=1.0, nu=0.3, **without),
                r"direction \[-\] is zero",
            ),
        ]
    )


def test_shells_and_solids_that_cannot_be():
    check_all(
        [
            (lambda: compiled(square(thickness=0.0)), r"thickness \[m\].*positive"),
            (lambda: compiled(square(thickness=np.ones(3))), r"thickness \[m\] has shape \(3,\)"),
            (
                lambda: compiled(square(material=nc.Elastic(E=1.0))),
                r"density \[kg/m\^3\] of its material is zero",
            ),
            (lambda: compiled(square(direction=(0, 0, 1))), "has no first axis: direction"),
            (
                lambda: compiled(nc.Shell(FOLDED, thickness=0.1, material=METAL)),
                "at node 1 the surface is folded",
            ),
            (lambda: compiled(nc.Solid(FOLDED, material=METAL)), "cells of 4 nodes; pass one with 8"),
            (
                lambda: box("hexahedron27", element="Hexahedron20"),
                "Hexahedron20 is no element for <mesh",
            ),
            (lambda: box("hexahedron8", element="Brick"), "keep Brick to nc.Elastic"),
            (
                lambda: box("hexahedron27", element="Hexahedron27P1", material=METAL),
                "Elastic does not split off",
            ),
            (
                lambda: box("hexahedron20", flip=True),
                "'block': element 0, .* is degenerate or turned inside out",
            ),
            (lambda: nc.mesh.rectangle((1.0, -1.0), (2, 2)), r"size \[m\].*positive"),
            (lambda: nc.mesh.Mesh(np.eye(4, 3), [[0, 1, 2, 3, 0]]), r"\(m, 10\) of tetrahedra"),
            (lambda: nc.mesh.Mesh(np.eye(3), [(0, 1, 2, 3)]), "nodes from 0 to 3; there are 0 to 2"),
            (
                lambda: nc.mesh.box((1, 1, 1), (1, 1, 1)).part("rubber"),
                "there is no part 'rubber'; it has none",
            ),
        ]
    )


def test_numbers_that_cannot_be_set():
    system, _ = compiled(square())
    solid, _ = box("hexahedron8", material=METAL)
    ratio = "shell 'plate': material.nu is 0.6; pass a finite number above -1 and below 0.5"
    check_all(
        [
            (
                lambda: system.set("plate", thickness=-0.1),
                "shell 'plate': thickness is -0.1; pass a positive",
            ),
            (lambda: system.set("plate", thickness=jnp.ones(3)), r"thickness \[m\] has shape \(3,\)"),
            (lambda: system.set("plate", nu=0.6), ratio),
            (lambda: system.set("plate", E=-1.0), "material.E is -1.0; pass a positive"),
            (
                lambda: solid.set("block", nu=0.5),
                "'block': material.nu is 0.5; pass a finite number above -1",
            ),
        ]
    )


def test_names_that_are_none():
    scene = nc.Scene()
    solid = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), material=METAL, name="body"))
    shell = scene.add(square(position=(3, 0, 0)))
    check_all(
        [
            (lambda: solid.set("left"), r"'body' has no nodes 'left'; its mesh has \['x0', 'x1'"),
            (lambda: solid.face("left"), "'body' has no faces 'left'; its mesh has"),
            (lambda: shell.face("x1"), "its mesh has none by name"),
            (lambda: shell.edge("end"), "has no nodes 'end'"),
        ]
    )


def test_edge_loads_that_cannot_be():
    scene = nc.Scene()
    shell = scene.add(square())
    inner = nc.mesh.Mesh(SQUARE.nodes, SQUARE.cells, {"middle": np.array([4])})
    plate = scene.add(nc.Shell(inner, thickness=0.1, material=METAL))
    skin = scene.add(square(bending=False, name="skin"))
    edge = shell.edge("right")
    about = "has 2 N m/m about the directors, which shells do not carry"
    check_all(
        [
            (lambda: scene.add(nc.EdgeLoad(edge)), r"has neither force \[N/m\] nor moment"),
            (lambda: scene.add(nc.EdgeLoad(edge, moment=(0, 0, 2.0), following=True)), about),
            (lambda: plate.edge("middle"), "the nodes 'middle' are no edge"),
            (
                lambda: skin.edge("right"),
                "no edges with directors; take those of a shell that bends",
            ),
        ]
    )


def test_junctions_that_do_not_meet():
    scene, cube = nc.Scene(), nc.mesh.box((1, 1, 1), (1, 1, 1))
    blocks = [scene.add(nc.Solid(cube, material=METAL, position=(x, 0, 0))) for x in (0, 1.25, 4)]
    one, other = (scene.add(square(position=(x, 0, 0), name=f"plate {x}")) for x in (0.0, 1.1))
    apart = r"'fold 1'.* are not at the same places, as at \[1.0, 0.0, 0.0\]"
    check_all(
        [
            (
                lambda: scene.add(nc.Tie(blocks[1].face("x0"), blocks[0].face("x1"))),
                "surfaces are 0.25 m apart at node",
            ),
            (
                lambda: scene.add(nc.Tie(blocks[2].face("x0"), blocks[0].face("x1"))),
                "do not meet at node",
            ),
            (lambda: scene.add(nc.Fold(one.set("right"), other.set("left"))), apart),
        ]
    )


def test_traced_numbers_go_in_by_set():
    """A scene with elements is compiled outside of traced functions, and says so."""

    def built(thickness):
        scene = nc.Scene()
        part = scene.add(square(thickness=thickness))
        scene.add(nc.Clamp(nc.ground, part.set("left")))
        return scene.compile()[1].q

    with pytest.raises(ValueError, match="outside of jit and grad, and pass what varies by system.set"):
        jax.jit(built)(0.1)


# --- nodes and elements -------------------------------------------------------------------------------------

PLACES = [(0.0, 0, 0), (1, 0, 0)]


def test_nodes_and_elements_that_cannot_be():
    mesh = nc.Scene().add(nc.Nodes.points(np.eye(9, 3), mass=1.0, name="net"))
    spring = nc.QuadraticSpring

    def threads(connectivity, **more):
        return spring.on(mesh, connectivity, length=1.0, **more)

    each, turning = {"stiffness": [1.0]}, {"turns": (2,), "rows": 4}
    refused_kinds = [{"turns": (2, 0)}, {"turns": (3,)}, {"rows": 0}]
    check_all(
        [
            (lambda: threads([[0, 9]]), "has nodes from 0 to 9; .* has 0 to 8"),
            (lambda: threads([[0.5, 1.0]]), "must be whole numbers"),
            (lambda: threads([0, 1]), "must be whole numbers"),
            (lambda: threads([[0, 1], [1, 2]], each=each), r"each\['stiffness'\] needs a leading axis of 2"),
            (lambda: threads([[0, 1, 2]], stiffness=1.0), "2 nc.Point, in a tuple"),
            (lambda: nc.Nodes.points(PLACES, mass=(1.0, 2.0, 3.0)), r"mass \[kg\] has shape \(3,\)"),
            (lambda: nc.Nodes.points(PLACES, mass=(1.0, -1.0)), r"mass \[kg\].*not negative"),
            (
                lambda: nc.Nodes.directors(PLACES, [(0, 0, 1), (0, 0, 0)], mass=1.0),
                r"directors \[-\] is zero",
            ),
            (lambda: nc.Point(mesh[[0, 1]], (0.5, 0.6)), "add up to 1.1"),
            (lambda: nc.Point(mesh[[0, 1]], (0.5, 0.2, 0.3)), "pass 2 numbers for <2 nodes of 'net'>"),
            (lambda: nc.Point(mesh[[0, 1]], None), "pass 2 numbers"),
            (lambda: mesh[9], "there are 9"),
            (lambda: mesh[-10], "there are 9"),
            *[
                (lambda more=more: nc.NodeKind("wheel", **turning | more), "'wheel': a node turns")
                for more in refused_kinds
            ],
        ]
    )


def test_clamps_that_cannot_be():
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.points(np.eye(3), mass=1.0, name="mesh"))
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="hub"))
    mass = scene.add(nc.PointMass(mass=1.0, name="mass"))
    scene.add(nc.Clamp(hub, mesh[:1]))
    again = r"node 'mesh\[0\]' is clamped already"
    check_all(
        [
            (lambda: scene.add(nc.Clamp(hub, mesh[:2])), again),
            (lambda: scene.add(nc.Clamp(mass, mesh[1:])), "'mass' has no orientation; pass a rigid body"),
            (lambda: scene.add(nc.Clamp(mesh[2], mesh[1:2])), "has no orientation"),
        ]
    )
    scene.add(nc.Spherical(mesh[0], hub))
    check_all([(scene.compile, r"node 'mesh\[0\]' is clamped to 'hub'; join that")])


def test_what_a_node_does_not_carry():
    """Directions of points, others than the director, joints that need axes, torques between nodes."""
    above = nc.Point(nc.ground, (0, 0, 1))
    point, director = r"'points\[0\]' is a point and carries itself only", r"'shell\[0\]' is a director"

    def attached(make):
        scene = nc.Scene()
        points = scene.add(nc.Nodes.points(PLACES, mass=1.0, name="points"))
        shell = scene.add(nc.Nodes.directors(PLACES, (0, 0, 1), mass=1.0, inertia=0.1, name="shell"))
        scene.add(make(points, shell))
        return scene.compile()

    only = {kind: f"joint '{kind}': .* has a director only" for kind in ("hinge", "weld")}
    between = "between nodes is none"
    makes = [
        (lambda p, d: nc.PairTorque((UP, nc.Direction(p[0], (1, 0, 0))), torque=1.0), point),
        (lambda p, d: nc.Spring((above, nc.Point(p[0], (0, 0, 0.5))), stiffness=1.0), point),
        (lambda p, d: nc.PairTorque((UP, nc.Direction(d[0], (1, 0, 0))), torque=1.0), director),
        (lambda p, d: nc.Revolute(nc.ground, d[0], name="hinge"), only["hinge"]),
        (lambda p, d: nc.Fixed(nc.ground, d[0], name="weld"), only["weld"]),
        (lambda p, d: nc.PairTorque((OUT, nc.Direction(d[[0, 1]], (0.5, 0.5))), torque=1.0), between),
    ]
    check_all([(lambda make=make: attached(make), message) for make, message in makes])
    scene = nc.Scene()
    shell = scene.add(nc.Nodes.directors(PLACES, (0, 0, 1), mass=1.0, inertia=0.1))
    scene.add(nc.Spring((above, nc.Point(shell[0], (0, 0, 0.5))), stiffness=1.0))
    scene.add(nc.Spherical(nc.ground, shell[1]))
    assert scene.compile()[0].structure.dofs == 7


AXIAL = {"Fixed": {}, **dict.fromkeys(("Revolute", "Prismatic", "Cylindrical"), {"axis": (0, 0, 1)})}


@pytest.mark.slow
def test_joints_that_hold_axes_on_a_single_node():
    """It has none to be held, and no drilling stiffness; a ball joint is one of points."""
    parts = {
        "shell": square(name="body"),
        "membrane": square(name="body", bending=False),
        "solid": nc.Solid(nc.mesh.box((1.0, 1.0, 1.0), (1, 1, 1)), material=METAL, name="body"),
    }

    def stuck(part, joint, more):
        scene = nc.Scene()
        body = scene.add(parts[part])
        stick = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(1, 1, 1), name="stick"))
        scene.add(getattr(nc, joint)(stick, body.nodes[4], **more))
        return scene.compile()

    only = r"'body nodes\[4\]' has a (director|point) only, no axes .*; clamp it to a rigid body \(nc.Clamp\)"
    check_all(
        [
            (lambda part=part, joint=joint, more=more: stuck(part, joint, more), only)
            for part in parts
            for joint, more in AXIAL.items()
        ]
    )
    for part in parts:
        stuck(part, "Spherical", {})


def test_a_clamped_node_is_refused_with_what_to_ask_instead():
    scene, rubber = nc.Scene(), nc.Elastic(E=1e6, nu=0.3, density=1000.0)
    block = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (1, 1, 1)), material=rubber, name="block"))
    scene.add(nc.Clamp(nc.ground, block.set("z0")))
    system, state = scene.compile()
    node = block.nearest((0, 0, 0))
    said = r"'block nodes\[0\]' is clamped: it moves with what it is clamped"
    check_all([(lambda part=part: system.sense(state, part), said) for part in (node, nc.Point(node))])
    with pytest.raises(ValueError, match="cannot sense 'brick'") as refused:
        system.sense(state, "brick")
    assert "clamped" not in str(refused.value)
