"""Nodes and elements by the thousands, shells and solids: handles, statics, modes and conservation."""

import dataclasses
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.analysis import balance, static_equations
from natcoord_jax.build import build
from natcoord_jax.gallery import continua
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.viz.parts import scenery_of
from natcoord_jax.viz.skins import drawn_bodies


def net(count, *, kind="points", solver=None):
    """A square net of threads, hung by a rod at one corner."""
    line = np.linspace(0.0, 1.0, count)
    places = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((count, count))], -1).reshape(-1, 3)
    number = np.arange(count**2).reshape(count, count)
    along = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    pairs = np.concatenate([np.stack([x.ravel() for x in pair], axis=1) for pair in along])
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = 1.0 / count**2
    if kind == "points":
        nodes = nc.Nodes.points(places, mass=mass, name="net")
    else:
        turning = {"inertia": 1e-3 * mass, "angular_velocity": (0.3, 0.2, 1.0)}
        nodes = nc.Nodes.directors(places, (0, 0, 1), mass=mass, name="net", **turning)
    mesh = scene.add(nodes)
    length = 1.0 / (count - 1)
    scene.add(nc.QuadraticSpring.on(mesh, pairs, stiffness=200.0, length=length, name="threads"))
    scene.add(nc.Rod((nc.Point(nc.ground, (0, 0, 1)), nc.Point(mesh[0])), name="rod"))
    return *scene.compile(solver=solver), mesh


def rows_of(trajectory):
    return np.asarray(trajectory.q).reshape(len(trajectory), -1, 4, 3)


def test_handles_of_sets():
    system, state, mesh = net(3)
    assert len(mesh) == 9 and mesh[-1] == mesh[8] and mesh[4].name == "net[4]"
    edge = mesh.where(lambda x: x[:, 0] == 1.0)
    assert [h.name for h in edge] == ["net[6]", "net[7]", "net[8]"] and edge[1:][0] == mesh[7]
    assert [h.name for h in mesh[[4, 0]]] == ["net[4]", "net[0]"]
    np.testing.assert_allclose(edge.positions[:, 1], [0.0, 0.5, 1.0])
    assert system.body_index(mesh[5]) == 5 and list(system.structure.bodies)[5] == "net[5]"
    np.testing.assert_allclose(system.sense(state, mesh[5]).position, (0.5, 1.0, 0.0))
    assert set(system.energy(state).stores) == {"gravity 1", "threads"}
    heavy = system.set("threads", stiffness=jnp.full(12, 300.0))
    assert heavy.effects[-1].effect.stiffness.shape == (12,)
    for wrong in (9, -10):
        with pytest.raises(IndexError, match="there are 9"):
            mesh[wrong]


@pytest.mark.parametrize(
    ("connectivity", "options", "message"),
    [
        ([[0, 9]], {}, "has nodes from 0 to 9; .* has 0 to 8"),
        ([[0.5, 1.0]], {}, "must be whole numbers"),
        ([0, 1], {}, "must be whole numbers"),
        ([[0, 1], [1, 2]], {"each": {"stiffness": [1.0]}}, r"each\['stiffness'\] needs a leading axis of 2"),
        ([[0, 1, 2]], {"stiffness": 1.0}, "2 nc.Point, in a tuple"),
    ],
)
def test_wrong_elements_are_refused(connectivity, options, message):
    _, _, mesh = net(3)
    with pytest.raises((ValueError, TypeError), match=message):
        nc.QuadraticSpring.on(mesh, connectivity, length=1.0, **options)


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
    one, two = (nc.simulate(*s.compile(), dt=0.01, steps=50) for s in (scene, other))
    np.testing.assert_allclose(rows_of(one)[-1, :, 0], rows_of(two)[-1, :, 0], atol=tol.SAME_TRAJECTORY)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["points", "directors"])
