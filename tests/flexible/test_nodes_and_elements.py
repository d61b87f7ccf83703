"""Nodes and elements in sets: handles, sets, nodes of one's own, one motion in all forms."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import place_of

import natcoord_jax as nc


def net(count, *, kind="points", solver=None):
    """A square net of threads, hung by a rod at one corner."""
    line = np.linspace(0.0, 1.0, count)
    places = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((count, count))], -1).reshape(-1, 3)
    number = np.arange(count**2).reshape(count, count)
    along = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    pairs = np.concatenate([np.stack([x.ravel() for x in pair], axis=1) for pair in along])
    scene, mass = nc.Scene(), 1.0 / count**2
    scene.add(nc.Gravity())
    if kind == "points":
        nodes = nc.Nodes.points(places, mass=mass, name="net")
    else:
        turning = {"inertia": 1e-3 * mass, "angular_velocity": (0.3, 0.2, 1.0)}
        nodes = nc.Nodes.directors(places, (0, 0, 1), mass=mass, name="net", **turning)
    mesh = scene.add(nodes)
    threads = {"stiffness": 200.0, "length": 1.0 / (count - 1), "name": "threads"}
    scene.add(nc.QuadraticSpring.on(mesh, pairs, **threads))
    scene.add(nc.Rod((nc.Point(nc.ground, (0, 0, 1)), nc.Point(mesh[0])), name="rod"))
    return *scene.compile(solver=solver), mesh


def places_of(trajectory):
    return np.asarray(trajectory.states.rows)[:, :, 0]


def test_handles_of_sets():
    system, state, mesh = net(3)
    assert len(mesh) == 9 and mesh[-1] == mesh[8] and mesh[4].name == "net[4]"
    edge = mesh.where(lambda x: x[:, 0] == 1.0)
    assert [h.name for h in edge] == ["net[6]", "net[7]", "net[8]"] and edge[1:][0] == mesh[7]
    assert [h.name for h in mesh[[4, 0]]] == ["net[4]", "net[0]"]
    np.testing.assert_allclose(edge.positions[:, 1], [0.0, 0.5, 1.0])
    np.testing.assert_allclose(system.sense(state, mesh[5]).position, (0.5, 1.0, 0.0))
    assert set(system.energy(state).stores) == {"gravity 1", "threads"}
    heavy = system.set("threads", stiffness=jnp.full(12, 300.0))
    assert heavy.get("threads", "stiffness").tolist() == [300.0] * 12


@pytest.mark.exhaustive
def test_elements_are_effects_added_one_by_one():
    """With numbers of their own, too."""
    places, stiffness = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0.5, 0)]), np.array([20.0, 50.0])
    scene, other = nc.Scene(), nc.Scene()
    mesh = scene.add(nc.Nodes.points(places, mass=(1.0, 2.0, 3.0)))
    scene.add(nc.Spring.on(mesh, [(0, 1), (1, 2)], each={"stiffness": stiffness}, length=0.8))
    masses = [other.add(nc.PointMass(mass=m, position=x)) for m, x in zip((1.0, 2.0, 3.0), places)]
    for k in range(2):
        ends = nc.Point(masses[k]), nc.Point(masses[k + 1])
        other.add(nc.Spring(ends, stiffness=stiffness[k], length=0.8))
    one, two = (places_of(nc.simulate(*s.compile(), dt=0.01, steps=50)) for s in (scene, other))
    np.testing.assert_allclose(one[-1], two[-1], atol=tol.SAME_TRAJECTORY)


@pytest.mark.exhaustive
def test_sets_of_constraints():
    """A chain of rods, as a set."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    places = np.linspace((0.0, 0, 0), (1, 0, 0), 4)
    mesh = scene.add(nc.Nodes.points(places, mass=1.0, name="chain"))
    scene.add(nc.Clamp(nc.ground, mesh[:1]))
    scene.add(nc.Rod.on(mesh, [(0, 1), (1, 2), (2, 3)], name="rods"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=30)
    assert system.structure.dofs == 6
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    ends = np.concatenate([np.zeros((31, 1, 3)), places_of(trajectory)], axis=1)
    lengths = np.linalg.norm(np.diff(ends, axis=1), axis=-1)
    np.testing.assert_allclose(lengths, 1 / 3, atol=tol.CONSTRAINT_OF_A_SMALL_SCENE)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["points", "directors"])
