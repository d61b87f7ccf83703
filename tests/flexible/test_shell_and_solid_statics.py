"""Statics of shells and solids, one table: case, what is published and what this mesh gives, and tolerance.

Cases S01 to S07 are those of Sze, Liu and Lo, Finite Elem. Anal. Des. 40 (2004) 1551-1569. On coarse meshes
the figures are those that an independent program of the same element has; what these miss of the published
ones is said with each.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import (
    ELEMENTS,
    distorted,
    grid,
    grows,
    hold,
    mirror,
    place_of,
    push,
    tractions,
    triangulated,
)

import natcoord_jax as nc


def cantilever(count, length=10.0, mesh=lambda mesh: mesh, **more):
    """A strip 1 m wide, clamped at its left end."""
    scene = nc.Scene()
    numbers = {"thickness": 0.1, "material": nc.Elastic(E=1.2e6, density=3.1314e-4), **more}
    strip = mesh(nc.mesh.rectangle((length, 1.0), (count, 1)))
    shell = scene.add(nc.Shell(strip, **numbers, name="plate"))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    return scene, shell


def solved(scene, steps):
    """System and equilibria under growing loads."""
    system, state = scene.compile()
    return system, nc.equilibrium(system, state, steps=steps).states


def bent_by_a_force(mesh=lambda mesh: mesh):
    """S01: 3.286 and 6.698; quadrilaterals and triangles miss 0.2 %."""
    scene, shell = cantilever(16, mesh=mesh)
    tip = shell.set("right")
    for node in tip:
        push(scene, node, (0, 0, 2.0))
    system, states = solved(scene, 4)
    x = place_of(system, states, tip[0])[-1]
    np.testing.assert_allclose((10.0 - x[0], x[2]), (3.286, 6.698), rtol=3e-3)
    return 10.0 - x[0], x[2]


def rolled_up():
    """S02: its end comes back to where it is held: U = 12, W = 0; 16 elements miss 2.7 %."""
    scene, shell = cantilever(16, length=12.0)
    for node in shell.set("right"):
        ends = nc.Direction(nc.ground, (0, -1, 0)), nc.Direction(node, (0, 0, 1))
        scene.add(nc.PairTorque(ends, torque=grows(0.5 * 50.0 * np.pi / 3.0)))
    system, states = solved(scene, 20)
    x = place_of(system, states, shell.set("right")[0])[-1]
    return 12.0 - x[0], x[2]


def frame_of_plates():
    """An L of two strips under a force at its end: 0.999 of beam theory with eight elements a leg."""
    scene, mesh = nc.Scene(), nc.mesh.rectangle((1.0, 0.1), (8, 1))
    more = {"thickness": 0.01, "material": nc.Elastic(E=1e7, density=1.0)}
    post = scene.add(nc.Shell(mesh, orientation=((0, 1, 0), -np.pi / 2), **more, name="post"))
    arm = scene.add(nc.Shell(mesh, position=(0, 0, 1), **more, name="arm"))
    scene.add(nc.Clamp(nc.ground, post.set("left")))
    scene.add(nc.Fold(post.set("right"), arm.set("left")))
    for node in arm.set("right"):
        push(scene, node, (0, 0, -0.5e-6))
    system, states = solved(scene, 1)
    sag = 1.0 - place_of(system, states, arm.set("right")[0])[-1, 2]
    return sag * 1e7 * 0.1 * 0.01**3 / 12 / 1e-6


def slit_ring():
    """S03: a ring cut open and lifted at one side of the slit, 13.891 and 17.528; 6 x 30 miss 2 %."""

    def place(u, v):
        radius, angle = 6.0 + 4.0 * u, 2 * np.pi * v * (1 - 1e-6)
        return radius * np.cos(angle), radius * np.sin(angle), 0.0

    scene, hard = nc.Scene(), nc.Elastic(E=21e6, density=1.0)
    shell = scene.add(nc.Shell(grid((6, 30), place), thickness=0.03, material=hard, name="ring"))
    scene.add(nc.Clamp(nc.ground, shell.set("top")))
    edge = shell.set("bottom")
    for k, node in enumerate(edge):
        push(scene, node, (0, 0, 0.8 * 4.0 / 6 * (0.5 if k in (0, 6) else 1.0)))
    system, states = solved(scene, 20)
    return [place_of(system, states, edge[k])[-1, 2] for k in (0, 6)]


def pulled_hemisphere(membrane):
    """S04: with a hole of 18 degrees, by symmetry a quarter of it, 4.067 and 8.178; 8 x 8 miss 10 and 4 %."""

    def direction(u, v):
        height, angle = np.radians(72.0 * (1 - v)), np.pi / 2 * u
        return np.array([np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)])

    scene, mesh = nc.Scene(), grid((8, 8), lambda u, v: 10.0 * direction(u, v))
    directors = mesh.nodes / 10.0
    hard = nc.Elastic(E=6.825e7, nu=0.3, density=1.0)
    more = {"thickness": 0.04, "material": hard, "directors": directors, "membrane": membrane}
    shell = scene.add(nc.Shell(mesh, **more, name="shell"))
    mirror(scene, shell.set("left"), directors, 1)
    mirror(scene, shell.set("right"), directors, 0)
    hold(scene, shell.set("top")[4:5], 2)
    inner, outer = shell.nearest((10.0, 0, 0)), shell.nearest((0, 10.0, 0))
    push(scene, inner, (-200.0, 0, 0))
    push(scene, outer, (0, 200.0, 0))
    system, states = solved(scene, 10)
    return place_of(system, states, outer)[-1, 1] - 10.0, 10.0 - place_of(system, states, inner)[-1, 0]


def quarter_cylinder(counts, radius, length, material, thickness):
    """From the middle (left) to the end (right), from the loaded line (bottom) a quarter round (top)."""

    def place(u, v):
        turn = np.pi / 2 * v
        return radius * np.cos(turn), radius * np.sin(turn), length * u

    mesh = grid(counts, place)
    # Turned so that directors point outwards.
    mesh = nc.mesh.Mesh(mesh.nodes, mesh.cells[:, ::-1], mesh.sets)
    directors, scene = mesh.nodes * (1, 1, 0) / radius, nc.Scene()
    more = {"thickness": thickness, "material": material, "directors": directors}
    return scene, scene.add(nc.Shell(mesh, **more, name="shell")), directors


def eighth(counts, radius, length, material, thickness, load, *, diaphragm=False):
    """The moves of nodes by 20 loads: under the load, and a quarter round in the middle and at the end."""
    scene, shell, directors = quarter_cylinder(counts, radius, length / 2, material, thickness)
    end, top = shell.set("right"), shell.set("top")
    if diaphragm:
        # On the planes of symmetry one of them is held already.
        hold(scene, end[:-1], 0)
        hold(scene, end[1:], 1)
    mirror(scene, shell.set("left"), directors, 2)
    mirror(scene, shell.set("bottom"), directors, 1)
    mirror(scene, top, directors, 0)
    nodes = shell.set("bottom")[0], top[0], top[-1]
    push(scene, nodes[0], (load / 4, 0, 0))
    system, state = scene.compile()
    states = nc.equilibrium(system, state, steps=20).states
    return [place_of(system, states, node) - place_of(system, state, node) for node in nodes]


def pulled_cylinder():
    """S05: it snaps from bending to membrane on the way; 2.768, 4.551 and 3.269, missed by 0.8 %."""
    rubber = nc.Elastic(E=10.5e6, nu=0.3125, density=1.0)
    moved = eighth((16, 24), 4.953, 10.35, rubber, 0.094, 4e4)
    moved = np.stack([moved[0][:, 0], -moved[1][:, 1], -moved[2][:, 1]])
    published = {0.1: (1.707, 2.217, 2.293), 0.25: (2.18, 3.087, 3.31), 0.4: (2.376, 3.443, 3.632),
                 0.75: (2.692, 4.423, 3.353), 1.0: (2.768, 4.551, 3.269)}  # fmt: skip
    for load, values in published.items():
        np.testing.assert_allclose(moved[:, round(20 * load) - 1], values, rtol=0.03)
    return moved[:, -1]


def pinched_cylinder():
    """S06: between rigid diaphragms it buckles on the way; 83.102 and 34.272, missed by 0.8 and 3.1 %."""
    foil = nc.Elastic(E=3e4, nu=0.3, density=1.0)
    moved = eighth((40, 40), 100.0, 200.0, foil, 1.0, -12e3, diaphragm=True)
    for load, value in {0.05: 9.561, 0.1: 23.164, 0.2: 56.373, 0.5: 73.79, 0.7: 78.451, 1.0: 83.102}.items():
        assert -moved[0][round(20 * load) - 1, 0] == pytest.approx(value, rel=0.03)
    return -moved[0][-1, 0], moved[1][-1, 1]


def half_cylinder():
    """S07, isotropic: pushed at its free end it snaps; 171.505, missed by 0.5 %.

    By 3.4 % at a tenth of the load, which is the mesh: 8.0 % with 12 x 12, and 4.3 instead of 2 % at 0.2.
    """
    # The modulus is the one with which the published figures come about; it is printed as 2.0685e7.
    metal = nc.Elastic(E=2068.5, nu=0.3, density=1.0)
    scene, shell, directors = quarter_cylinder((20, 20), 101.6, 304.8, metal, 3.0)
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    mirror(scene, shell.set("top")[1:], directors, 0)
    # Sides along the ground: neither height nor turns about them.
    mirror(scene, shell.set("bottom")[1:], directors, 1)
    node = shell.set("top")[-1]
    push(scene, node, (0, -1000.0, 0))
    system, states = solved(scene, 40)
    sag = 101.6 - place_of(system, states, node)[:, 1]
    published = {0.2: 37.582, 0.4: 113.704, 0.6: 144.185, 0.8: 160.015, 1.0: 171.505}
    for load, value in published.items():
        assert sag[round(40 * load) - 1] == pytest.approx(value, rel=0.03 if load in (0.2, 1.0) else 0.04)
    np.testing.assert_allclose(sag[3] / 16.1, 1.0 - 0.034, atol=1e-3)
    return sag[-1]


def cook(element, count, nu):
    """Cook's membrane in plane strain: how far the middle of the loaded edge moves up [mm]."""
    box = nc.mesh.box((1.0, 1.0, 1.0), (count, count, 1), element=ELEMENTS[element])
    u, v, w = box.nodes.T
    nodes = np.stack([48 * u, 44 * u + v * (44 - 28 * u), w], axis=1)
    mesh, scene = nc.mesh.Mesh(nodes, box.cells, box.sets, box.faces), nc.Scene()
    rubber = nc.NeoHooke(E=2 * 0.4225 * (1 + nu), nu=nu, density=1.0)
    part = scene.add(nc.Solid(mesh, material=rubber, element=element))
    scene.add(nc.Clamp(nc.ground, part.set("x0")))
    layers = np.setdiff1d(np.union1d(mesh.sets["z0"], mesh.sets["z1"]), mesh.sets["x0"])
    hold(scene, part.nodes[layers], 2)
    loads = tractions(nodes, mesh.faces["x1"], np.array([0.0, 1 / 16, 0.0]))
    for node in np.flatnonzero(loads[:, 1]):
        push(scene, part.nodes[int(node)], loads[node])
    system, states = solved(scene, 2 if nu < 0.4 else 8)
    return place_of(system, states, part.nearest((48.0, 52.0, 0.0)))[-1, 1] - 52.0


