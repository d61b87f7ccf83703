"""What contacts keep: energy with what is booked, momentum and angular momentum, by shapes and by law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import (
    BALL,
    FLEXIBLE,
    FLOOR,
    HARD,
    LAWS,
    PAIRS,
    TURNS,
    assert_never_gains,
    lost,
    meeting,
    stored,
)

import natcoord_jax as nc
from natcoord_jax import gallery

DEFAULT = {("sphere, sphere", "Hertz")}
SLOW = {
    ("sphere, plane", "hard and rubbing"),
    ("capsule, capsule", "soft"),
    ("ellipsoid, plane", "lossy"),
}
SLOW_FLEXIBLE = ("solid, solid: lossy",)
SMOOTH = ("sphere, sphere", "point, plane", "sphere, plane", "box, box")
TURNED = ("box", "capsule", "ellipsoid", "cylinder")
NONE = {("cylinder, plane", law) for law in LAWS if law not in HARD}
"""A stiffness would be that of several points where a cylinder stands, and of one where it lies."""
ALONE = {
    ("capsule, capsule", "soft"),
    ("sphere, sphere", "Hertz"),
    ("box, box", "hard"),
    ("sphere, box", "hard"),
}
"""Laws that are those of all pairs but for a number, or for friction, of some pairs."""


def lane(case):
    """The mark of a case."""
    mark = pytest.mark.slow if case in SLOW else pytest.mark.exhaustive
    return pytest.param(*case, marks=[] if case in DEFAULT else mark, id=", ".join(case))


TABLE = {(pair, law) for pair in PAIRS for law in ("lossy", "rubbing", "hard and rubbing")} - NONE | ALONE
CASES = [lane(case) for case in sorted(TABLE)]


@pytest.mark.parametrize(("pair", "law"), CASES)
def test_impacts_keep_what_they_should(pair, law):
    """Flat, on an edge and on a corner, with and without losses; nothing passes through, and all part."""
    restitutions = (1.0, 0.5) if "restitution" in LAWS[law] else (None,)
    stiff = law not in HARD and pair not in SMOOTH
    bound = tol.ENERGY_OF_A_STIFF_CONTACT if stiff else tol.ENERGY_OF_A_SMALL_SCENE
    levers = 10 if pair.endswith("box") else 1
    for turn in TURNS if pair.startswith(TURNED) else ("corner",):
        for restitution in restitutions:
            numbers = {} if restitution is None else {"restitution": restitution}
            system, state = meeting(pair, law, turn=turn, **numbers)
            trajectory = nc.simulate(system, state, dt=2e-3, steps=250)
            balance = assert_never_gains(system, trajectory, bound=bound)
            assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
            assert balance.angular_momentum.max() <= levers * tol.MOMENTUM_OF_A_SMALL_SCENE
            report = nc.contacts(system, trajectory)
            pushed = np.flatnonzero(report.force.max(axis=1) > 0)
            assert pushed.size and (report.gap[pushed[0] + 1 :].min(axis=1) > 0).any()
            kinetic = np.asarray(system.energy(trajectory).kinetic)
            if law in HARD:
                # By the compliance with which several gaps share a load.
                assert report.gap.min() >= -tol.SHARED_GAP
            else:
                assert stored(system, trajectory).max() >= 0.05 * kinetic[0]
                assert report.gap.min() >= -0.04
            lossless = restitution in (None, 1.0) and "rubbing" not in law
            if lossless:
                assert abs(kinetic[-1] / kinetic[0] - 1) <= 100 * tol.ENERGY_OF_A_SMALL_SCENE
            elif restitution != 1.0:
                # (With one, friction may take no more than what keeps the impact from giving energy.)
                assert lost(system, trajectory)[-1] < -1e-3 * kinetic[0]


FLEXIBLE_CASES = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW_FLEXIBLE else pytest.mark.exhaustive)
    for name in FLEXIBLE
]


@pytest.mark.parametrize("case", FLEXIBLE_CASES)
def test_impacts_of_what_is_flexible_keep_what_they_should(case):
    """Nodes of solids and shells, beams, on planes, spheres and each other, with losses and with friction."""
    make, numbers, dt = FLEXIBLE[case]
    system, state = make(**numbers)
    trajectory = nc.simulate(system, state, dt=dt, steps=60)
    balance = assert_never_gains(system, trajectory, bound=tol.ENERGY_OF_A_STIFF_CONTACT)
    assert balance.momentum.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    assert balance.angular_momentum.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    kinetic = float(system.energy(trajectory).kinetic[0])
    assert stored(system, trajectory).max() >= 0.02 * kinetic
    if "lossy" in case or "rubbing" in case:
        taken = lost(system, trajectory)
        assert taken[-1] < -1e-3 * kinetic and np.diff(taken).max() <= 1e-13 * kinetic


@pytest.mark.exhaustive
def test_blocks_that_collide_corner_first():
    """At half the time of a wave through a block: a third of the energy is stored, and all is kept."""
    example = gallery.load("colliding_blocks")
    trajectory = example.simulate()
    assert_kept(example.system, trajectory, 0.1)


def assert_kept(system, trajectory, part):
    """Energy, momenta, through an impact that stores a part of the energy and is over."""
    balance = nc.balance(system, trajectory)
    for drift in (balance.energy, balance.momentum, balance.angular_momentum):
        assert drift.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    stores = stored(system, trajectory)
    assert stores.max() >= part * float(system.energy(trajectory).kinetic[0])
    assert stores[-1] == 0.0


MESHES = {
    # Of the lower block, faces of both, contact, part of the energy that is stored.
    "nodes": ((2, 2, 1), ("z0", "z1"), {}, 0.2),
    "nodes of other meshes by all faces": ((3, 3, 1), (None, None), {"candidates": 30}, 0.05),
    "mortar": ((2, 2, 1), ("z0", "z1"), {"method": "mortar"}, 0.2),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", MESHES)
def test_blocks_collide_and_fly_on(case):
    """Five hundred steps, some longer than a wave takes: they turn over, and nodes are behind each other.

    Corners slide over edges of each other; by two faces alone blocks of other meshes end in their sixth step.
    """
    lower, faces, numbers, part = MESHES[case]
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    spin, middle = np.array([0.0, 0.3, 0.8]), np.array([1.0, 1.0, 0.3])
    place = {"position": (0.02, 0.2, 0.19), "orientation": ((1.0, 0.6, 0.0), 0.29)}
    one = {"material": rubber, "velocity": (1.0, 0.5, -4.0), **place}
    one = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (2, 2, 1)), **one))
    other = {"position": (-0.55, -0.45, -0.65), "velocity": np.array([0, 0, 2.0]) - np.cross(spin, middle)}
    other |= {"material": rubber, "angular_velocity": spin}
    other = scene.add(nc.Solid(nc.mesh.box((2, 2, 0.6), lower), **other))
    surfaces = [body.face(*[name] if name else []) for body, name in zip((one, other), faces)]
    scene.add(nc.Contact(*surfaces, name="impact", **numbers))
    system, state = scene.compile()
    for dt in (4e-3, 12e-3):
        assert_kept(system, nc.simulate(system, state, dt=dt, steps=500), part)


@pytest.mark.exhaustive
@pytest.mark.parametrize("law", [{"stiffness": 5e4}, {"restitution": 1.0}], ids=["soft", "hard"])
def test_a_crowd_of_all_shapes(law):
    """Spheres, capsules and boxes in space that fly at each other, all pairs of them."""
    scene = nc.Scene()
    shapes = nc.Sphere(0.06), nc.Capsule(0.04, 0.1), nc.Box((0.1, 0.08, 0.06))
    places = 0.15 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    bodies = [
        scene.add(nc.RigidBody(shape=shapes[k % 3], density=500.0, position=place, velocity=-5.0 * place))
        for k, place in enumerate(places)
    ]
    scene.add(nc.Contact(all_pairs_of=bodies, rounding=0.02, name="impact", **law))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=180)
    assert_never_gains(system, trajectory, bound=tol.ENERGY_OF_A_STIFF_CONTACT)
    for momentum in (system.momentum(trajectory), system.angular_momentum(trajectory)):
        assert np.ptp(np.asarray(momentum), axis=0).max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert (nc.contacts(system, trajectory).force.max(axis=0) > 0).sum() >= 2


@pytest.mark.exhaustive
def test_edges_that_cross_do_not_pass():
    """No corner is near: edges meet where they are round, and all of the speed passes on."""
    for law in ({"stiffness": 1e6}, {"restitution": 1.0}):
        scene = nc.Scene()
        along = {"shape": nc.Box((1.0, 0.1, 0.1)), "density": 500.0, "orientation": ((1, 0, 0), np.pi / 4)}
        across = {"shape": nc.Box((0.1, 1.0, 0.1)), "density": 500.0, "orientation": ((0, 1, 0), np.pi / 4)}
        one = scene.add(nc.RigidBody(**along))
        other = scene.add(nc.RigidBody(**across, position=(0, 0, 0.2), velocity=(0, 0, -2.0)))
        scene.add(nc.Contact(one, other, name="edges", rounding=0.01, **law))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=1e-3, steps=100)
        assert_never_gains(system, trajectory, bound=tol.ENERGY_OF_A_STIFF_CONTACT)
        gap = nc.contacts(system, trajectory).gap.min(axis=1)
        assert gap[0] == pytest.approx(0.2 - 2 * (np.sqrt(2) * (0.05 - 0.01) + 0.01), abs=1e-9)
        assert gap[-1] > 0.05
        end = np.asarray(system.sense(trajectory, other).velocity)[-1]
        np.testing.assert_allclose(end, 0.0, atol=1e-5)


@pytest.mark.exhaustive
def test_parallel_capsules():
    """They meet along a line: the point where they push moves smoothly, and energy is kept."""
    for tilt, offset in ((0.0, 0.0), (0.0, 0.02), (1e-4, 0.02), (1e-2, 0.05)):
        scene = nc.Scene()
        shape = {"shape": nc.Capsule(radius=0.05, length=0.2), "density": 500.0}
        one = scene.add(nc.RigidBody(**shape))
        tilted = {"orientation": ((1, 0.3, 0), tilt), "velocity": (-1.0, 0, 0)}
        two = scene.add(nc.RigidBody(**shape, position=(0.15, 0, offset), **tilted))
        scene.add(nc.Contact(one, two, stiffness=2e4, name="impact"))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=1e-3, steps=150)
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
        assert np.ptp(np.asarray(system.momentum(trajectory)), axis=0).max() <= 1e-13
        assert float(system.sense(trajectory, one).velocity[-1, 0]) < -0.5


@pytest.mark.exhaustive
def test_masses_and_steps():
    """Three balls that fall, rub and bounce, of masses from 1e-6 to 1e6, with steps that are right and ten
    times too long; one lane that is no number leaves the others alone.

    (What rubs on two bodies of a million times its mass at once ends a run by name: the last ones.)
    """
    scene = nc.Scene()
    scene.add(nc.Gravity())
    balls, law = [], {"restitution": 0.5, "friction": 0.3}
    for k in range(3):
        moving = {"velocity": (0.2 * k, 0, 0), "angular_velocity": (1.0, 2.0, 0), "name": f"ball {k}"}
        balls.append(scene.add(nc.RigidBody(**BALL, position=(0.01 * k, 0, 0.3 + 0.25 * k), **moving)))
        scene.add(nc.Contact(balls[-1], FLOOR, **law, name=f"floor {k}"))
        for j, other in enumerate(balls[:-1]):
            scene.add(nc.Contact(other, balls[-1], **law, name=f"pair {j} {k}"))
    system, state = scene.compile()
    names = [*(f"floor {k}" for k in range(3)), *(f"pair {j} {k}" for k in range(3) for j in range(k))]
    cases = (1, 1, 1, 0.3), (1e6, 1, 1e-6, 0.3), (1, 1e-3, 1, 0.3), (1, 1e-6, 1, 0.0), (1e-6, 1e6, 1, 0.0)
    for *masses, friction in cases:
        made = system.set(names, friction=friction)
        for k, mass in enumerate(masses):
            made = made.set(f"ball {k}", mass=float(mass), inertia=0.4 * mass * 0.1**2 * np.eye(3))
        for dt in (5e-3, 5e-2):
            steps = nc.Steps(round(1.5 / dt), 300)
            trajectory = nc.simulate(made, state, dt=dt, steps=steps, extra_substeps=200)
            assert_never_gains(made, trajectory, bound=tol.ENERGY_OF_A_STIFF_CONTACT)
            assert nc.contacts(made, trajectory).gap.min() >= -tol.SHARED_GAP

    def run(z):
        start = nc.State(**{**vars(state), "q": state.q.at[0, 2].add(z)})
        return nc.simulate(system, start, dt=5e-3, steps=100, throw=False)

    shifts = jnp.array([0.0, jnp.nan, 0.03, 0.05])
    lanes = jax.vmap(run)(shifts)
    assert np.asarray(lanes.result).tolist()[0::2] == [0, 0]
    assert int(lanes.result[1]) == int(nc.Result.NONFINITE)
    for k in (0, 2, 3):
        np.testing.assert_allclose(np.asarray(lanes.q)[k], np.asarray(run(shifts[k]).q), atol=1e-9)


@pytest.mark.exhaustive
def test_balls_in_a_corner():
    """Eight balls roll into a corner of three planes and pile up: sets of contacts change all the time."""
    scene, random = nc.Scene(), np.random.default_rng(5)
    scene.add(nc.Gravity(vector=(-3.0, -3.0, -9.81)))
    walls = FLOOR, nc.Plane(normal=(1, 0, 0)), nc.Plane(normal=(0, 1, 0))
    balls = []
    for k in range(8):
        place = 0.15 + 0.25 * np.array([k & 1, (k >> 1) & 1, k >> 2]) + 0.02 * random.random(3)
        balls.append(scene.add(nc.RigidBody(**BALL, position=place, velocity=random.normal(size=3))))
        for wall in walls:
            scene.add(nc.Contact(balls[-1], wall, restitution=0.3, friction=0.2))
    scene.add(nc.Contact(all_pairs_of=balls, restitution=0.3, friction=0.2))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=300, extra_substeps=300)
    assert_never_gains(system, trajectory)
    assert nc.contacts(system, trajectory).gap.min() >= -tol.SHARED_GAP
