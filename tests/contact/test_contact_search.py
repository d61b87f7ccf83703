"""Pairs that are looked for: the energies, motion and numbers of listed ones, of many, and what is told."""

from functools import partial
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import assert_never_gains

import natcoord_jax as nc
from natcoord_jax.viz import motion

RADIUS, LENGTH = 0.1, 0.2
STIFFNESS = 2e5


def lattice(count):
    """Places of a cube of some edge, from one corner on."""
    edge = int(np.ceil(count ** (1 / 3)))
    return np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:count]


# --- what touches -------------------------------------------------------------------------------------------


def segments(kind, count):
    """Ends of segments at random with some room, of no length for spheres, and radii."""
    random = np.random.default_rng(count)
    edge = (2.0 * count) ** (1 / 3) * RADIUS
    middle, radii = random.uniform(-edge, edge, (count, 3)), random.uniform(0.5, 1.0, count) * RADIUS
    if kind == "line":
        middle = middle * (0.01, 0.01, 0.1 * count)
    if kind == "far":
        middle[0] = 1e4
    half = 0.5 * LENGTH * random.normal(size=(count, 3)) * (kind == "capsules")
    half[::3] = 0.0
    return middle - half, middle + half, radii


def pushes(one, other, radii, **search):
    """Forces [N] on segments that are at rest, by what a short step does, and names of their contacts."""
    scene, bodies, dt = nc.Scene(), [], 1e-6
    for a, b, r in zip(one, other, radii):
        length = np.linalg.norm(b - a)
        shape = nc.Capsule(r, length) if length else nc.Sphere(r)
        along = (b - a) / length if length else np.array([0, 0, 1.0])
        turn = {"orientation": (np.cross((0, 0, 1.0), along), np.arccos(along[2]))} if length else {}
        bodies.append(scene.add(nc.RigidBody(shape=shape, density=900.0, position=(a + b) / 2, **turn)))
    made = scene.add(nc.Contact(all_pairs_of=bodies, stiffness=STIFFNESS, name="all", **search))
    system, state = scene.compile()
    end = nc.simulate(system, state, dt=dt, steps=1)
    velocity = np.asarray(end.v)[-1].reshape(-1, 4, 3)[:, 0]
    return np.asarray(system.mass)[:, 0, 0, None] * velocity / dt, [handle.name for handle in made]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "line", "far"])
def test_a_search_sees_all_spheres_that_touch(kind):
    """They are pushed as by all pairs: evenly in a box, in one column of cells, with one far off."""
    one, other, radii = segments(kind, 60)
    between = one[:, None] - one
    apart = np.linalg.norm(between, axis=-1) + np.eye(60)
    depths = np.maximum(radii[:, None] + radii - apart, 0.0) * (1 - np.eye(60))
    assert (depths > 0).sum() > 20
    forces, names = pushes(one, other, radii, capacity=24)
    assert names == ["all"]
    wanted = STIFFNESS * np.einsum("ij,ijx->ix", depths / apart, between)
    np.testing.assert_allclose(forces, wanted, atol=1e-5 * np.abs(wanted).max())


@pytest.mark.exhaustive
def test_a_search_sees_all_capsules_that_touch():
    """They are pushed as by listed pairs."""
    one, other, radii = segments("capsules", 8)
    searched, listed = (pushes(one, other, radii, **search) for search in ({"capacity": 7}, {}))
    assert len(searched[1]) == 1 and len(listed[1]) == 28
    largest = np.abs(listed[0]).max()
    np.testing.assert_allclose(searched[0], listed[0], atol=1e-5 * largest)
    assert largest > 100.0


# --- the motion and numbers of listed pairs -----------------------------------------------------------------

LAWS = {"spheres": {"restitution": 0.6, "speed": 3.0, "law": "hertz"}, "capsules": {}}
APART = {"spheres": 0.22, "capsules": 0.33}


