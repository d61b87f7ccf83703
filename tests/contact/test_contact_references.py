"""Contact against published and exact values: bars, spheres, tops, chains, cables."""

import numpy as np
import pytest
import tolerances as tol
from contact_scenes import FLOOR

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.gallery.racket import add_ball


@pytest.mark.slow
def test_bouncing_ball_on_a_spring():
    """K08 of the reference cases: 0.5 s of bounces, exact by pieces; order two through six changes."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = nc.RigidBody(
        mass=0.25, inertia=(2.5e-4,) * 3, shape=nc.Sphere(0.05), position=(0, 0, 0.06), velocity=(0, 0, -1.0)
    )
    ball = scene.add(ball)
    scene.add(nc.Contact(ball, FLOOR, stiffness=2e4))
    system, state = scene.compile()
    errors = []
    for h in (2e-4, 5e-5):
        trajectory = nc.simulate(system, state, dt=h, steps=round(0.5 / h), save_every=round(0.5 / h))
        errors.append(float(trajectory.q[-1, 0, 2]) - 0.060939776065215126)
        energy = np.asarray(system.energy(trajectory).total)
        assert abs(energy[-1] / energy[0] - 1) <= 1e-12
    assert abs(errors[0]) <= 1e-5 and abs(errors[1]) <= 7e-7
    assert abs((16 * errors[1] - errors[0]) / 15) <= 1e-7


def bar(scene, elements, *, length, area, modulus, density, start, velocity, name):
    """A bar as points and springs along z; its nodes and the stiffness of a spring."""
    mass = np.full(elements + 1, density * area * length / elements)
    mass[[0, -1]] *= 0.5
    places = np.linspace((0, 0, start), (0, 0, start + length), elements + 1)
    nodes = scene.add(nc.Nodes.points(places, mass=mass, velocity=(0, 0, velocity), name=name))
    stiffness = modulus * area * elements / length
    pairs = np.stack([np.arange(elements), np.arange(1, elements + 1)], axis=1)
    scene.add(nc.Spring.on(nodes, pairs, stiffness=stiffness, length=length / elements))
    return nodes, stiffness


@pytest.mark.exhaustive
def test_bars_exchange_their_velocities():
    """K05: two equal bars of 20 elements (code_aster SDNL111); all momentum goes over within 2 L / c."""
    numbers = {"length": 1.0, "area": 4e-4, "modulus": 2e11, "density": 7800.0}
    speed, scene = np.sqrt(2e11 / 7800), nc.Scene()
    h = 1.0 / 20 / speed
    one, stiffness = bar(scene, 20, start=0.0, velocity=1.0, name="one", **numbers)
    two, _ = bar(scene, 20, start=1.0 + 0.3 * h, velocity=0.0, name="two", **numbers)

    class Ends(nc.Gap):
        """The distance along the bars, which has a sign."""

        markers, degree = nc.SphereOnPlane.markers, 1

        def invariants(self, x):
            return (x[1] @ (x[2] - x[0]))[None]

        def distance(self, invariants):
            return invariants[0]

    markers = nc.Point(one[20]), nc.Direction(nc.ground, (0, 0, 1)), nc.Point(two[0])
    scene.add(nc.GapPotential(markers, Ends(), stiffness=stiffness, name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=round(7.5e-4 / h))
    # (Places of the size of 1 m are rounded by 1e-16 m, which springs of 1.6e9 N/m show.)
    assert nc.balance(system, trajectory).energy.max() <= 2e-11
    v = np.asarray(trajectory.v).reshape(len(trajectory), -1, 4, 3)[:, :, 0, 2]
    weights = np.ones(21)
    weights[[0, -1]] = 0.5
    first, second = (v[:, k : k + 21] @ weights / 20 for k in (0, 21))
    np.testing.assert_allclose(first + second, 1.0, atol=1e-12)
    # What is left behind is vibration, less of it the more elements there are.
    assert second[-1] == pytest.approx(1.0, abs=0.025)
    t = np.asarray(trajectory.t)
    lasts = t[np.argmax(second > 0.99 * second[-1])] - t[np.argmax(second > 0.01)]
    assert lasts == pytest.approx(2 / speed, rel=0.05)


@pytest.mark.exhaustive
def test_bar_on_a_wall():
    """K04 (code_aster SDNV100): rebound, force and duration of a bar that hits a wall at 100 m/s."""
    modulus = 2e11 * 0.7 / 1.3 / 0.4
    speed, scene = np.sqrt(modulus / 8000), nc.Scene()
    h = 0.2 / 40 / speed
    numbers = {"length": 0.2, "area": 4e-4, "modulus": modulus, "density": 8000.0}
    nodes, stiffness = bar(scene, 40, start=0.002, velocity=-100.0, name="bar", **numbers)
    wall = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1)), nc.Point(nodes[0])
    scene.add(nc.GapPotential(wall, nc.SphereOnPlane(radius=0.0), stiffness=stiffness, name="wall"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=round(1.4e-4 / h))
    assert nc.balance(system, trajectory).energy.max() <= 2e-11
    momentum, t = np.asarray(system.momentum(trajectory))[:, 2], np.asarray(trajectory.t)
    mean = momentum / momentum[0] * -100.0
    assert mean[-1] == pytest.approx(100.0, abs=2.0)
    assert t[np.argmax(mean > 0.99 * mean[-1])] - t[np.argmax(mean > -99.0)] == pytest.approx(
        6.8951e-5, rel=0.05
    )
    force = nc.contacts(system, trajectory).force[:, 0]
    np.testing.assert_allclose(force.sum() * h, momentum[-1] - momentum[0], rtol=1e-9)
    steady = force[(t[1:] > 3e-5) & (t[1:] < 8e-5)]
    assert steady.mean() == pytest.approx(1.85638e6, rel=0.02)
    assert np.abs(steady / 1.85638e6 - 1).max() <= 0.12


@pytest.mark.slow
def test_hertz_impact():
    """Two spheres of steel: approach, force and time of the exact solution; the pressure is that of Hertz."""
    radius, modulus, density, speed = 0.05, 2.1e11 / (1 - 0.3**2) / 2, 7800.0, 0.5
    half = radius / 2
    mass = density * 4 / 3 * np.pi * radius**3 / 2
    stiffness = 4 / 3 * modulus * np.sqrt(half)
    scene = nc.Scene()
    numbers = {"shape": nc.Sphere(radius), "density": density}
    one = scene.add(nc.RigidBody(**numbers, position=(-radius - 1e-7, 0, 0), velocity=(speed / 2, 0, 0)))
    two = scene.add(nc.RigidBody(**numbers, position=(radius + 1e-7, 0, 0), velocity=(-speed / 2, 0, 0)))
    scene.add(nc.Contact(one, two, stiffness=stiffness, law="hertz", name="impact"))
    system, state = scene.compile()
    approach = (1.25 * mass * speed**2 / stiffness) ** 0.4
    duration = 2.9432 * approach / speed
    trajectory = nc.simulate(system, state, dt=duration / 100, steps=130)
    felt = system.sense(trajectory, "impact")
    deepest, force = -float(felt.gap.min()), float(felt.force.max())
    assert deepest == pytest.approx(approach, rel=2e-3)
    lasts = np.ptp(np.asarray(trajectory.t)[np.asarray(felt.gap) < 0]) + duration / 100
    assert lasts == pytest.approx(duration, rel=0.02)
    # p_0 = 3 F / (2 pi a^2), a^2 = R d (K. L. Johnson, Contact Mechanics, 1985, equations (4.22) to (4.24)).
    pressure = 1.5 * force / (np.pi * half * deepest)
    assert pressure == pytest.approx((6 * force * modulus**2 / (np.pi**3 * half**2)) ** (1 / 3), rel=0.02)
    assert nc.contacts(system, trajectory).steps_in_contact[0] == pytest.approx(100, abs=2)


@pytest.mark.exhaustive
def test_pendulum_that_rubs_on_a_table():
    """R23: a mass on a rod of 0.4 m slides round on a table, always as far away; it stops where it should."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0.4, 0, 0), velocity=(0, 2.0, 0), name="mass"))
    scene.add(nc.Rod((nc.Point(nc.ground), nc.Point(mass, (0.4, 0, 0))), length=0.4))
    scene.add(nc.Contact(mass, FLOOR, restitution=0.0, friction=0.3))
    system, state = scene.compile()
    for h, stop in ((0.01, 1e-4), (0.002, 5e-6)):
        trajectory = nc.simulate(system, state, dt=h, steps=nc.Steps(round(1.0 / h), 500))
        place = np.asarray(trajectory.q)[:, 0]
        assert np.abs(np.linalg.norm(place, axis=1) - 0.4).max() <= 1e-14
        turned = np.unwrap(np.arctan2(place[:, 1], place[:, 0]))[-1]
        assert abs(0.4 * turned - 4 / (2 * 0.3 * 9.81)) <= stop
        energy = np.asarray(system.energy(trajectory).total)
        assert np.diff(energy).max() <= 1e-13 * energy[0]


