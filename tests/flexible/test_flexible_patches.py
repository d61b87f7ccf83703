"""Patches: constant strains are seen as what they are and balance inside; rigid motions cost nothing.

Could go wrong: strains that are coupled in an element, that feel large rotations, or that distorted and
uneven meshes spoil; stresses that are not those of the law; laminates about the wrong surface.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import (
    AXES,
    ELEMENTS,
    LAWS,
    PAIRED,
    distorted,
    forces,
    hold,
    inner_nodes,
    mixed,
    triangulated,
    with_rows,
)
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import natcoord_jax as nc

METAL = nc.Elastic(E=2e5, nu=0.3, density=1200.0)
SECTION = nc.Section.of_numbers(EA=1e4, GA=5e3, EI=(1.0, 2.0), GJ=1.5, density=2.0, rotary=0.01)
RANDOM = np.random.default_rng(0)

# --- beams --------------------------------------------------------------------------------------------------


def free_beam(interpolation=None):
    """Three uneven elements along x, with their axes d_1, d_2, d_3 along y, z, x."""
    scene, more = nc.Scene(), {"elements": 3, "stations": (0.2,), "second": (0, 1, 0)}
    if interpolation is not None:
        more["interpolation"] = interpolation
    beam = scene.add(nc.Beam(SECTION, [(0, 0, 0), (1, 0, 0)], name="beam", **more))
    return *scene.compile(), beam


def placed(system, state, beam, places, axes):
    """States with the nodes of a beam at places (lanes, nodes, 3), with axes as columns."""
    rows = np.concatenate([places[:, :, None], np.swapaxes(axes, 2, 3)], axis=2)
    order = [system.body_index(node) for node in beam.nodes]
    sorted_rows = np.empty_like(rows)
    sorted_rows[:, order] = rows
    return jax.vmap(lambda rows: with_rows(state, rows))(jnp.asarray(sorted_rows))


def along_screws(strains, fractions):
    """Places and axes of nodes of a metre at constant strains (lanes, 6): exponentials of their twists."""
    places, axes = [], []
    for strain in strains:
        twist, k = np.zeros((4, 4)), strain[3:]
        twist[:3, :3] = [[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]]
        twist[:3, 3] = strain[:3] + [0, 0, 1.0]
        motions = [expm(s * twist) for s in fractions]
        places.append([AXES @ m[:3, 3] for m in motions])
        axes.append([AXES @ m[:3, :3] for m in motions])
    return np.array(places), np.array(axes)


def test_constant_strains_of_beams_are_exact():
    """Every state of constant strain, shear and torsion included, from 1e-8 to 2; turned and moved, too."""
    system, state, beam = free_beam()
    sizes = np.repeat([1e-8, 1e-3, 0.3, 2.0], 4)
    strains = sizes[:, None] * RANDOM.normal(size=(16, 6)) / np.sqrt(6)
    # The longest element is turned by nearly half a circle.
    curled = RANDOM.normal(size=(4, 3))
    curled *= 7.0 / np.linalg.norm(curled, axis=1, keepdims=True)
    strains = np.concatenate([strains, np.concatenate([np.full((4, 3), 0.1), curled], axis=1)])
    places, axes = along_screws(strains, beam.fractions)
    seen = np.asarray(system.sense(placed(system, state, beam, places, axes), beam.elements).strain)
    np.testing.assert_allclose(seen, np.broadcast_to(strains[:, None], seen.shape), rtol=1e-12, atol=1e-14)
    turns = Rotation.random(20, random_state=1).as_matrix()
    places = np.einsum("lij,lnj->lni", turns, places) + RANDOM.normal(size=(20, 1, 3))
    turned = placed(system, state, beam, places, turns[:, None] @ axes)
    again = np.asarray(system.sense(turned, beam.elements).strain)
    np.testing.assert_allclose(again, seen, rtol=0, atol=10 * tol.SOME_ROUNDINGS)


ORDERS = [1, *(pytest.param(order, marks=pytest.mark.exhaustive) for order in (2, 3))]


@pytest.mark.parametrize("order", ORDERS)
def test_interpolated_directors_see_shear_and_stretch_and_no_rigid_motion(order):
    """At all points of integration; curved and twisted pieces, turned by anything, keep their strains."""
    system, state, beam = free_beam(nc.DirectorInterpolation(order=order))
    arc, count = np.asarray(beam.fractions), len(beam.nodes)
    frame = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    gamma = np.array([0.1, -0.2, 1.3])
    places = (arc[:, None] * (frame @ gamma))[None]
    states = placed(system, state, beam, places, np.broadcast_to(frame, (1, count, 3, 3)))
    seen = np.asarray(system.sense(states, beam.elements).strain)
    wanted = np.array([*(gamma - [0, 0, 1.0]), 0, 0, 0])
    np.testing.assert_allclose(seen, np.broadcast_to(wanted, seen.shape), rtol=0, atol=tol.IDENTITY / 0.1)
    axes = Rotation.from_rotvec(0.5 * RANDOM.normal(size=(count, 3))).as_matrix()
    places = np.cumsum(RANDOM.normal(size=(count, 3)), axis=0)
    turns = np.stack([np.eye(3), *Rotation.random(5, random_state=2).as_matrix()])
    moved = np.einsum("lij,nj->lni", turns, places) + np.arange(6)[:, None, None]
    states = placed(system, state, beam, moved, turns[:, None] @ axes)
    seen = np.asarray(system.sense(states, beam.elements).strain)
    scale = np.abs(seen).max()
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], seen.shape), rtol=0, atol=1e-13 * scale)


# --- shells -------------------------------------------------------------------------------------------------

KINDS = {
    "mixed": (mixed, {}),
    "hybrid": (lambda mesh: mesh, {}),
    "mitc4+": (lambda mesh: mesh, {"membrane": "hybrid mitc4+"}),
    "triangles": (triangulated, {}),
}
LANE = {"mixed": pytest.mark.slow}
SHELLS = [pytest.param(kind, marks=LANE.get(kind, pytest.mark.exhaustive)) for kind in KINDS]


@pytest.mark.parametrize("kind", SHELLS)
def test_inner_nodes_of_shells_balance(kind):
    """In a state of constant strain, curvature or shear of a distorted mesh."""
    change, more = KINDS[kind]
    mesh = distorted(nc.mesh.rectangle((1.0, 0.8), (3, 3)), 0.08)
    inner, scene = inner_nodes(mesh), nc.Scene()
    scene.add(nc.Shell(change(mesh), thickness=0.01, material=METAL, name="plate", **more))
    system, state = scene.compile()
    rows = np.asarray(state.rows)
    x, y = mesh.nodes[:, 0], mesh.nodes[:, 1]
    stretched = rows.copy()
    stretched[:, 0] = mesh.nodes @ np.array([(1.01, 0.002, 0), (0.004, 0.995, 0), (0, 0, 1)]).T
    pulled = jax.jit(lambda rows: forces(system, state, rows))
    balance = np.asarray(pulled(stretched))[:, :2]
    assert np.abs(balance[inner]).max() <= tol.INDIFFERENCE * np.abs(balance).max()
    bent, sheared = np.zeros_like(rows), np.zeros_like(rows)
    bent[:, 0, 2] = 0.5 * (x**2 + x * y + y**2)
    bent[:, 1, :2] = np.stack([-(x + 0.5 * y), -(y + 0.5 * x)], axis=1)
    sheared[:, 0, 2] = x + 0.3 * y
    # Small changes: shears and curvatures are constant to first order only.
    slopes = jax.jit(jax.vmap(lambda change: jax.jvp(pulled, (jnp.asarray(rows),), (change,))[1]))
    of_bent, of_sheared = np.asarray(slopes(jnp.stack([bent, sheared])))
    # All are rounded as shears times their stiffness are.
    allowed = 1e-15 * float(METAL.E) * 0.01
    assert max(np.abs(of_bent[inner, 0]).max(), np.abs(of_bent[inner, 1, :2]).max()) <= allowed
    assert np.abs(of_sheared[inner, 0]).max() <= allowed


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["hybrid", "mitc4+", "triangles"])
def test_a_distorted_shell_element_has_six_rigid_motions(kind):
    """And is not strained by large rotations."""
    change, more = KINDS[kind]
    corners = np.array([(0, 0, 0), (1.1, 0.1, 0), (0.9, 0.8, 0.1), (-0.1, 0.7, 0)], float)
    scene, mesh = nc.Scene(), nc.mesh.Mesh(corners, [(0, 1, 2, 3)])
    normals = np.array((0.05, -0.04, 1.0)) / np.linalg.norm((0.05, -0.04, 1.0))
    plate = {"thickness": 0.1, "material": METAL, "directors": np.broadcast_to(normals, (4, 3))}
    scene.add(nc.Shell(change(mesh), **plate, **more))
    system, state = scene.compile()
    squares = np.asarray(nc.modes(system, state).frequencies) ** 2
    assert np.sum(squares < 1e-9 * squares.max()) == 6
    turn = Rotation.from_rotvec([0, 0, 1.2]) * Rotation.from_rotvec([1.2, 0, 0])
    rows = np.asarray(state.rows) @ turn.as_matrix().T
    rows[:, 0] += (3.0, 4.0, 5.0)
    assert np.abs(np.asarray(forces(system, state, rows))).max() <= tol.INDIFFERENCE * 2e5 * 0.1


@pytest.mark.slow
def test_stress_of_a_uniform_stretch_of_a_shell():
    """On a distorted mesh, exact: plane stress by the strains of Green and Lagrange."""
    mesh, scene = distorted(nc.mesh.rectangle((1.0, 0.5), (4, 3)), 0.03), nc.Scene()
    part = scene.add(nc.Shell(mesh, thickness=0.02, material=METAL, name="body"))
    system, state = scene.compile()
    f = np.eye(3) + np.array([(0.1, 0.05, 0), (0.0, -0.02, 0), (0, 0, 0)])
    rows = np.array(state.rows)
    rows[:, 0] = np.asarray(part.nodes.positions) @ f.T
    state = with_rows(state, rows)
    strain = 0.5 * (f.T @ f - np.eye(3))[:2, :2]
    seen = system.sense(state, part)
    plane = np.asarray(METAL.plane_stress())
    # Invariants: trace and determinant, whatever the axes of the elements are.
    e = np.asarray(seen.strain)
    np.testing.assert_allclose(e[:, 0] + e[:, 1], np.trace(strain), atol=1e-12)
    np.testing.assert_allclose(e[:, 0] * e[:, 1] - e[:, 2] ** 2 / 4, np.linalg.det(strain), atol=1e-12)
    np.testing.assert_allclose(seen.resultants, 0.02 * e @ plane, atol=1e-8)
    np.testing.assert_allclose(seen.stress[:, 0], e @ plane, atol=1e-6)
    np.testing.assert_allclose(seen.curvature, 0.0, atol=1e-12)
    assert float(seen.energy.sum()) == pytest.approx(float(system.energy(state).total), rel=1e-12)


PLY = nc.Orthotropic(E1=140e9, E2=10e9, nu12=0.3, G12=5e9, density=1600.0)


def test_sheets_of_laminates():
    """Against classical laminate theory: a cross-ply couples, and a turned ply is softer as is known."""
    stiff = np.asarray(PLY.plane_stress())
    crossed = nc.Laminate(PLY, angles=np.radians([0.0, 90.0])).sheet(2e-3)
    total, apart = stiff[0, 0] + stiff[1, 1], stiff[1, 1] - stiff[0, 0]
    assert float(crossed.membrane[0, 0]) == pytest.approx(1e-3 * total, rel=1e-12)
    assert float(crossed.coupling[0, 0]) == pytest.approx(2e-3**2 / 8 * apart, rel=1e-12)
    assert float(crossed.coupling[1, 1]) == pytest.approx(-(2e-3**2) / 8 * apart, rel=1e-12)
    assert float(crossed.bending[0, 0]) == pytest.approx(2e-3**3 / 24 * total, rel=1e-12)
    turned = np.linalg.inv(nc.Laminate(PLY, angles=[np.radians(30.0)]).sheet(1.0).membrane)
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    softness = c**4 / 140e9 + s**4 / 10e9 + c**2 * s**2 * (1 / 5e9 - 2 * 0.3 / 140e9)
    assert float(turned[0, 0]) == pytest.approx(softness, rel=1e-12)
    # As thick as one of the plies on one side, as both on the other: about another surface.
    moved = nc.Laminate(PLY, angles=[0.0]).sheet(1e-3).shifted(5e-4)
    halves = nc.Laminate(PLY, angles=[0.0, 0.0]).sheet(2e-3)
    below = nc.Laminate(PLY, angles=[0.0]).sheet(1e-3).shifted(-5e-4)
    np.testing.assert_allclose(moved.bending + below.bending, halves.bending, rtol=1e-12)


CURLED = [
    pytest.param(lambda mesh: mesh, id="quadrilaterals"),
    pytest.param(triangulated, id="triangles"),
]


@pytest.mark.exhaustive
@pytest.mark.parametrize("change", CURLED)
def test_an_unsymmetric_laminate_curls(change):
    """Energy of an element field of strain and curvature is that of the sheet, coupling included."""
    mesh = distorted(nc.mesh.rectangle((1.0, 0.8), (3, 3)), 0.08)
    laminate = nc.Laminate(PLY, angles=np.radians([0.0, 60.0]), fractions=(0.4, 0.6))
    scene = nc.Scene()
    more = {"thickness": 0.02, "material": laminate, "direction": (1.0, 1.0, 0.0), "offset": 0.003}
    shell = scene.add(nc.Shell(change(mesh), **more, name="plate"))
    system, state = scene.compile()
    rows = np.asarray(state.rows)
    moved, size = np.zeros_like(rows), 1e-6
    strain, curvature = np.array([(0.7, 0.2), (0.2, -0.4)]), np.array([(30.0, 8.0), (8.0, -20.0)])
    moved[:, 0, :2] = mesh.nodes[:, :2] @ strain
    moved[:, 0, 2] = -0.5 * np.einsum("ni,ij,nj->n", mesh.nodes[:, :2], curvature, mesh.nodes[:, :2])
    moved[:, 1, :2] = mesh.nodes[:, :2] @ curvature
    slope = jax.jit(lambda rows: jax.jvp(lambda r: forces(system, state, r), (rows,), (moved,))[1])
    energy = 0.5 * np.sum(moved * np.asarray(slope(jnp.asarray(rows))))
    turn = np.array([(1, 1), (-1, 1)]) / np.sqrt(2)
    turned = [turn @ m @ turn.T for m in (strain, curvature)]
    e, k = (np.array([m[0, 0], m[1, 1], 2 * m[0, 1]]) for m in turned)
    sheet = laminate.sheet(0.02).shifted(0.003)
    exact = 0.4 * (e @ sheet.membrane @ e + 2 * e @ sheet.coupling @ k + k @ sheet.bending @ k)
    assert energy == pytest.approx(float(exact), rel=1e-9)
    moments = system.sense(with_rows(state, rows + size * moved), shell).moments
    expected = size * np.asarray(sheet.coupling @ e + sheet.bending @ k)
    np.testing.assert_allclose(moments, np.broadcast_to(expected, moments.shape), rtol=1e-3)


# --- solids -------------------------------------------------------------------------------------------------

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Components of symmetric tensors, as laws take strains: of shear twice."""
FIRST, SECOND = np.array(PAIRS).T
LANES = {("Hexahedron8", "neo-Hooke"): (), ("Tetrahedron10P0", "Mooney-Rivlin"): pytest.mark.slow}
SOLIDS = [pytest.param(*pair, marks=LANES.get(pair, pytest.mark.exhaustive)) for pair in PAIRED]
GRADIENT = np.array([(1.1, 0.2, -0.1), (0.05, 0.9, 0.15), (0.0, -0.1, 1.2)])