@pytest.mark.parametrize("order", [2, 4])
def test_nodes_move_alike_in_all_forms(kind, order):
    """One trajectory; energy, and the length of directors, to round-off."""
    motions, scheme = [], nc.EnergyMomentum(order=order)
    for solver in ("reduced", "full", "sparse"):
        system, state, _ = net(3, kind=kind, solver=solver)
        trajectory = nc.simulate(system, state, dt=0.01, steps=50, scheme=scheme)
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        rows = np.asarray(trajectory.states.rows)
        lengths = np.sum(rows[:, :, 1] ** 2, axis=-1)
        assert np.abs(lengths - 1).max() <= tol.CONSTRAINT_OF_A_SMALL_SCENE
        motions.append(rows[-1, :, :2])
    for other in motions[1:]:
        np.testing.assert_allclose(other, motions[0], atol=tol.SAME_TRAJECTORY)


def square(solver, make):
    """One shell element, and something that is made of a point inside it."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    places = [(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    mesh = scene.add(nc.Nodes.directors(places, (0, 0, 1), mass=1.0, inertia=0.01, name="mesh"))
    scene.add(nc.ShellElement.on(mesh, [(0, 1, 2, 3)], thickness=0.1, material=nc.Elastic(E=1e4, nu=0.3)))
    inside = nc.Point(mesh[[0, 1, 2, 3]], (0.1, 0.2, 0.3, 0.4))
    scene.add(make(inside))
    return *scene.compile(solver=solver), inside


ABOVE = nc.Point(nc.ground, (0.5, 0.7, 1.0))
INSIDE = {
    "pin": lambda x: nc.PointOnPoint((nc.Point(nc.ground, (0.5, 0.7, 0)), x), name="pin"),
    "spring": lambda x: nc.Spring((ABOVE, x), stiffness=50.0, length=1.0),
    "rod": lambda x: nc.Rod((ABOVE, x)),
    "force": lambda x: nc.PointForce((x,), force=(0, 0, 30.0)),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", INSIDE)
def test_points_inside_of_elements(name):
    """What takes a point takes one between nodes, in all forms."""
    motions = []
    for solver in ("reduced", "full", "sparse"):
        system, state, inside = square(solver, INSIDE[name])
        np.testing.assert_allclose(system.sense(state, inside).position, (0.5, 0.7, 0.0), atol=1e-15)
        trajectory = nc.simulate(system, state, dt=0.01, steps=30)
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        assert system.constraint_errors(trajectory).position.max() <= tol.CONSTRAINT_OF_A_SMALL_SCENE
        sensor = system.sense(trajectory, inside)
        motions.append(np.asarray(sensor.position))
        if name == "pin":
            assert np.abs(sensor.velocity).max() <= 1e-12
    for other in motions[1:]:
        np.testing.assert_allclose(other, motions[0], atol=tol.SAME_TRAJECTORY)


class HeldDirector(nc.Constraint):
    """A direction that two others stay normal to [-]; with a ball joint another clamp."""

    multipliers = 2

    def residual(self, x):
        return jnp.stack([x[0] @ x[2], x[1] @ x[2]])


ACROSS = nc.Direction(nc.ground, (1, 0, 0)), nc.Direction(nc.ground, (0, 1, 0))


@pytest.mark.exhaustive
def test_constraints_clamp_a_strip_as_a_clamp_does():
    """Bent by its end by two thirds of its length: 3.286 and 6.698 m, and on this mesh 3.2930 and 6.7047."""
    mesh, area, density, thickness = nc.mesh.rectangle((10.0, 1.0), (16, 1)), 10.0 / 16, 3.1314e-4, 0.1
    shares = np.bincount(mesh.cells.ravel()) * area / 4
    lumps = {"mass": density * thickness * shares, "inertia": density * thickness**3 / 12 * shares}
    scene = nc.Scene()
    nodes = scene.add(nc.Nodes.directors(mesh.nodes, (0, 0, 1), name="mesh", **lumps))
    scene.add(nc.ShellElement.on(nodes, mesh.cells, thickness=thickness, material=nc.Elastic(E=1.2e6)))
    for k in mesh.sets["left"]:
        node = nodes[int(k)]
        scene.add(nc.Spherical(nc.ground, node))
        scene.add(HeldDirector((*ACROSS, nc.Direction(node, (0, 0, 1)))))
    tip = [nodes[int(k)] for k in mesh.sets["right"]]
    for node in tip:
        scene.add(nc.PointForce((nc.Point(node),), force=(0, 0, 2.0)))
    system, state = scene.compile()
    end = place_of(system, nc.equilibrium(system, state).state, tip[0])
    np.testing.assert_allclose((10.0 - end[0], end[2]), (3.2930, 6.7047), atol=tol.FOUR_DIGITS)


@pytest.mark.exhaustive
def test_nodes_that_are_part_of_a_body():
    """They add their mass to it, and what they carry bends with it, on a hinge under gravity."""
    scene, spin = nc.Scene(), (0, 0, 3.0)
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25), angular_velocity=spin, name="hub"))
    places = np.array([(x, y, 0.1) for x in (0.2, 0.6, 1.0) for y in (-0.2, 0.2)])
    lumps = {"mass": 0.1, "inertia": 1e-3, "velocity": np.cross(spin, places)}
    wing = scene.add(nc.Nodes.directors(places, (0, 0, 1), name="wing", **lumps))
    soft = nc.Elastic(E=1e4, nu=0.3)
    cells = [(0, 2, 3, 1), (2, 4, 5, 3)]
    scene.add(nc.ShellElement.on(wing, cells, thickness=0.05, material=soft, name="skin"))
    scene.add(nc.Clamp(hub, wing.where(lambda x: x[:, 0] < 0.3)))
    scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1)))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    assert list(system.structure.bodies) == [f"wing[{k}]" for k in range(2, 6)] + ["hub"]
    assert float(system.get(hub, "mass")) == pytest.approx(1.2)
    trajectory = nc.simulate(system, state, dt=0.01, steps=100)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert np.asarray(system.energy(trajectory).stores["skin"]).max() > 1e-3


def test_the_report_counts_what_is_clamped_and_to_what():
    scene, metal = nc.Scene(), nc.Elastic(E=2e5, nu=0.3, density=1200.0)
    hand = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="hand"))
    mesh = nc.mesh.rectangle((1, 1), (2, 2))
    sheet = scene.add(nc.Shell(mesh, thickness=0.01, material=metal, name="sheet"))
    scene.add(nc.PointMass(mass=1.0, name="bead"))
    assert "clamped           none" in scene.compile()[0].report()
    side = sheet.set("left")
    scene.add(nc.Clamp(nc.ground, side[:1]))
    scene.add(nc.Clamp(nc.ground, side[1:]))
    scene.add(nc.Clamp(hand, sheet.set("right")[:2]))
    said = scene.compile()[0].report().splitlines()
    assert "bodies            6 (6 free)" in said
    named = "3 of 9 nodes of 'sheet nodes' to 'ground', 2 of 9 nodes of 'sheet nodes' to 'hand'"
    assert f"clamped           {named}" in said


# --- a kind of node of one's own ----------------------------------------------------------------------------

WHEEL = nc.NodeKind("wheel", turns=(2,), rows=4)
"""It moves, and turns about its third axis, which keeps its direction."""


def wheel(node, solver=None):
    motion: Any = {"com": (0.1, 0.2, 0.0), "velocity": (0.3, 0.0, 0.1), "angular_velocity": (0.0, 0.0, 2.0)}
    scene, body = nc.Scene(), nc.RigidBody(mass=2.0, inertia=(1.0, 2.0, 3.0), **motion)
    body = scene.add(dataclasses.replace(body, node=node or body.node))
    if node is None:
        scene.add(HeldDirector((*ACROSS, nc.Direction(body, (0, 0, 1)))))
    scene.add(nc.Spring((nc.Point(nc.ground, (1, 0, 0)), nc.Point(body, (0, 0.5, 0.1))), stiffness=10.0))
    return scene.compile(solver=solver)


WHEELS = [pytest.param(2, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.exhaustive)]


@pytest.mark.parametrize("order", WHEELS)
def test_a_kind_of_node_of_ones_own(order):
    """Four rates in all forms of the equations, and the motion of a body whose axis a constraint holds."""
    scheme, ends = nc.EnergyMomentum(order=order), []
    for solver in ("reduced", "recursive", "full", "sparse"):
        system, state = wheel(WHEEL, solver)
        assert (system.structure.unknowns, system.structure.dofs) == (4, 4)
        trajectory = nc.simulate(system, state, dt=0.05, steps=40, scheme=scheme)
        energy = system.energy(trajectory).total
        assert np.ptp(energy) < 1e-13 * energy[0]
        assert system.constraint_errors(trajectory).position.max() < 1e-14
        assert np.all(trajectory.q[:, 3] == jnp.array([0.0, 0.0, 1.0]))
        ends.append(trajectory.q[-1])
    np.testing.assert_allclose(ends[1:], [ends[0]] * 3, atol=1e-11)
    system, state = wheel(None)
    by_a_constraint = nc.simulate(system, state, dt=0.05 / 8, steps=320, scheme=scheme).q[-1]
    assert np.abs(by_a_constraint - ends[0]).max() < {2: 1e-2, 4: 2e-6}[order]