@pytest.mark.exhaustive
def test_top_on_a_table_with_friction():
    """A top with a round end rises, and friction leaves Jellett's integral alone, to order two at least."""
    radius, below, inertia = 0.02, 0.004, np.diag([2.4e-6, 2.4e-6, 2.8e-6])
    drifts = []
    scene = nc.Scene()
    scene.add(nc.Gravity())
    top = nc.RigidBody(
        mass=0.015,
        inertia=inertia,
        com=(0, 0, -below),
        position=(0, 0, radius),
        orientation=((1, 0, 0), 0.1),
        angular_velocity=(0, 0, 100.0),
        name="top",
    )
    top = scene.add(top)
    markers = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1)), nc.Point(top, local=True)
    gap = nc.SphereOnPlane(radius=radius)
    scene.add(nc.GapConstraint(markers, gap, restitution=0.0, friction=0.3, name="table"))
    system, state = scene.compile()
    for h in (2e-3, 1e-3):
        trajectory = nc.simulate(system, state, dt=h, steps=round(1.0 / h))
        at = system.sense(trajectory, top)
        axes, spin = np.asarray(at.rotation), np.asarray(at.angular_velocity)
        momentum = np.einsum("tij,jk,tlk,tl->ti", axes, inertia, axes, spin)
        foot = np.asarray(at.position) - (0, 0, radius)
        integral = np.sum(momentum * (foot - np.asarray(at.com)), axis=1)
        drifts.append(np.abs(integral / integral[0] - 1).max())
        energy = np.asarray(system.energy(trajectory).total)
        assert np.diff(energy).max() <= 1e-13 * energy[0]
        assert energy[-1] < energy[0]
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert axes[-1, 2, 2] > axes[0, 2, 2] + 1e-3
    assert drifts[1] <= 2e-6 and drifts[0] >= 4 * drifts[1]