def density_of(law, f):
    """Energy per volume by a deformation gradient."""
    strain = (0.5 * (f.T @ f - jnp.eye(3)))[FIRST, SECOND] * np.where(FIRST == SECOND, 1.0, 2.0)
    return law.energy_density(strain[:, None])[0]


@pytest.mark.parametrize(("element", "law"), SOLIDS)
def test_inner_nodes_of_solids_balance(element, law):
    """A uniform deformation of a distorted mesh: no forces on inner nodes, stress and energy of the law."""
    mesh = distorted(nc.mesh.box((1.0, 0.8, 0.6), (2, 2, 2), element=ELEMENTS[element]), 0.05)
    scene, inner = nc.Scene(), inner_nodes(mesh)
    part = scene.add(nc.Solid(mesh, material=LAWS[law], element=element))
    system, state = scene.compile()
    rows = np.array(state.rows)
    rows[:, 0] = mesh.nodes @ GRADIENT.T
    state = with_rows(state, rows)
    pulled = np.asarray(jax.jit(lambda rows: forces(system, state, rows))(rows))[:, 0]
    assert inner.any()
    assert np.abs(pulled[inner]).max() <= 10 * tol.INDIFFERENCE * np.abs(pulled).max()
    density, first = jax.jit(jax.value_and_grad(lambda f: density_of(LAWS[law], f)))(jnp.asarray(GRADIENT))
    stress = np.asarray(first) @ GRADIENT.T / np.linalg.det(GRADIENT)
    seen = system.sense(state, part)
    assert np.abs(seen.stress - stress).max() <= 100 * tol.INDIFFERENCE * np.abs(stress).max()
    away = stress - np.trace(stress) / 3 * np.eye(3)
    np.testing.assert_allclose(seen.von_mises, np.sqrt(1.5 * np.sum(away**2)), rtol=1e-9)
    assert float(system.energy(state).total) == pytest.approx(0.48 * float(density), rel=tol.INDIFFERENCE)