def heap(kind, searched):
    """Six bodies on a lattice, with velocities at random, and two points that are in no contact.

    The first two hang on each other by a joint, the second and third are ignored.
    """
    random, scene = np.random.default_rng(3), nc.Scene()
    places = APART[kind] * lattice(6) + 0.01 * random.normal(size=(6, 3))
    velocities = 2.0 * random.normal(size=(6, 3))
    velocities[1] = velocities[0]
    bodies = []
    for k, (x, v) in enumerate(zip(places, velocities)):
        ball = kind == "spheres" or k % 3 == 2
        shape = nc.Sphere(RADIUS) if ball else nc.Capsule(RADIUS, LENGTH)
        body = {"shape": shape, "density": 900.0, "position": x, "velocity": v, "name": f"body {k}"}
        bodies.append(scene.add(nc.RigidBody(**body)))
    for k in range(2):
        point = {"position": (0.1, 0.1, 0.6 + 0.01 * k), "velocity": (0, 0, -3.0), "name": f"point {k}"}
        bodies.append(scene.add(nc.PointMass(mass=1.0, **point)))
    scene.add(nc.Spherical(*bodies[:2], point=0.5 * (places[0] + places[1])))
    ignored = [tuple(bodies[1:3])] + ([] if searched else [tuple(bodies[6:])])
    law = {"stiffness": STIFFNESS, "ignore": ignored, "capacity": 8 if searched else None, **LAWS[kind]}
    scene.add(nc.Contact(all_pairs_of=bodies, name="all", **law))
    return scene.compile()


FIELDS = "gap", "force", "active", "impacts", "inside", "margin"


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("spheres", marks=pytest.mark.exhaustive),
        pytest.param("capsules", marks=pytest.mark.exhaustive),
    ],
)
def test_a_search_is_a_list(kind):
    """The motion, energies, balances and numbers told of listed pairs, in lanes that differ.

    Could go wrong: pairs that are joined or ignored, and points, which are near each other here.
    """
    made, factors = (heap(kind, True), heap(kind, False)), jnp.array([1.0, 0.3])

    def run(system, state, factor):
        start = eqx.tree_at(lambda s: s.v, state, factor * state.v)
        return nc.simulate(system, start, dt=1e-3, steps=100)

    lanes, listed = (jax.vmap(partial(run, *x))(factors) for x in made)
    (system, _), (listing, _) = made
    np.testing.assert_allclose(lanes.q, listed.q, atol=1e-11)
    stores = [
        sum(np.asarray(x) for x in s.energy(t).stores.values())
        for s, t in ((system, lanes), (listing, listed))
    ]
    np.testing.assert_allclose(stores[0], stores[1], atol=1e-9 * stores[1].max())
    assert stores[1].max() > 0.1
    assert nc.balance(system, lanes).energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT

    report, all_pairs = nc.contacts(system, lanes), nc.contacts(listing, lanes)
    at = [all_pairs.names.index(name) for name in report.names]
    assert len(at) > 3 and report.force.max() > 1.0 and not report.hard.any()
    for field in FIELDS:
        some, every_one = getattr(report, field), getattr(all_pairs, field)
        np.testing.assert_allclose(some, every_one[..., at], rtol=1e-10, atol=1e-10, err_msg=field)
    np.testing.assert_array_equal(report.steps_in_contact, all_pairs.steps_in_contact[at])
    assert report.notes == all_pairs.notes and np.isfinite(report.steps_in_contact).sum() > 1
    # What is left out stays farther apart than the skin.
    apart = np.delete(all_pairs.gap, at, axis=-1)
    assert apart.shape[-1] > 3 and apart.min() >= 0.25 * RADIUS
    alone = nc.contacts(system, jax.tree.map(lambda x: x[0], lanes))
    at = [report.names.index(name) for name in alone.names]
    for field in FIELDS:
        np.testing.assert_allclose(getattr(alone, field), getattr(report, field)[0][..., at], atol=1e-12)


def cloud(kind, count, listed=False, **contact):
    """Bodies on a lattice that nearly touch, with velocities at random, and contact of each with each."""
    random = np.random.default_rng(3)
    places = APART[kind] * lattice(count) + 0.01 * random.normal(size=(count, 3))
    velocities = 2.0 * random.normal(size=places.shape) + (1.0, 0, 0)
    spins = random.normal(size=places.shape)
    scene, bodies = nc.Scene(), []
    for k, (x, v, w) in enumerate(zip(places, velocities, spins)):
        ball = kind == "spheres" or k % 3 == 2
        body = {"shape": nc.Sphere(RADIUS) if ball else nc.Capsule(RADIUS, LENGTH), "density": 900.0}
        body |= {"position": x, "velocity": v, "angular_velocity": w, "name": f"ball {k}"}
        bodies.append(scene.add(nc.RigidBody(**body)))
    law = {"stiffness": STIFFNESS, **contact}
    if listed:
        for a, b in combinations(bodies, 2):
            scene.add(nc.Contact(a, b, **law))
    else:
        scene.add(nc.Contact(all_pairs_of=bodies, name="all", **law))
    return scene.compile()


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        pytest.param("spheres", 100, marks=pytest.mark.slow),
        pytest.param("capsules", 50, marks=pytest.mark.exhaustive),
    ],
)
def test_a_cloud_keeps_what_it_should(kind, count):
    """In free flight: energy, momentum, angular momentum, in every step; Newton's method, which sees who
    pushes whom, takes few iterations."""
    system, state = cloud(kind, count)
    trajectory = nc.simulate(system, state, dt=1e-3, steps=80)
    assert int(trajectory.iterations) <= (7 if kind == "spheres" else 8) * 80
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert balance.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    stored = np.asarray(system.energy(trajectory).stores["all"])
    assert stored.max() > 0.05 * np.asarray(system.energy(trajectory).kinetic).max()