@pytest.mark.parametrize("order", [2, 4])
def test_nodes_in_all_forms(kind, order):
    """One trajectory; energy, and the length of directors, to round-off."""
    found = []
    for solver in ("reduced", "full", "sparse"):
        system, state, _ = net(3, kind=kind, solver=solver)
        assert system.structure.unknowns == 9 * (3 if kind == "points" else 5)
        trajectory = nc.simulate(system, state, dt=0.01, steps=50, scheme=nc.EnergyMomentum(order=order))
        assert balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        found.append(rows_of(trajectory))
        lengths = np.sum(found[-1][:, :, 1] ** 2, axis=-1)
        assert np.abs(lengths - 1).max() <= tol.CONSTRAINT_OF_A_SMALL_SCENE
    for other in found[1:]:
        np.testing.assert_allclose(other[-1, :, :2], found[0][-1, :, :2], atol=tol.SAME_TRAJECTORY)


def test_gradients_through_nodes():
    system, state, _ = net(2, kind="directors")
    ahead = jnp.asarray(np.random.default_rng(0).normal(size=state.v.shape))
    moved = jnp.zeros(state.v.shape).at[::4].set(ahead[::4])

    def loss(speed):
        start = eqx.tree_at(lambda s: s.v, state, state.v + speed * moved)
        return jnp.sum(nc.simulate(system, start, dt=0.02, steps=10).q[-1] ** 2)

    at = jnp.asarray(0.3)
    slope = jax.jit(jax.grad(loss))(at)
    assert_v_shaped(jax.jit(loss), at, jnp.ones(()), slope)
    np.testing.assert_allclose(jax.jvp(loss, (at,), (jnp.ones(()),))[1], slope, rtol=tol.SAME_GRADIENT)


def square(solver=None, *, make):
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
    "spring": lambda x: nc.Spring((ABOVE, x), stiffness=50.0, length=1.0),
    "rod": lambda x: nc.Rod((ABOVE, x)),
    "pin": lambda x: nc.PointOnPoint((nc.Point(nc.ground, (0.5, 0.7, 0)), x), name="pin"),
    "force": lambda x: nc.PointForce((x,), force=(0, 0, 30.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["pin", *(pytest.param(x, marks=pytest.mark.slow) for x in INSIDE if x != "pin")]
)
def test_points_inside_of_elements(name):
    """What takes a point takes one between nodes, in all forms."""
    found = []
    for solver in ("reduced", "full", "sparse"):
        system, state, inside = square(solver, make=INSIDE[name])
        np.testing.assert_allclose(system.sense(state, inside).position, (0.5, 0.7, 0.0), atol=1e-15)
        trajectory = nc.simulate(system, state, dt=0.01, steps=30)
        assert balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        assert system.constraint_errors(trajectory).position.max() <= tol.CONSTRAINT_OF_A_SMALL_SCENE
        sensor = system.sense(trajectory, inside)
        found.append(np.asarray(sensor.position))
        if name == "pin":
            assert np.abs(sensor.velocity).max() <= 1e-12
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=tol.SAME_TRAJECTORY)


def test_a_torque_between_nodes_is_refused():
    """It would have acted on one of them."""
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.directors([(0.0, 0, 0), (1, 0, 0)], (0, 0, 1), mass=1.0, inertia=0.1))
    between = nc.Direction(mesh[[0, 1]], (0.5, 0.5))
    scene.add(nc.PairTorque((nc.Direction(nc.ground, (1, 0, 0)), between), torque=1.0))
    with pytest.raises(ValueError, match="between nodes is none"):
        nc.simulate(*scene.compile(), dt=0.1, steps=1)


