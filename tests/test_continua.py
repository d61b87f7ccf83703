"""Shells and solids on meshes: masses, stresses, pressure, numbers that follow others, and wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.analysis import static_equations

METAL = nc.Elastic(E=2e5, nu=0.3, density=1200.0)


def distorted(mesh, size=0.03):
    """A mesh whose inner nodes are moved at random."""
    random = np.random.default_rng(0)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    inner = np.all((mesh.nodes > low + 1e-9) & (mesh.nodes < high - 1e-9) | (low == high), axis=1)
    moved = size * random.uniform(-1, 1, mesh.nodes.shape) * (low < high)
    return nc.mesh.Mesh(mesh.nodes + inner[:, None] * moved, mesh.cells, mesh.sets, mesh.faces)


MESHES = {
    "shell": distorted(nc.mesh.rectangle((1.0, 0.5), (4, 3))),
    "solid": distorted(nc.mesh.box((1.0, 0.5, 0.4), (3, 2, 2))),
}


def body(kind, **given):
    """A scene with a shell or a solid of a distorted mesh, free."""
    scene, mesh = nc.Scene(), MESHES[kind]
    if kind == "shell":
        part = nc.Shell(mesh, thickness=0.02, material=METAL, name="body", **given)
    else:
        part = nc.Solid(mesh, material=METAL, name="body", **given)
    return scene, scene.add(part)


@pytest.mark.parametrize(("kind", "mass"), [("shell", 1200.0 * 0.5 * 0.02), ("solid", 1200.0 * 0.2)])
def test_mass_and_motion(kind, mass):
    """Of a rigid body that is put somewhere, turned and spun."""
    turn = np.array([(0.0, -1, 0), (1, 0, 0), (0, 0, 1)])
    spin = np.array([0.2, 0.3, 2.0])
    scene, _ = body(kind, position=(1, 2, 3), orientation=turn, velocity=(0.5, 0, 0), angular_velocity=spin)
    system, state = scene.compile()
    assert float(system.mass[:, 0, 0].sum()) == pytest.approx(mass, rel=1e-12)
    centre = np.array([1, 2, 3]) + turn @ ((0.5, 0.25, 0.0) if kind == "shell" else (0.5, 0.25, 0.2))
    np.testing.assert_allclose(
        system.momentum(state) / mass, (0.5, 0, 0) + np.cross(spin, centre - (1, 2, 3)), atol=1e-2
    )
    assert float(system.energy(state).stores["body"]) < 1e-20
    trajectory = nc.simulate(system, state, dt=2e-3, steps=20)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


def stretched(kind, gradient):
    """A body whose nodes are moved to (1 + gradient) X."""
    scene, part = body(kind)
    system, state = scene.compile()
    places = np.asarray(part.nodes.positions) @ (np.eye(3) + gradient).T
    rows = np.asarray(state.q).reshape(-1, 4, 3).copy()
    rows[:, 0] = places
    moved = jax.tree.map(lambda x: x, state)
    return system, part, nc.State(**{**vars(moved), "q": jnp.asarray(rows.reshape(-1, 3))})


def test_stress_of_a_uniform_stretch_of_a_shell():
    """On a distorted mesh, exact: plane stress by the strains of Green and Lagrange."""
    gradient = np.array([(0.1, 0.05, 0), (0.0, -0.02, 0), (0, 0, 0)])
    system, part, state = stretched("shell", gradient)
    f = np.eye(3) + gradient
    strain = 0.5 * (f.T @ f - np.eye(3))[:2, :2]
    found = system.sense(state, part)
    plane = np.asarray(METAL.plane_stress())
    # Invariants: trace and determinant, whatever the axes of the elements are.
    own = np.asarray(found.strain)
    np.testing.assert_allclose(own[:, 0] + own[:, 1], np.trace(strain), atol=1e-12)
    np.testing.assert_allclose(own[:, 0] * own[:, 1] - own[:, 2] ** 2 / 4, np.linalg.det(strain), atol=1e-12)
    np.testing.assert_allclose(found.resultants, 0.02 * own @ plane, atol=1e-8)
    np.testing.assert_allclose(found.stress[:, 0], own @ plane, atol=1e-6)
    np.testing.assert_allclose(found.curvature, 0.0, atol=1e-12)
    assert float(found.energy.sum()) == pytest.approx(float(system.energy(state).total), rel=1e-12)


def test_stress_of_a_uniform_stretch_of_a_solid():
    """On a distorted mesh, exact: that of Cauchy."""
    gradient = np.array([(0.1, 0.05, 0), (0.0, -0.02, 0.03), (0.01, 0, 0.04)])
    system, part, state = stretched("solid", gradient)
    f = np.eye(3) + gradient
    strain = 0.5 * (f.T @ f - np.eye(3))
    first = METAL.E * METAL.nu / ((1 + METAL.nu) * (1 - 2 * METAL.nu))
    second = first * np.trace(strain) * np.eye(3) + 2 * METAL.shear_modulus * strain
    cauchy = f @ second @ f.T / np.linalg.det(f)
    found = system.sense(state, part)
    np.testing.assert_allclose(found.stress, np.broadcast_to(cauchy, found.stress.shape), rtol=1e-9)
    away = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    np.testing.assert_allclose(found.von_mises, np.sqrt(1.5 * np.sum(away**2)), rtol=1e-9)
    assert float(found.energy.sum()) == pytest.approx(float(system.energy(state).total), rel=1e-12)


def test_numbers_follow_those_that_are_set():
    """Stiffness and mass of a thickness, a modulus or a density, of all elements or of each."""
    scene, part = body("shell")
    system, _ = scene.compile()
    thick = system.set(part, thickness=0.04)
    np.testing.assert_allclose(thick.mass[:, 0, 0], 2 * system.mass[:, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(thick.mass[:, 1, 1], 8 * system.mass[:, 1, 1], rtol=1e-12)
    before, after = (np.asarray(s.get(part, "stiffness")) for s in (system, thick))
    np.testing.assert_allclose(after[:, :6, :6], 2 * before[:, :6, :6], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after[:, 6:12, 6:12], 8 * before[:, 6:12, 6:12], rtol=1e-9, atol=1e-9)
    harder = system.set(part, E=4e5)
    np.testing.assert_allclose(harder.get(part, "stiffness"), 2 * before, rtol=1e-12)
    np.testing.assert_allclose(harder.mass, system.mass, rtol=1e-12)
    own = system.set(part, thickness=jnp.linspace(0.01, 0.03, 12), density=1000.0)
    assert own.get(part, "material.density").tolist() == [1000.0] * 12
    with pytest.raises(ValueError, match=r"thickness has shape \(3,\)"):
        system.set(part, thickness=jnp.ones(3))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"thickness": -0.1}, "shell 'body': thickness is -0.1; pass positive"),
        ({"nu": 0.6}, "element 0 of shell 'body' has Poisson's ratio nu"),
        ({"E": -1.0}, "material.E is -1; pass positive"),
    ],
)
def test_impossible_numbers_are_not_set(numbers, message):
    scene, part = body("shell")
    with pytest.raises(ValueError, match=message):
        scene.compile()[0].set(part, **numbers)


@pytest.mark.slow
@pytest.mark.parametrize("number", ["thickness", "E", "density", "reference"])
def test_gradients_by_the_numbers_of_a_shell(number):
    """Of where it is after some steps, by what its stiffness and masses are made of; V-shaped."""
    scene, part = body("shell")
    scene.add(nc.Clamp(nc.ground, part.set("left")))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    tip = system.body_index(part.nearest((1.0, 0.5, 0.0)))
    given = system.get(part, number)

    def last(factor):
        changed = system.set(part, **{number: factor * given})
        return nc.simulate(changed, state, dt=5e-3, steps=10).q[-1, 4 * tip, 2]

    one, last = jnp.asarray(1.0), jax.jit(last)
    assert_v_shaped(last, one, one, jax.grad(last)(one))


def test_pressure_pushes_as_it_should():
    """On the end of a solid: its resultant, and along the axis of a column its shortening; on a ball none."""
    scene, part = body("solid")
    scene.add(nc.Clamp(nc.ground, part.set("x0")))
    scene.add(nc.Pressure(part.face("x1"), lambda t: 1.0 * t, name="push"))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, loads=1.0, steps=1).state
    shortened = [1.0 - float(system.sense(end, h).position[0]) for h in part.set("x1")]
    assert np.mean(shortened) == pytest.approx(1.0 / 2e5, rel=0.05)  # E of the material; the end is clamped
    scene = nc.Scene()
    ball = scene.add(nc.Shell(nc.mesh.sphere(0.1, 3), thickness=2e-3, material=METAL))
    scene.add(nc.Pressure(ball, lambda t: -500.0 * (t < 0.02), name="gas"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=40)
    found = nc.balance(system, trajectory)
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    work = np.asarray(system.work(trajectory)["gas"])
    assert work[20] > 1e-4 and np.ptp(work[20:]) == 0.0


def square(**given):
    return nc.Shell(nc.mesh.rectangle((1.0, 1.0), (2, 2)), **{"thickness": 0.1, "material": METAL, **given})


FOLDED = nc.mesh.Mesh(
    np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (1, 1, 1)]),
    [(0, 1, 2, 3), (1, 4, 5, 2)],
)
INSIDE_OUT = nc.mesh.Mesh(nc.mesh.box((1, 1, 1), (1, 1, 1)).nodes, [(1, 5, 7, 3, 0, 4, 6, 2)])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nc.Elastic(E=1.0, nu=0.5), "between -1 and 1/2"),
        (lambda: square(thickness=0.0), r"thickness \[m\].*positive"),
        (lambda: square(material=nc.Elastic(E=1.0)), r"density \[kg/m\^3\] of its material is zero"),
        (lambda: square(thickness=np.ones(3)), r"thickness \[m\] has shape \(3,\)"),
        (lambda: nc.Shell(FOLDED, thickness=0.1, material=METAL), "at node 1 the surface is folded"),
        (lambda: nc.Solid(FOLDED, material=METAL), "cells of 4 nodes; pass one with 8"),
        (lambda: nc.Solid(INSIDE_OUT, material=METAL, name="block"), "'block': element 0, .* inside out"),
        (lambda: nc.mesh.Mesh(np.eye(3), [(0, 1, 2, 3)]), "nodes from 0 to 3; there are 0 to 2"),
        (lambda: nc.mesh.Mesh(np.ones((5, 3)) * np.arange(5)[:, None], [(0, 1, 2, 3)]), r"\[4\] are in no"),
        (lambda: nc.mesh.Mesh(np.eye(4, 3) * 0.0, [(0, 1, 2, 3)]), "0 and 1 are at the same place"),
        (lambda: nc.mesh.rectangle((1.0, -1.0), (2, 2)), r"size \[m\].*positive"),
    ],
)
def test_wrong_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        scene = nc.Scene()
        scene.add(make())
        scene.compile()


def test_wrong_names_are_refused():
    scene, solid = body("solid")
    with pytest.raises(ValueError, match=r"'body' has no nodes 'left'; its mesh has \['x0', 'x1'"):
        solid.set("left")
    with pytest.raises(ValueError, match="'body' has no faces 'left'; its mesh has"):
        solid.face("left")
    scene, shell = body("shell")
    with pytest.raises(ValueError, match="its mesh has none by name"):
        shell.face("x1")
    with pytest.raises(ValueError, match="that is on one shell node|has a director only"):
        hub = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(1, 0, 0)))
        scene.add(nc.Fixed(hub, shell.nearest((1, 0, 0))))
        scene.compile()


# --- ties -------------------------------------------------------------------------------------------------


def bent(mesh, amplitude):
    """A mesh whose end faces along x are curved surfaces."""
    nodes = mesh.nodes.copy()
    nodes[:, 0] += amplitude * np.sin(3.0 * nodes[:, 1]) * np.cos(2.0 * nodes[:, 2])
    return nc.mesh.Mesh(nodes, mesh.cells, mesh.sets, mesh.faces)


def tied(amplitude=0.0, **moving):
    """Two blocks end to end, of meshes that do not match."""
    scene = nc.Scene()
    fine, coarse = (bent(nc.mesh.box((1.0, 0.8, 0.8), (2, n, n)), amplitude) for n in (3, 2))
    one = scene.add(nc.Solid(coarse, material=METAL, name="coarse"))
    spin = moving.get("angular_velocity", (0, 0, 0))
    two = scene.add(
        nc.Solid(
            fine,
            material=METAL,
            position=(1, 0, 0),
            velocity=np.cross(spin, (1, 0, 0)),
            name="fine",
            **moving,
        )
    )
    scene.add(nc.Tie(two.face("x0"), one.face("x1"), name="seam"))
    return scene, one, two


def test_a_uniform_stress_passes_a_tie():
    """Pulled at one end, held at the other, where its width is free: the same stress in all elements."""
    scene, one, two = tied()
    table = nc.Point(nc.ground), nc.Direction(nc.ground, (1, 0, 0))
    held = one.set("x0")
    for node in held:
        scene.add(nc.PointOnPlane((*table, nc.Point(node))))
    for node, normals in (
        (one.nearest((0, 0, 0)), [(0, 1, 0), (0, 0, 1)]),
        (one.nearest((0, 0, 0.8)), [(0, 1, 0)]),
    ):
        place = nc.Point(nc.ground, node_place(one, node))
        for normal in normals:
            scene.add(nc.PointOnPlane((place, nc.Direction(nc.ground, normal), nc.Point(node))))
    scene.add(nc.Pressure(two.face("x1"), lambda t: -1e3 * t))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=1).state
    stress = np.concatenate([system.sense(end, part).stress for part in (one, two)])
    np.testing.assert_allclose(stress[:, 0, 0], 1e3, rtol=1e-6)
    np.testing.assert_allclose(stress[:, 1:, 1:], 0.0, atol=1e-3)


def node_place(part, node):
    return np.asarray(part.nodes.positions)[int(node.name.split("[")[1][:-1])]


@pytest.mark.parametrize(
    "amplitude", [pytest.param(0.0, marks=pytest.mark.exhaustive), pytest.param(0.06, marks=pytest.mark.slow)]
)
def test_a_tie_in_motion(amplitude):
    """On flat and on curved surfaces energy, momentum and angular momentum are exact, and it stays closed."""
    scene, _, _ = tied(amplitude, angular_velocity=(0.5, 0.3, 2.0))
    system, state = scene.compile(assemble=True)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=300)
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert system.constraint_errors(trajectory).position.max() <= 1e-12
    stored = np.asarray(system.energy(trajectory).stores["fine"])
    assert stored.max() >= 1e-3 * float(system.energy(state).kinetic)


@pytest.mark.exhaustive
def test_statics_of_tied_meshes_by_the_sparse_plan(monkeypatch):
    """With multipliers, as the dense matrix has them; with gradients."""
    scene = nc.Scene()
    # Under the earth's gravity elements at the clamp would be turned inside out.
    scene.add(nc.Gravity(vector=(0.0, 0.0, -1.0)))
    one = scene.add(nc.Solid(nc.mesh.box((1.0, 0.8, 0.8), (3, 3, 3)), material=METAL))
    fine = nc.mesh.box((1.0, 0.8, 0.8), (3, 4, 4))
    two = scene.add(nc.Solid(fine, material=METAL, position=(1, 0, 0), name="fine"))
    scene.add(nc.Tie(two.face("x0"), one.face("x1")))
    scene.add(nc.Clamp(nc.ground, one.set("x0")))
    system, state = scene.compile()
    assert system.structure.solver == "sparse" and system.local_rates.count > static_equations.DENSE
    tip = system.body_index(two.nearest((2, 0, 0)))

    def height(E):
        return nc.equilibrium(system.set("fine", E=E), state, steps=2).state.q[4 * tip, 2]

    found, used = [], []
    plan = static_equations.factorised
    monkeypatch.setattr(static_equations, "factorised", lambda *given: used.append(1) or plan(*given))
    for most in (static_equations.DENSE, 10**6):
        monkeypatch.setattr(static_equations, "DENSE", most)
        jax.clear_caches()
        before = len(used)
        found.append(jnp.stack(jax.value_and_grad(height)(2e5)))
        assert (len(used) > before) == (most != 10**6), "not the way that was meant"
    np.testing.assert_allclose(*found, rtol=1e-9)


def test_ties_that_do_not_meet_are_refused():
    scene = nc.Scene()
    blocks = [scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), material=METAL, position=(x, 0, 0)))
              for x in (0, 1.25, 4)]  # fmt: skip
    with pytest.raises(ValueError, match="surfaces are 0.25 m apart at node"):
        scene.add(nc.Tie(blocks[1].face("x0"), blocks[0].face("x1")))
    with pytest.raises(ValueError, match="do not meet at node"):
        scene.add(nc.Tie(blocks[2].face("x0"), blocks[0].face("x1")))


def test_traced_numbers_go_in_by_set():
    """A scene with elements is compiled outside of traced functions, and says so."""

    def built(thickness):
        scene = nc.Scene()
        part = scene.add(square(thickness=thickness))
        scene.add(nc.Clamp(nc.ground, part.set("left")))
        return scene.compile()[1].q

    with pytest.raises(ValueError, match="outside of jit and grad, and pass what varies by system.set"):
        jax.jit(built)(0.1)


def test_a_clamped_node_is_refused_with_what_to_ask_instead():
    scene, rubber = nc.Scene(), nc.Elastic(E=1e6, nu=0.3, density=1000.0)
    block = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (1, 1, 1)), material=rubber, name="block"))
    scene.add(nc.Clamp(nc.ground, block.set("z0")))
    system, state = scene.compile()
    node = block.nearest((0, 0, 0))
    for asked in (node, nc.Point(node)):
        with pytest.raises(
            ValueError, match=r"'block nodes\[0\]' is clamped: it moves with what it is clamped"
        ):
            system.sense(state, asked)
    with pytest.raises(ValueError, match="cannot sense 'brick'") as refused:
        system.sense(state, "brick")
    assert "clamped" not in str(refused.value)


def test_the_report_counts_what_is_clamped_and_to_what():
    scene = nc.Scene()
    hand = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="hand"))
    mesh = nc.mesh.rectangle((1, 1), (2, 2))
    sheet = scene.add(nc.Shell(mesh, thickness=0.01, material=METAL, name="sheet"))
    scene.add(nc.PointMass(mass=1.0, name="bead"))
    assert "clamped           none" in scene.compile()[0].report()
    left = sheet.set("left")
    scene.add(nc.Clamp(nc.ground, left[:1]))
    scene.add(nc.Clamp(nc.ground, left[1:]))
    scene.add(nc.Clamp(hand, sheet.set("right")[:2]))
    said = scene.compile()[0].report().splitlines()
    assert "bodies            6 (6 free)" in said
    named = "3 of 9 nodes of 'sheet nodes' to 'ground', 2 of 9 nodes of 'sheet nodes' to 'hand'"
    assert f"clamped           {named}" in said