@pytest.mark.exhaustive
def test_a_cloud_is_that_of_listed_pairs():
    """Sixty balls: with their neighbours, and with 1770 gaps."""
    motions = []
    for listed in (False, True):
        system, state = cloud("spheres", 60, listed)
        motions.append(np.asarray(nc.simulate(system, state, dt=1e-3, steps=60).q))
    np.testing.assert_allclose(motions[0], motions[1], atol=1e-10)


# --- what is told -------------------------------------------------------------------------------------------


def two_at(other, velocity=(0.0, 0, 0), steps=10, dt=1e-2, **contact):
    """A ball that rests and another one, after some steps of a hundredth of a second."""
    scene = nc.Scene()
    ball = {"shape": nc.Sphere(RADIUS), "density": 900.0}
    balls = [
        scene.add(nc.RigidBody(**ball, name="at rest")),
        scene.add(nc.RigidBody(**ball, position=other, velocity=velocity, name="flying")),
    ]
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5, name="all", **{"capacity": 1, **contact}))
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=dt, steps=steps)


@pytest.mark.slow
def test_what_strays_too_far_is_told():
    """A ball that is stopped within a step strays from its way: shorter steps, at last an error by name."""
    system, trajectory = two_at((0.26, 0, 0), (-8.0, 0, 0))
    assert int(trajectory.steps_rejected) > 0
    assert_never_gains(system, trajectory, bound=tol.ENERGY_OF_A_STIFF_CONTACT)
    names = "'(at rest|flying)' and '(at rest|flying)' in 'all'"
    with pytest.raises(nc.SimulationError, match=names) as error:
        two_at((0.26, 0, 0), (-8.0, 0, 0), skin=1e-5)
    assert error.value.result is nc.Result.MISSED and "`skin`" in str(error.value)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["spheres", "capsules"])
def test_too_many_neighbours_are_told(kind):
    """By name, with what to do."""
    with pytest.raises(nc.SimulationError, match="'ball [0-9]+' and 'ball [0-9]+' in 'all'") as error:
        system, state = cloud(kind, 8, capacity=1)
        nc.simulate(system, state, dt=1e-3, steps=3)
    assert error.value.result is nc.Result.OVERFLOW and "`capacity`" in str(error.value)


def row(gaps, floor=False, **contact):
    """Balls in a row at rest with gaps between them, for three steps."""
    scene, ball, x = nc.Scene(), {"shape": nc.Sphere(RADIUS), "density": 900.0}, 0.0
    balls = []
    for k, gap in enumerate((0.0, *gaps)):
        x += gap + 2 * RADIUS * (k > 0)
        balls.append(scene.add(nc.RigidBody(**ball, position=(x, 0, RADIUS), name=f"ball {k}")))
        if floor:
            scene.add(nc.Contact(balls[-1], nc.Plane(), restitution=0.0, name=f"floor of ball {k}"))
    if floor:
        scene.add(nc.Gravity())
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5, name="all", **contact))
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=1e-4, steps=3)