def chain_on_a_drum(links=20, length=0.1, radius=0.3, thick=0.02, longer=2):
    """Links over a drum, more of them on one side; names of contacts, of the first and the last link."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    shape = nc.Capsule(radius=radius, length=1.0)
    drum = scene.add(nc.RigidBody(shape=shape, density=1000.0, orientation=((1, 0, 0), np.pi / 2)))
    scene.add(nc.Fixed(nc.ground, drum))
    # Links that are on the drum touch it with their middles.
    far = np.hypot(radius + thick, length / 2) * 1.0001
    turn = 2 * np.arcsin(length / 2 / far)
    over = int(np.pi // turn) + 1
    angles = np.pi / 2 + (over / 2 - np.arange(over + 1)) * turn
    pins = [far * np.array([np.cos(a), 0, np.sin(a)]) for a in angles]
    below = length * np.array([0, 0, 1.0])
    first = (links - over) // 2 + longer
    pins = [pins[0] - k * below for k in range(first, 0, -1)] + pins
    pins += [pins[-1] - k * below for k in range(1, links - over - first + 1)]
    before, names = None, []
    for k, (start, end) in enumerate(zip(pins, pins[1:])):
        along = (end - start) / length
        tilt = (0, 1, 0), np.arctan2(along[0], along[2])
        body = {"position": (start + end) / 2, "orientation": tilt, "name": f"link {k}"}
        link = scene.add(nc.RigidBody(shape=nc.Capsule(radius=thick, length=length), density=500.0, **body))
        if before is not None:
            scene.add(nc.Revolute(before, link, point=start, axis=(0, 1, 0)))
        names.append(f"rubs {k}")
        scene.add(nc.Contact(drum, link, restitution=0.0, friction=0.5, name=names[-1]))
        before = link
    return *scene.compile(), names, ("link 0", f"link {links - 1}")


@pytest.mark.exhaustive
def test_chain_on_a_drum():
    """Twenty links: friction holds more of them on one side than on the other; with little they slip off."""
    system, state, names, ends = chain_on_a_drum()
    for friction, holds in ((0.5, True), (0.02, False)):
        run = system.set(names, friction=friction)
        trajectory = nc.simulate(run, state, dt=5e-3, steps=100)
        energy = np.asarray(run.energy(trajectory).total)
        assert np.diff(energy).max() <= 1e-12 * np.abs(energy).max()
        assert nc.balance(run, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        moved = [np.ptp(np.asarray(run.sense(trajectory, end).position), axis=0)[2] for end in ends]
        assert max(moved) <= 5e-3 if holds else min(moved) >= 0.05
        assert nc.contacts(run, trajectory).gap.min() >= -1e-9


def pressed(**options):
    """K07: a block of 2 x 2 on one of 3 x 3 elements, pressed on it; error of stresses over the pressure."""
    scene, material = nc.Scene(), nc.Elastic(E=1e5, nu=0.0, density=1.0)
    low = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (3, 3, 1)), material=material, name="low"))
    up = nc.Solid(nc.mesh.box((1, 1, 0.5), (2, 2, 1)), material=material, position=(0, 0, 0.5), name="up")
    up = scene.add(up)
    scene.add(nc.Clamp(nc.ground, low.set("z0")))
    # It must not slide; nothing of its load is along these.
    for k, axis in ((0, 0), (0, 1), (-1, 0)):
        node, place = up.set("z1")[k], up.set("z1").positions[k]
        plane = nc.Point(nc.ground, place), nc.Direction(nc.ground, np.eye(3)[axis])
        scene.add(nc.PointOnPlane((*plane, nc.Point(node, place))))
    scene.add(nc.Pressure(up.face("z1"), pressure=1e4))
    scene.add(nc.Contact(up.face("z0"), low.face("z1"), name="contact", **options))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=1).state
    end = nc.equilibrium(system, end, steps=1).state
    exact = np.diag([0.0, 0.0, -1e4])
    off = [np.abs(np.asarray(system.sense(end, part.name).stress) - exact).max() / 1e4 for part in (low, up)]
    return max(off)


@pytest.mark.exhaustive
def test_patch_of_blocks_by_mortar():
    """A uniform pressure passes exactly."""
    assert pressed(method="mortar", stiffness=1e7) <= 1e-12


@pytest.mark.exhaustive
def test_patch_of_blocks_by_nodes():
    """All of a pressure is handed on, but not evenly: stresses are off by hundredths of it."""
    assert 1e-3 < pressed(stiffness=1e8) <= 0.05


@pytest.mark.exhaustive
def test_cable_falls_on_a_floor_and_on_itself():
    """Self-contact of a beam: it coils, energy is exact, and nowhere do its segments pass each other."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.CircularSection(radius=0.02, E=2e5, density=1000.0)
    curve = [(0, 0, 0.05), (0.02, 0.01, 1.05)]
    cable = scene.add(nc.Beam(section, curve, elements=14, name="cable"))
    scene.add(nc.Contact(cable, FLOOR, stiffness=2e3, name="floor"))
    scene.add(nc.Contact(cable, cable, stiffness=2e3, self_contact=True, name="itself"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=300)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    report = nc.contacts(system, trajectory)
    itself = np.array([name.startswith("itself") for name in report.names])
    assert itself.sum() == 78
    assert report.force[:, itself].max() > 1.0
    assert report.gap[:, itself].min() > -0.04


@pytest.mark.exhaustive
def test_rattleback_turns_back():
    """One way it spins on; the other way it begins to rattle and turns back, having lost little."""
    spins = []
    for spin in (-5.0, 5.0):
        example = gallery.load("rattleback", spin=spin)
        trajectory = example.simulate()
        spins.append(np.asarray(example.system.sense(trajectory, "stone").angular_velocity)[:, 2])
        energy = np.asarray(example.system.energy(trajectory).total)
        assert 0.95 * energy[0] <= energy[-1] <= energy[0]
        assert np.diff(energy).max() <= 1e-13 * energy[0]
    assert spins[0][-1] > 4.0
    assert spins[1].min() > 4.5


@pytest.mark.exhaustive
def test_a_tennis_ball_on_a_plate():
    """Dropped from 2.54 m (7 m/s), it keeps 0.73 to 0.76 of its speed, which its wall damps."""
    scene = nc.Scene()
    ball = add_ball(scene, 4, position=(0, 0, 0.0365), velocity=(0, 0, -7.0))
    scene.add(nc.Contact(ball, FLOOR, name="plate"))
    system, state = scene.compile()
    inflated = nc.equilibrium(system, state, steps=1).state
    start = nc.State(**{**vars(inflated), "v": state.v, "t": state.t})
    trajectory = nc.simulate(system, start, dt=1e-4, steps=100)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    momentum = np.asarray(system.momentum(trajectory))[:, 2]
    assert 0.73 <= -momentum[-1] / momentum[0] <= 0.76