def test_wrong_nodes_are_refused():
    places = [(0.0, 0, 0), (1, 0, 0)]
    with pytest.raises(ValueError, match=r"mass \[kg\] has shape \(3,\)"):
        nc.Nodes.points(places, mass=(1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match=r"mass \[kg\].*not negative"):
        nc.Nodes.points(places, mass=(1.0, -1.0))
    with pytest.raises(ValueError, match="some of the directors"):
        nc.Nodes.directors(places, [(0, 0, 1), (0, 0, 0)], mass=1.0)


def test_sets_of_constraints():
    """A chain of rods, as a set and one by one."""
    places = np.linspace((0.0, 0, 0), (1, 0, 0), 4)
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mesh = scene.add(nc.Nodes.points(places, mass=1.0, name="chain"))
    scene.add(nc.Clamp(nc.ground, mesh[:1]))
    scene.add(nc.Rod.on(mesh, [(0, 1), (1, 2), (2, 3)], name="rods"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=30)
    assert system.structure.dofs == 6
    assert balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    ends = np.concatenate([np.zeros((31, 1, 3)), rows_of(trajectory)[:, :, 0]], axis=1)
    lengths = np.linalg.norm(np.diff(ends, axis=1), axis=-1)
    np.testing.assert_allclose(lengths, 1 / 3, atol=tol.CONSTRAINT_OF_A_SMALL_SCENE)


def test_wrong_weights_are_refused():
    _, _, mesh = net(2)
    for weights, message in (
        ((0.5, 0.6), "add up to 1.1"),
        ((0.5, 0.2, 0.3), "pass 2 numbers for <2 nodes of 'net'>"),
        (None, "pass 2 numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            nc.Point(mesh[[0, 1]], weights)


def test_ten_thousand_nodes():
    """Added, and their structure compiled, in seconds; neither hash nor names grow."""
    begun = time.process_time()
    line = np.linspace(0.0, 1.0, 21)
    places = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(21**3).reshape(21, 21, 21)
    corners = [number[i : i + 20, j : j + 20, k : k + 20] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    bricks = np.stack(corners, axis=-1).reshape(-1, 8)[:, [0, 4, 6, 2, 1, 5, 7, 3]]
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.points(places, mass=1e-3, name="block"))
    scene.add(nc.Brick.on(mesh, bricks, material=nc.Elastic(E=1e5, nu=0.3), name="bricks"))
    added = time.process_time()
    system, _ = build(scene.bodies, scene.joints, scene.effects, "sparse", scene.nodes, scene.elements)
    built = time.process_time()
    assert system.structure.unknowns == 3 * 21**3 and system.effects[0].count == 8000
    assert added - begun < 2.0 and built - added < 10.0
    start = time.process_time()
    for _ in range(100):
        hash(system.structure)
    assert time.process_time() - start < 0.1
    assert (
        len(repr(system.structure)) < 2000 + sum(len(str(x)) for x in system.structure.shapes[:1]) * 21**3 * 3
    )


class HeldDirector(nc.Constraint):
    """A direction that two others stay normal to [-]; with a ball joint another clamp."""

    multipliers = 2

    def residual(self, x):
        return jnp.stack([x[0] @ x[2], x[1] @ x[2]])


def cantilever(elements, force=0.0, clamp=True):
    """A strip of 10 m by 1 m, 0.1 m thick, clamped, with a force at its end (Sze et al. 2004)."""
    along = np.repeat(np.linspace(0.0, 10.0, elements + 1), 2)
    places = np.stack([along, np.tile([0.0, 1.0], elements + 1)], axis=1)
    places = np.pad(places, ((0, 0), (0, 1)))
    number = np.arange(len(places)).reshape(-1, 2)
    quads = np.stack([number[:-1, 0], number[1:, 0], number[1:, 1], number[:-1, 1]], axis=1)
    area = np.bincount(quads.ravel()) * 10.0 / elements / 4
    density, thickness = 3.1314e-4, 0.1
    lumps = {"mass": density * thickness * area, "inertia": density * thickness**3 / 12 * area}
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.directors(places, (0, 0, 1), name="mesh", **lumps))
    scene.add(
        nc.ShellElement.on(mesh, quads, thickness=thickness, material=nc.Elastic(E=1.2e6), name="strip")
    )
    edge = mesh.where(lambda x: x[:, 0] == 0.0)
    held = nc.Direction(nc.ground, (1, 0, 0)), nc.Direction(nc.ground, (0, 1, 0))
    if clamp:
        scene.add(nc.Clamp(nc.ground, edge))
    for node in () if clamp else edge:
        scene.add(nc.Spherical(nc.ground, node))
        scene.add(HeldDirector((*held, nc.Direction(node, (0, 0, 1)))))
    tip = mesh.where(lambda x: x[:, 0] == 10.0)
    for node in tip if force else ():
        scene.add(nc.PointForce((nc.Point(node),), force=(0, 0, 0.5 * force)))
    return *scene.compile(), tip


@pytest.mark.slow
@pytest.mark.parametrize("clamp", [True, False])
def test_cantilever_of_shells(clamp):
    """Bent by its end by two thirds of its length: 3.286 and 6.698 m, and on this mesh 3.2930 and 6.7047."""
    system, state, tip = cantilever(16, force=4.0, clamp=clamp)
    end = nc.equilibrium(system, state).state.q.reshape(-1, 4, 3)[system.body_index(tip[0]), 0]
    np.testing.assert_allclose((10.0 - end[0], end[2]), (3.2930, 6.7047), atol=1e-4)


@pytest.mark.slow
def test_frequency_of_shells():
    """10 Hz by the theory of beams; 9.958 Hz on eight elements with lumped masses."""
    system, state, _ = cantilever(8)
    lowest = nc.modes(system, state, count=1).frequencies[0] / (2 * np.pi)
    np.testing.assert_allclose(lowest, 9.958, atol=5e-4)


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


def test_an_element_of_ones_own_on_the_base_of_another():
    """Numbers that follow from the pose are there for its methods: it bends half as far."""
    mesh, sags = nc.mesh.rectangle((1.0, 0.5), (3, 1)), []
    for element in (nc.ShellElement, StiffShell):
        scene = nc.Scene()
        nodes = scene.add(nc.Nodes.directors(mesh.nodes, (0, 0, 1.0)))
        metal = nc.Elastic(E=2e9, nu=0.3, density=1000.0)
        scene.add(element.on(nodes, mesh.cells, thickness=0.02, material=metal))
        scene.add(nc.Clamp(nc.ground, nodes.where(lambda x: x[:, 0] < x[:, 0].min() + 1e-9)))
        scene.add(nc.PointForce((nc.Point(nodes[3]),), force=(0, 0, 1e-4)))
        system, state = scene.compile()
        end = nc.equilibrium(system, state).state
        sags.append(float(np.abs(np.asarray(end.q - state.q)[:, 2]).max()))
    assert sags[0] == pytest.approx(2.0 * sags[1], rel=1e-6)


@pytest.mark.parametrize(
    "analysis",
    [pytest.param("statics", marks=pytest.mark.slow), pytest.param("path", marks=pytest.mark.exhaustive)],
)
def test_large_statics_are_solved_by_the_sparse_plan(analysis, monkeypatch):
    """As the dense matrix does, with gradients."""
    system, state, tip = cantilever(42, force=2.0)
    assert system.local_rates.count > static_equations.DENSE

    def tip_height(stiffness):
        stiffer = system.set("strip", stiffness=stiffness * system.get("strip", "stiffness"))
        if analysis == "path":
            end = nc.load_path(stiffer, state, arc=0.05, steps=3).state
        else:
            end = nc.equilibrium(stiffer, state).state
        return end.q.reshape(-1, 4, 3)[system.body_index(tip[0]), 0, 2]

    found, used = [], []
    plan = static_equations.factorised
    monkeypatch.setattr(static_equations, "factorised", lambda *given: used.append(1) or plan(*given))
    for most in (static_equations.DENSE, 10**6):
        monkeypatch.setattr(static_equations, "DENSE", most)
        jax.clear_caches()
        before = len(used)
        found.append(jnp.stack(jax.value_and_grad(tip_height)(jnp.asarray(1.0))))
        assert (len(used) > before) == (most != 10**6), "not the way that was meant"
    assert found[0][0] > 0.1
    np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda: winged()[:2], lambda: _continuum("plate"), lambda: _continuum("block")]
)
def test_tangents_in_formulas_are_exact(make):
    """An energy that is quadratic in its invariants has forces that are linear in their steps."""
    system, state = make()
    random = np.random.default_rng(1)
    h, no_inputs = jnp.asarray(0.01), jnp.zeros(0)
    step = FullStep.prepare(system, state, no_inputs, h, gauss(1), NOTHING)
    y = step.guess() + 3.0 * random.normal(size=step.unknowns)
    exact, formulas = (step.matrices(y, choice) for choice in (True, False))
    for one, other in zip(exact, formulas):
        np.testing.assert_allclose(other, one, atol=1e-11 * float(jnp.abs(one).max()))
    group = next(g for g in system.effects if g.effect.elastic)
    assert group.turning == bool(system.structure.directors)


def _continuum(name):
    example = {"plate": continua.flying_plate, "block": continua.tumbling_block}[name](
        (2,) * (2 + (name == "block"))
    )
    return example.system, example.state


def winged(*, free=True):
    """A shell whose edge is part of a hub, which spins in space or hangs on a hinge."""
    scene = nc.Scene()
    hub = scene.add(
        nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25), angular_velocity=(0, 0, 3.0), name="hub")
    )
    places = np.array([(x, y, 0.1) for x in (0.2, 0.6, 1.0) for y in (-0.2, 0.2)])
    lumps = {"mass": 0.1, "inertia": 1e-3, "velocity": np.cross((0, 0, 3.0), places)}
    wing = scene.add(nc.Nodes.directors(places, (0, 0, 1), name="wing", **lumps))
    soft = nc.Elastic(E=1e4, nu=0.3)
    scene.add(nc.ShellElement.on(wing, [(0, 2, 3, 1), (2, 4, 5, 3)], thickness=0.05, material=soft))
    scene.add(nc.Clamp(hub, wing.where(lambda x: x[:, 0] < 0.3)))
    if not free:
        scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1)))
        scene.add(nc.Gravity())
    return *scene.compile(), hub, wing