@pytest.mark.exhaustive
def test_what_is_far_is_not_told():
    """Nothing at all, where no pair has come within the skin; a wider skin tells of more, lost lanes not."""
    system, trajectory = row((0.03, 0.06), capacity=4)
    report = nc.contacts(system, trajectory)
    assert report.names == () and report.notes == () and report.gap.shape == (4, 0)
    assert report.steps_in_contact.shape == (0,) and repr(report) == (
        "no bodies have come within the skin of their contact"
    )
    with pytest.raises(ValueError, match=r"'all' has no sensor.*`nc.contacts\(system, trajectory\)`"):
        system.sense(trajectory, "all")
    scene = nc.Scene()
    scene.add(nc.PointMass(mass=1.0))
    with pytest.raises(ValueError, match="no contacts; add nc.Contact"):
        nc.contacts(scene.compile()[0], trajectory)
    report = nc.contacts(*row((0.03, 0.06), skin=0.05))
    assert report.names == ("all[ball 0, ball 1]",)
    np.testing.assert_allclose(report.margin, 0.03, atol=1e-12)
    assert repr(report) == "least margin 0.03 m of 1 contacts"
    # The gap of places that are no numbers is one of no distance.
    system, trajectory = row((-0.01, 0.5), capacity=4)
    lost = eqx.tree_at(lambda t: t.states.q, trajectory, jnp.nan * trajectory.states.q)
    lanes = jax.tree.map(lambda *x: jnp.stack(x), trajectory, lost)
    report, alone = nc.contacts(system, lanes), nc.contacts(system, trajectory)
    assert report.names == alone.names == ("all[ball 0, ball 1]",)
    np.testing.assert_array_equal(report.force[0], alone.force)
    assert alone.force.min() > 100.0


@pytest.mark.exhaustive
def test_capsules_of_one_body_are_told_by_their_numbers():
    """And what is on the ground by that."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 0.21), name="ball"))
    centres = nc.Point(nc.ground), nc.Point(nc.ground, (0.05, 0, 0)), nc.Point(ball, (0, 0, 0.21))
    options = {"radii": np.full(3, RADIUS), "ignored": [(0, 1)], "stiffness": 1e5}
    scene.add(nc.CapsuleContacts(centres, **options, name="all"))
    system, state = scene.compile()
    report = nc.contacts(system, nc.simulate(system, state, dt=1e-3, steps=2))
    assert report.names == ("all[ground (0), ball]", "all[ground (1), ball]")
    np.testing.assert_allclose(report.gap[0], [0.01, np.hypot(0.05, 0.21) - 0.2], atol=1e-12)


def arrows(system, trajectory):
    """Arrows of a run by name."""
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t))
    return {s.name: s.rows for s in shown.solids if s.kind == "force"}


@pytest.mark.exhaustive
def test_arrows_are_those_of_listed_pairs():
    """Balls on a floor that push each other apart: from where each two touch, along the row."""
    (system, trajectory), listed = (row((-0.01, -0.02), True, **x) for x in ({"capacity": 4}, {}))
    drawn, wanted = arrows(system, trajectory), arrows(*listed)
    floor, pairs = {f"floor of ball {k}" for k in range(3)}, ("all[ball 0, ball 1]", "all[ball 1, ball 2]")
    assert set(drawn) == set(wanted) == {*floor, *pairs}
    for name, rows in wanted.items():  # (Their tips and where they begin; they are round.)
        np.testing.assert_allclose(drawn[name][:, [0, 3]], rows[:, [0, 3]], atol=1e-9)
    np.testing.assert_allclose(drawn[pairs[1]][0, 0], [0.19 + 0.09, 0, 0.1], atol=1e-6)
    assert np.all(drawn[pairs[1]][:, 3, 0] > 0)
    report = nc.contacts(system, trajectory)
    assert report.names == (*sorted(floor), *pairs) and report.hard.tolist() == [True] * 3 + [False] * 2
    assert arrows(*row((0.03,), capacity=4)) == {}


def test_small_scenes_list_their_pairs():
    """Below fifty balls, without being asked; of joined and ignored pairs, in either order, there is none."""
    scene, ball = nc.Scene(), {"shape": nc.Sphere(RADIUS), "density": 900.0}
    balls = [scene.add(nc.RigidBody(**ball, position=(0.1 * k, 0, 0), name=f"ball {k}")) for k in range(50)]
    assert len(scene.add(nc.Contact(all_pairs_of=balls[:49], stiffness=1e5))) == 49 * 24
    assert len(scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5))) == 1
    a, b, c, d = balls[:4]
    scene.add(nc.Spherical(b, c))
    made = scene.add(nc.Contact(all_pairs_of=[a, b, c, d], ignore=[(d, a), (a, b)], name="four"))
    assert [x.name for x in made] == [f"four[ball {i}, ball {j}]" for i, j in ((0, 2), (1, 3), (2, 3))]
    scene = nc.Scene()
    balls = [scene.add(nc.RigidBody(**ball, position=(0.1 * k, 0, 0))) for k in range(3)]
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5, ignore=[balls[:2], balls[1:]], capacity=4))
    system, state = scene.compile()
    assert float(system.energy(state).total) == pytest.approx(0.0, abs=1e-30)