@dataclasses.dataclass
class Case:
    """What a function of some arguments gives, to an absolute tolerance, and the lane of it."""

    of: Callable
    value: Any
    within: float
    arguments: tuple = ()
    lane: str = "exhaustive"


def _cook(value, *arguments, lane="exhaustive"):
    return Case(cook, value, tol.COOK, arguments, lane)


CASES = {
    "S01": Case(bent_by_a_force, (3.2930, 6.7047), tol.FOUR_DIGITS, lane="slow"),
    "S01, triangles": Case(bent_by_a_force, (3.2926, 6.7045), tol.FOUR_DIGITS, (triangulated,)),
    "S02": Case(rolled_up, (11.671, 0.029), tol.THREE_DIGITS),
    "S03": Case(slit_ring, (13.602, 17.243), tol.THREE_DIGITS),
    "S04": Case(pulled_hemisphere, (3.748, 7.306), tol.THREE_DIGITS, ("hybrid",)),
    "S04, MITC4+": Case(pulled_hemisphere, (4.042, 8.516), tol.THREE_DIGITS, ("hybrid mitc4+",)),
    "S05": Case(pulled_cylinder, (2.7512, 4.5867, 3.2520), 1e-3),
    "S06": Case(pinched_cylinder, (83.78, 35.33), 0.02),
    "S07": Case(half_cylinder, 172.30, 0.02),
    "frame": Case(frame_of_plates, 4.0 / 3.0 * 0.99904, tol.FRAME_OF_PLATES, lane="slow"),
    "Cook, bricks of 8": _cook(8.638, "Hexahedron8", 2, 0.3, lane="slow"),
    "Cook, nearly incompressible": _cook(11.889, "Hexahedron27P1", 2, 0.4999),
} | {
    f"Cook, {element}, {count}, {nu}": _cook(value, element, count, nu)
    for (element, nu), values in {
        ("Hexahedron8", 0.3): {4: 12.071, 8: 13.863, 16: 14.485},
        ("Hexahedron20", 0.3): {2: 13.913, 4: 14.563, 8: 14.689},
        ("Hexahedron27", 0.3): {2: 14.302, 4: 14.649, 8: 14.714},
        ("Hexahedron27P1", 0.3): {2: 14.663, 4: 14.735, 8: 14.739},
        ("Hexahedron8", 0.4999): {2: 4.01, 4: 4.11, 8: 4.21},
        ("Hexahedron27", 0.4999): {2: 7.99, 4: 10.10},
        ("Hexahedron27P1", 0.4999): {4: 11.954, 8: 11.974},
    }.items()
    for count, value in values.items()
}  # fmt: skip