@pytest.mark.parametrize("free", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_nodes_that_are_part_of_a_body(free):
    """They add their mass to it, and what they carry bends with it; nothing is lost."""
    system, state, hub, wing = winged(free=free)
    assert list(system.structure.bodies) == [f"wing[{k}]" for k in range(2, 6)] + ["hub"]
    assert float(system.mass[system.body_index(hub), 0, 0]) == pytest.approx(1.2)
    trajectory = nc.simulate(system, state, dt=0.01, steps=100)
    found = balance(system, trajectory)
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    if free:
        assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
        assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    stored = np.asarray(next(iter(system.energy(trajectory).stores.values())))
    assert stored.max() > 1e-3


def test_wrong_clamps_are_refused():
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.points(np.eye(3), mass=1.0, name="mesh"))
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="hub"))
    mass = scene.add(nc.PointMass(mass=1.0, name="mass"))
    scene.add(nc.Clamp(hub, mesh[:1]))
    for body, nodes, message in (
        (hub, mesh[:2], r"node 'mesh\[0\]' is clamped already"),
        (mass, mesh[1:], "'mass' has no orientation; pass a rigid body"),
        (mesh[2], mesh[1:2], "has no orientation"),
    ):
        with pytest.raises(ValueError, match=message):
            scene.add(nc.Clamp(body, nodes))
    scene.add(nc.Spherical(mesh[0], hub))
    with pytest.raises(ValueError, match=r"node 'mesh\[0\]' is clamped to 'hub'; join that"):
        scene.compile()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flying_plate", "tumbling_block"])