@pytest.mark.exhaustive
@pytest.mark.parametrize("law", LAWS)
def test_a_short_step_pushes_as_the_energy_says(law):
    """From rest, deformed by tens of per cent: velocities are the forces times the step over the masses."""
    mesh, scene = distorted(nc.mesh.box((1.0, 0.8, 0.6), (2, 2, 2)), 0.05), nc.Scene()
    scene.add(nc.Solid(mesh, material=LAWS[law], element="Hexahedron8"))
    system, state = scene.compile()
    rows = np.array(state.rows)
    rows[:, 0] = mesh.nodes @ GRADIENT.T + 0.02 * RANDOM.normal(size=mesh.nodes.shape)
    state, dt = with_rows(state, rows), 1e-6
    after = nc.simulate(system, state, dt=dt, steps=1).states
    masses = np.asarray(system.mass)[:, 0, 0]
    pushed = np.asarray(after.row_rates)[-1, :, 0] * masses[:, None] / dt
    pulled = np.asarray(forces(system, state, rows))[:, 0]
    np.testing.assert_allclose(pushed, -pulled, rtol=0, atol=1e-6 * np.abs(pulled).max())


@pytest.mark.exhaustive
def test_a_uniform_stress_passes_a_tie():
    """Pulled at one end, held at the other, where its width is free: the same stress in all elements."""
    scene = nc.Scene()
    fine, coarse = (nc.mesh.box((1.0, 0.8, 0.8), (2, n, n)) for n in (3, 2))
    one = scene.add(nc.Solid(coarse, material=METAL, name="coarse"))
    two = scene.add(nc.Solid(fine, material=METAL, position=(1, 0, 0), name="fine"))
    scene.add(nc.Tie(two.face("x0"), one.face("x1"), name="seam"))
    hold(scene, one.set("x0"), 0)
    for place, components in (((0, 0, 0), (1, 2)), ((0, 0, 0.8), (1,))):
        corner = one.nodes.where(lambda x, p=place: np.all(np.abs(x - p) < 1e-9, axis=1))
        for component in components:
            hold(scene, corner, component)
    scene.add(nc.Pressure(two.face("x1"), lambda t: -1e3 * t))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=1).state
    stress = np.concatenate([system.sense(end, part).stress for part in (one, two)])
    np.testing.assert_allclose(stress[:, 0, 0], 1e3, rtol=1e-6)
    np.testing.assert_allclose(stress[:, 1:, 1:], 0.0, atol=1e-3)