def _marked(name):
    lane = CASES[name].lane
    return pytest.param(name, marks=() if lane == "default" else getattr(pytest.mark, lane))


@pytest.mark.parametrize("name", [_marked(name) for name in CASES])
def test_equilibria_are_the_published_ones(name):
    case = CASES[name]
    np.testing.assert_allclose(case.of(*case.arguments), case.value, rtol=0, atol=case.within)


# --- laws of convergence ------------------------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("regular", [True, False])
def test_plates_do_not_lock(regular):
    """Clamped square plate under its weight, from thick to very thin: 0.00126532 q L^4 / D of Kirchhoff."""
    mesh = nc.mesh.rectangle((1.0, 1.0), (8, 8))
    mesh = mesh if regular else distorted(mesh, 0.3 / 8)
    scene, soft = nc.Scene(), nc.Elastic(E=1.092e6, nu=0.3, density=1.0)
    shell = scene.add(nc.Shell(mesh, thickness=0.1, material=soft, name="plate"))
    edge = shell.nodes.where(lambda x: np.any(np.abs(x[:, :2] - 0.5) > 0.5 - 1e-9, axis=1))
    scene.add(nc.Clamp(nc.ground, edge))
    scene.add(nc.Gravity(vector=(0, 0, 1e-9)))
    system, state = scene.compile()
    middle = shell.nearest((0.5, 0.5, 0.0))

    @jax.jit
    @jax.vmap
    def sag(thickness):
        changed = system.set(shell, thickness=thickness)
        end = nc.equilibrium(changed, state, steps=1, throw=False).state
        rigidity = 1.092e6 * thickness**3 / 12 / (1 - 0.3**2)
        return changed.sense(end, middle).position[2] * rigidity / (1e-9 * thickness)

    sags = np.asarray(sag(jnp.array([1e-1, 1e-2, 1e-3, 1e-4])))
    if regular:
        np.testing.assert_allclose(sags[2:], 0.001251, atol=1e-6)
    assert sags[0] == pytest.approx(0.001504, rel=0.05)
    np.testing.assert_allclose(sags[1:], 0.00126532, rtol=0.03 if regular else 0.2)