def test_continua_keep_what_they_should(name):
    """Energy, momentum and angular momentum over 1000 steps, with a good part of the energy stored."""
    example = gallery.load(name)
    trajectory = example.simulate()
    found = balance(example.system, trajectory)
    assert found.energy.max() <= tol.MOMENTUM
    assert found.momentum.max() <= tol.MOMENTUM and found.angular_momentum.max() <= tol.ANGULAR_MOMENTUM
    energy = example.system.energy(trajectory)
    (stored,) = (np.asarray(store) for store in energy.stores.values())
    assert stored.max() - stored.min() >= 0.2 * float(energy.total[0])
    assert np.abs(np.sum(rows_of(trajectory)[:, :, 1] ** 2, axis=-1) - 1).max() <= tol.CONSTRAINT


def test_what_a_node_does_not_carry_is_refused():
    """Directions of points, others than the director, and joints that need axes."""
    places = [(0.0, 0, 0), (1, 0, 0)]
    ends, up = (nc.Point(nc.ground, (0, 0, 1)), nc.Point(nc.ground)), nc.Direction(nc.ground, (0, 0, 1))
    point, director = r"'points\[0\]' is a point and carries itself only", r"'shell\[0\]' is a director"
    for make, message in (
        (lambda p, d: nc.PairTorque((up, nc.Direction(p, (1, 0, 0))), torque=1.0), point),
        (lambda p, d: nc.Spring((ends[0], nc.Point(p, (0, 0, 0.5))), stiffness=1.0), point),
        (lambda p, d: nc.PairTorque((up, nc.Direction(d, (1, 0, 0))), torque=1.0), director),
        (lambda p, d: nc.Revolute(nc.ground, d, name="hinge"), "joint 'hinge': .* has a director only"),
        (lambda p, d: nc.Fixed(nc.ground, d, name="weld"), "joint 'weld': .* has a director only"),
    ):
        scene = nc.Scene()
        points = scene.add(nc.Nodes.points(places, mass=1.0, name="points"))
        shell = scene.add(nc.Nodes.directors(places, (0, 0, 1), mass=1.0, inertia=0.1, name="shell"))
        scene.add(make(points[0], shell[0]))
        with pytest.raises(ValueError, match=message):
            scene.compile()
    scene = nc.Scene()
    shell = scene.add(nc.Nodes.directors(places, (0, 0, 1), mass=1.0, inertia=0.1))
    scene.add(nc.Spring((ends[0], nc.Point(shell[0], (0, 0, 0.5))), stiffness=1.0))
    scene.add(nc.Spherical(nc.ground, shell[1]))
    assert scene.compile()[0].structure.dofs == 7