ROUND_IN = {"cylinder": 2, "sphere": 3}
"""Dimensions in which it is round: stretches along them are alike."""


def piece(shape, element, count, law):
    """A piece between planes of symmetry of what is 1 m thick about a hole of radius 1 m, and its scene.

    As wide as one element, it has the exact solution of all of it, by few elements.
    """
    angle = 0.25 * np.pi / count
    box = nc.mesh.box((1.0, 1.0, 1.0), (count, 1, 1), element=ELEMENTS[element])
    u, v, w = box.nodes.T
    along = np.stack([np.ones_like(v), np.tan(angle * v), np.tan(angle * w) * (shape == "sphere")], axis=1)
    nodes = (1.0 + u)[:, None] * along / np.linalg.norm(along, axis=1, keepdims=True)
    nodes[:, 2] += w / count * (shape == "cylinder")
    mesh, scene = nc.mesh.Mesh(nodes, box.cells, box.sets, box.faces), nc.Scene()
    part = scene.add(nc.Solid(mesh, material=law, element=element))
    aside = (-np.sin(angle), np.cos(angle), 0.0)
    normals = {"y0": (0, 1, 0), "y1": aside, "z0": (0, 0, 1), "z1": np.array(aside)[[0, 2, 1]]}
    if shape == "cylinder":
        normals["z1"] = normals["z0"]
    for name, normal in normals.items():
        table = nc.Point(nc.ground), nc.Direction(nc.ground, normal)
        for node in mesh.sets[name]:
            distance = float(nodes[node] @ normal)
            scene.add(nc.PointOnPlane((*table, nc.Point(part.nodes[int(node)])), distance=distance))
    return scene, part, nodes


def widened(shape, law, element, count, pressure):
    """Root mean square of what nodes are moved wrongly by, under a pressure in the hole [m]."""
    scene, part, nodes = piece(shape, element, count, law)
    scene.add(nc.Pressure(part.face("x0"), grows(pressure)))
    _, states = solved(scene, 2)
    places = np.asarray(states.rows)[-1, :, 0]
    radial = nodes * (np.arange(3) < ROUND_IN[shape])
    radius = np.linalg.norm(radial, axis=1, keepdims=True)
    moved = np.polynomial.legendre.legval(2 * radius - 3, widening(shape, law, pressure))
    return np.sqrt(np.mean((places - nodes - moved / radius * radial) ** 2))


def widening(shape, law, pressure):
    """The exact one by radius: a polynomial of high degree at which the energy is stationary."""
    x, weights = np.polynomial.legendre.leggauss(40)
    radius, weights, degree, round_in = 1.5 + 0.5 * x, 0.5 * weights, 17, ROUND_IN[shape]
    powers = np.polynomial.legendre.legvander(x, degree - 1)
    slopes = 2 * np.polynomial.legendre.legval(x, np.polynomial.legendre.legder(np.eye(degree))).T
    inside = np.polynomial.legendre.legvander(np.array([-1.0]), degree - 1)[0]

    def energy(a):
        around = 1 + powers @ a / radius
        stretches = jnp.stack([1 + slopes @ a, around, around if round_in == 3 else jnp.ones_like(around)])
        strain = jnp.concatenate([0.5 * (stretches**2 - 1), jnp.zeros((3, len(x)))])
        stored = jnp.sum(weights * radius ** (round_in - 1) * law.energy_density(strain))
        return stored - pressure / round_in * (1 + inside @ a) ** round_in

    newton = jax.jit(lambda a: jnp.linalg.solve(jax.hessian(energy)(a), jax.grad(energy)(a)))
    a = jnp.zeros(degree)
    for _ in range(12):
        change = newton(a)
        a = a - change
    assert np.abs(change).max() < 1e-10
    assert inside @ a > 0.1, "strains are small"
    return np.asarray(a)