def test_pictures_show_surfaces():
    """Of a plate all its faces, of a block those outside; nodes are no bodies to be drawn."""
    for name, counts, faces in (("flying_plate", (3, 2), 6), ("tumbling_block", (2, 2, 2), 24)):
        example = gallery.load(name, counts=counts)
        drawn = scenery_of(example.system, example.simulate(steps=1), np.array([0, 1]), colour="energy")
        (skin,) = drawn.skins
        assert skin.faces.shape == (faces, 4) and skin.points.shape[0] == 2
        assert skin.values.shape == (2, faces) and not drawn_bodies(example.system)


WHEEL = nc.NodeKind("wheel", turns=(2,), rows=4)
"""A node of one's own: it moves, and turns about its third axis, which keeps its direction."""


def _wheel(node, solver=None):
    motion: Any = {"com": (0.1, 0.2, 0.0), "velocity": (0.3, 0.0, 0.1), "angular_velocity": (0.0, 0.0, 2.0)}
    scene, body = nc.Scene(), nc.RigidBody(mass=2.0, inertia=(1.0, 2.0, 3.0), **motion)
    body = scene.add(dataclasses.replace(body, node=node or body.node))
    held = nc.Direction(nc.ground, (1, 0, 0)), nc.Direction(nc.ground, (0, 1, 0))
    if node is None:
        scene.add(HeldDirector((*held, nc.Direction(body, (0, 0, 1)))))
    scene.add(nc.Spring((nc.Point(nc.ground, (1, 0, 0)), nc.Point(body, (0, 0.5, 0.1))), stiffness=10.0))
    return scene.compile(solver=solver)


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_kind_of_node_of_ones_own(order):
    """Four rates in all forms of the equations, and the motion of a body whose axis a constraint holds."""
    scheme, ends = nc.EnergyMomentum(order=order), []
    for solver in ("reduced", "recursive", "full", "sparse"):
        system, state = _wheel(WHEEL, solver)
        assert (system.structure.unknowns, system.structure.dofs) == (4, 4)
        trajectory = nc.simulate(system, state, dt=0.05, steps=40, scheme=scheme)
        energy = system.energy(trajectory).total
        assert np.ptp(energy) < 1e-13 * energy[0]
        assert system.constraint_errors(trajectory).position.max() < 1e-14
        assert np.all(trajectory.q[:, 3] == jnp.array([0.0, 0.0, 1.0]))
        ends.append(trajectory.q[-1])
    np.testing.assert_allclose(ends[1:], [ends[0]] * 3, atol=1e-11)
    system, state = _wheel(None)
    held = nc.simulate(system, state, dt=0.05 / 8, steps=320, scheme=scheme).q[-1]
    assert np.abs(held - ends[0]).max() < {2: 1e-2, 4: 2e-6}[order]


@pytest.mark.parametrize("given", [{"turns": (2, 0)}, {"turns": (3,)}, {"rows": 0}])
def test_wrong_kinds_of_nodes_are_refused(given):
    with pytest.raises(ValueError, match="'wheel': a node turns"):
        nc.NodeKind("wheel", **({"turns": (2,), "rows": 4} | given))