SOFT = nc.NeoHooke(E=1.0, nu=0.3, density=1.0)
NEARLY_INCOMPRESSIBLE = nc.NeoHooke(E=1.0, nu=0.4999, density=1.0)
FOAM = nc.CompressibleMooneyRivlin(c10=0.15, c01=0.05, density=1.0)
RUBBER = nc.MooneyRivlin(c10=0.1, c01=0.06, bulk_modulus=50.0, density=1.0)
THICK = [
    ("sphere", "Hexahedron8", SOFT, 0.15, 2.0),
    ("cylinder", "Tetrahedron10", SOFT, 0.15, 3.0),
    ("cylinder", "Tetrahedron10P0", RUBBER, 0.1, 2.0),
    ("cylinder", "Hexahedron8", SOFT, 0.15, 2.0),
    ("cylinder", "Hexahedron20", SOFT, 0.15, 3.0),
    ("cylinder", "Hexahedron27", FOAM, 0.15, 3.0),
    ("cylinder", "Hexahedron27P1", NEARLY_INCOMPRESSIBLE, 0.12, 3.0),
    ("sphere", "Hexahedron27P1", NEARLY_INCOMPRESSIBLE, 0.15, 3.0),
]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("shape", "element", "law", "pressure", "order"), THICK)
def test_thick_walls_widen_as_they_should(shape, element, law, pressure, order):
    """Against the exact solution, with large strains: errors fall as theory says, or faster."""
    # Volumes that are constant in each element allow two only, and finer meshes to see it: 1.87, then 1.98.
    counts = (4, 8) if element == "Tetrahedron10P0" else (2, 4)
    coarse, fine = (widened(shape, law, element, n, pressure) for n in counts)
    assert np.log2(coarse / fine) >= order - tol.ORDER_TOLERANCE
    assert fine <= tol.THICK_WALL[order]


@pytest.mark.exhaustive
def test_a_hinged_roof_snaps_through():
    """A panel 12.7 mm thick, pushed in its middle: its limit load, a quarter of 2.2 kN, along the arc."""
    scene, count, radius, angle = nc.Scene(), 4, 2540.0, 0.1

    def place(u, v):
        return radius * np.sin(angle * v), 254.0 * u, radius * (np.cos(angle * v) - 1.0)

    mesh = grid((count, count), place)
    turned = nc.mesh.Mesh(mesh.nodes, mesh.cells[:, ::-1], mesh.sets)
    directors = mesh.nodes * (1, 0, 1) + (0, 0, radius)
    directors = directors / np.linalg.norm(directors, axis=1, keepdims=True)
    steel = nc.Elastic(E=3102.75, nu=0.3, density=1.0)
    roof = scene.add(nc.Shell(turned, thickness=12.7, material=steel, directors=directors, name="roof"))
    mirror(scene, roof.set("left"), directors, 1)
    mirror(scene, roof.set("bottom"), directors, 0)
    hinge = roof.set("top")
    for component in range(3):
        # On the planes of symmetry one of them is held already.
        hold(scene, hinge if component != 1 else hinge[1:], component)
    middle = roof.nearest((0.0, 0.0, 0.0))
    push(scene, middle, (0, 0, -250.0))
    system, state = scene.compile()
    path = nc.load_path(system, state, arc=0.01, steps=30, scale=100.0)
    load, sag = np.asarray(path.states.t), -place_of(system, path.states, middle)[:, 2]
    turning = int(np.argmax(np.diff(load) < 0))
    assert 0 < turning and load[turning] == pytest.approx(2.2, rel=0.05)
    assert 8.0 < sag[turning] < 14.0 and np.all(np.diff(sag)[: turning + 3] > 0)


@pytest.mark.exhaustive
def test_equilibria_of_a_plate_do_not_depend_on_the_path():
    """A plate bent by one force and then by another, or the other way round, ends in the same place."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e6, nu=0.3, density=1.0)
    shell = scene.add(nc.Shell(nc.mesh.rectangle((1.0, 0.5), (4, 2)), thickness=0.02, material=rubber))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    edge = shell.set("right")
    for k, axis in ((0, (0, 0, 1)), (2, (0, 0.5, -1))):
        scene.add(nc.BodyForceInput((nc.Point(edge[k]), nc.Direction(nc.ground, axis))))
    system, state = scene.compile()
    ways = np.array([[(1, 0), (2, 0), (2, 1), (2, 2)], [(0, 1), (0, 2), (1, 2), (2, 2)]], float)
    ends = [nc.equilibrium(system, state, jnp.arange(4.0), inputs=0.1 * way).state for way in ways]
    # Places and directors; the other axes of a node mean nothing.
    np.testing.assert_allclose(*[np.asarray(x.rows)[:, :2] for x in ends], atol=1e-9)
    assert np.abs(ends[0].q - state.q).max() > 0.02


class StiffShell(nc.ShellElement):
    """A shell of twice the energy."""

    kind = "stiff shell"

    def energy(self, invariants):
        """Twice that of others."""
        return 2.0 * super().energy(invariants)

    def slope(self, invariants):
        """Twice that of others."""
        return 2.0 * super().slope(invariants)

    def energy_curvature(self, invariants):
        """Twice that of others."""
        return 2.0 * self.stiffness


@pytest.mark.slow
def test_an_element_of_ones_own_on_the_base_of_another():
    """Numbers that follow from the pose are there for its methods: it bends half as far."""
    mesh, sags = nc.mesh.rectangle((1.0, 0.5), (3, 1)), []
    for element in (nc.ShellElement, StiffShell):
        scene = nc.Scene()
        nodes = scene.add(nc.Nodes.directors(mesh.nodes, (0, 0, 1.0)))
        metal = nc.Elastic(E=2e9, nu=0.3, density=1000.0)
        scene.add(element.on(nodes, mesh.cells, thickness=0.02, material=metal))
        scene.add(nc.Clamp(nc.ground, nodes.where(lambda x: x[:, 0] < x[:, 0].min() + 1e-9)))
        push(scene, nodes[3], (0, 0, 1e-4))
        system, state = scene.compile()
        end = nc.equilibrium(system, state).state
        sags.append(float(np.abs(np.asarray(end.rows - state.rows)[:, 0, 2]).max()))
    assert sags[0] == pytest.approx(2.0 * sags[1], rel=1e-6)


# --- many unknowns ------------------------------------------------------------------------------------------


def long_strip(count):
    """A strip that is bent by a force at its end, and its end."""
    scene, shell = cantilever(count)
    for node in shell.set("right"):
        push(scene, node, (0, 0, 1.0))
    return scene, shell, shell.set("right")[0]


def tied_blocks(count):
    """Two blocks of meshes that do not match, tied: with multipliers."""
    scene, metal = nc.Scene(), nc.Elastic(E=2e5, nu=0.3, density=1200.0)
    # Under the earth's gravity elements at the clamp would be turned inside out.
    scene.add(nc.Gravity(vector=(0.0, 0.0, -1.0)))
    one = scene.add(nc.Solid(nc.mesh.box((1.0, 0.8, 0.8), (count, 3, 3)), material=metal))
    fine = nc.mesh.box((1.0, 0.8, 0.8), (count, 4, 4))
    two = scene.add(nc.Solid(fine, material=metal, position=(1, 0, 0), name="fine"))
    scene.add(nc.Tie(two.face("x0"), one.face("x1")))
    scene.add(nc.Clamp(nc.ground, one.set("x0")))
    return scene, two, two.nearest((2, 0, 0))


MANY = {
    "strip": (long_strip, (39, 42), 1e-3),
    "path": (long_strip, (39, 42), 1e-3),
    "tied": (tied_blocks, (2, 3), 0.1),
}
"""How to make it, counts of elements below and above 400 unknowns, and what the mesh changes."""


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", MANY)
def test_many_unknowns_are_solved_as_few_are(name):
    """Could go wrong: the sparse plan, which takes over from 400 unknowns on, and its derivatives."""
    make, counts, within = MANY[name]
    heights = []
    for count in counts:
        scene, part, tip = make(count)
        system, state = scene.compile()
        modulus = float(np.ravel(system.get(part, "material.E"))[0])

        @jax.jit
        def height(factor, system=system, state=state, part=part, tip=tip, modulus=modulus):
            softer = system.set(part, E=factor * modulus)
            if name == "path":
                end = nc.load_path(softer, state, arc=0.05, steps=3).state
            else:
                end = nc.equilibrium(softer, state, steps=2).state
            return softer.sense(end, tip).position[2]

        value, slope = jax.value_and_grad(height)(1.0)
        near = [float(height(1 + x)) for x in (1e-5, -1e-5)]
        assert float(slope) == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-5)
        heights.append(float(value))
    assert abs(heights[1]) > 1e-3
    assert heights[1] == pytest.approx(heights[0], rel=within)
