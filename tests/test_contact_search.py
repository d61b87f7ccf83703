"""Neighbours of many spheres in contact: found as by all pairs, what is kept, what is overlooked is told."""

from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.effects.contact.capsules import CapsuleContacts
from natcoord_jax.linsolve.multifrontal import Multifrontal
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.near_spheres import near_spheres
from natcoord_jax.mechanics.full import FullStep

RADIUS = 0.1
SEARCH = jax.jit(near_spheres, static_argnums=2)


def cloud(count, listed=False, joined=False, apart=0.22, **contact):
    """Balls on a lattice that nearly touch, with velocities at random, and contact of each with each.

    The first two may hang on each other by a joint.
    """
    random, edge = np.random.default_rng(3), int(np.ceil(count ** (1 / 3)))
    lattice = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    places = apart * lattice + 0.01 * random.normal(size=lattice.shape)
    velocities = 2.0 * random.normal(size=places.shape) + (1.0, 0, 0)
    spins = random.normal(size=places.shape)
    if joined:
        velocities[:2], spins[:2] = velocities[0], 0.0
    scene, ball = nc.Scene(), {"shape": nc.Sphere(RADIUS), "density": 900.0}
    balls = [
        scene.add(nc.RigidBody(**ball, position=x, velocity=v, angular_velocity=w, name=f"ball {k}"))
        for k, (x, v, w) in enumerate(zip(places, velocities, spins))
    ]
    if joined:
        scene.add(nc.Spherical(balls[0], balls[1]))
    law = {"stiffness": 2e5, **contact}
    if listed:
        for a, b in combinations(balls, 2):
            scene.add(nc.Contact(a, b, **law))
    else:
        scene.add(nc.Contact(all_pairs_of=balls, name="all", **law))
    return scene.compile()


def pairs_of(found):
    """Pairs of a search, from both sides."""
    others, near = np.asarray(found.others), np.asarray(found.near)
    return [(int(a), int(others[a, k])) for a, k in zip(*np.nonzero(near))]


@pytest.mark.parametrize("count", (2, 60, 150, 400))
@pytest.mark.parametrize("where", ("box", "line", "far"))
def test_search_equals_all_pairs(count, where):
    """Spheres of all sizes, evenly in a box, in one column of cells, and with one that has flown off."""
    random = np.random.default_rng(count)
    edge = (12.0 * count) ** (1 / 3) * RADIUS
    places = random.uniform(-edge, edge, (count, 3))
    if where == "line":
        places = places * (0.01, 0.01, 0.1 * count)
    if where == "far":
        places[0] = 1e7
    radii = random.uniform(0.5, 1.0, count) * RADIUS
    found = SEARCH(jnp.asarray(places), jnp.asarray(radii), 24)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    wanted = np.argwhere((apart <= radii[:, None] + radii) & ~np.eye(count, dtype=bool))
    seen = pairs_of(found)
    assert sorted(seen) == sorted(map(tuple, wanted.tolist()))
    assert (np.asarray(found.left_out) == -1).all()


def test_no_room_is_told():
    """Of spheres, and of the runs that are looked through: one cell may have many that do not touch."""
    places = jnp.asarray(np.random.default_rng(0).normal(size=(30, 3)) * 1e-3)
    one, other = np.asarray(SEARCH(places, jnp.full(30, RADIUS), 16).left_out)
    assert one >= 0 and other >= 0 and one != other
    radii = jnp.full(30, 1e-5).at[0].set(RADIUS)
    found = SEARCH(places.at[0].set(10.0), radii, 16)
    assert not pairs_of(found) and (np.asarray(found.left_out) >= 0).all()


LAWS = {"lossy": {"restitution": 0.6, "speed": 3.0, "law": "hertz"}, "elastic": {}}


@pytest.mark.parametrize("law", ("lossy", pytest.param("elastic", marks=pytest.mark.slow)))
def test_motion_is_that_of_listed_pairs(law):
    """Some balls, two of them joined, against a gap of each pair: the same to rounding, energies too."""
    given = {"joined": True, **LAWS[law]}
    found = []
    for options in ({"capacity": 12}, {"listed": True}):
        system, state = cloud(8, **given, **options)
        trajectory = nc.simulate(system, state, dt=1e-3, steps=120)
        works = sum(np.asarray(x) for x in system.energy(trajectory).stores.values())
        found.append((np.asarray(trajectory.q), works))
        assert nc.balance(system, trajectory).energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-11)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-9 * found[1][1].max())
    assert found[1][1].max() > 0.1


def test_a_cloud_keeps_what_it_should():
    """A hundred balls that collide in free flight: energy, momentum, angular momentum, in every step.

    Balls do not wait for each other where equations are solved, and Newton's method sees who pushes whom.
    """
    system, state = cloud(100)
    assert [type(group.effect) for group in system.effects] == [CapsuleContacts]
    assert isinstance(system.sparsity.plan, Multifrontal)
    trajectory = nc.simulate(system, state, dt=1e-3, steps=150)
    assert int(trajectory.iterations) <= 7 * 150
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert balance.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    stored = np.asarray(system.energy(trajectory).stores["all"])
    assert stored.max() > 0.05 * np.asarray(system.energy(trajectory).kinetic).max()


@pytest.mark.slow
def test_a_cloud_is_that_of_listed_pairs():
    """Sixty balls: with their neighbours, and with 1770 gaps."""
    found = []
    for listed in (False, True):
        system, state = cloud(60, listed)
        found.append(np.asarray(nc.simulate(system, state, dt=1e-3, steps=60).q))
    np.testing.assert_allclose(found[0], found[1], atol=1e-10)


@pytest.mark.slow
def test_lanes_are_those_alone():
    """Lanes of a batch have neighbours of their own."""
    system, state = cloud(8, capacity=7)

    def end(factor):
        start = eqx.tree_at(lambda s: s.v, state, factor * state.v)
        return nc.simulate(system, start, dt=1e-3, steps=60).q[-1]

    factors = jnp.array([1.0, -1.0, 0.3])
    lanes = jax.vmap(end)(factors)
    alone = jax.jit(end)
    for lane, factor in zip(lanes, factors):
        np.testing.assert_allclose(lane, alone(factor), atol=1e-12)


@pytest.mark.slow
def test_derivatives_equal_differences():
    """Of where balls are after collisions, by how fast one of them is; in both modes."""
    system, state = cloud(8, capacity=7)

    def spread(x):
        start = eqx.tree_at(lambda s: s.v, state, state.v.at[0].add(x * jnp.array([1.0, 0.5, 0.2])))
        return jnp.sum(nc.simulate(system, start, dt=1e-3, steps=60).q[-1, ::4] ** 2)

    slope = jax.grad(spread)(0.0)
    assert float(jax.jvp(spread, (0.0,), (1.0,))[1]) == pytest.approx(float(slope), rel=tol.SAME_GRADIENT)
    assert_v_shaped(jax.jit(spread), 0.0, 1.0, slope, steps=10.0 ** -np.arange(3.0, 9.5, 0.5))


def test_matrices_are_derivatives():
    """What Newton's method takes for the Jacobian, couplings included, of balls that overlap."""
    system, state = cloud(8, capacity=7, joined=True, apart=0.18)

    @jax.jit
    def matrices(system, state):
        step = FullStep.prepare(system, state, jnp.zeros(0), jnp.asarray(5e-3), gauss(1))
        y = step.guess()
        exact = jax.jacfwd(lambda y: step.residual(y)[0])(y)
        return exact, step.jacobian(y, exact=False), sum(p.to_dense() for p in step.products(y))

    exact, found, couplings = matrices(system, state)
    np.testing.assert_allclose(found, exact, atol=1e-9 * np.abs(exact).max())
    assert np.abs(couplings).max() > 1e-3 * np.abs(exact).max()


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
    return system, nc.simulate(system, state, dt=dt, steps=steps, until=None)


def test_what_strays_too_far_is_told():
    """A ball that is stopped within a step strays from its way: shorter steps, at last an error by name."""
    system, trajectory = two_at((0.26, 0, 0), (-8.0, 0, 0))
    assert int(trajectory.steps_rejected) > 0 and nc.balance(system, trajectory).energy.max() <= 1e-12
    names = "'(at rest|flying)' and '(at rest|flying)' in 'all'"
    with pytest.raises(nc.SimulationError, match=names) as told:
        two_at((0.26, 0, 0), (-8.0, 0, 0), skin=1e-5)
    assert told.value.result is nc.Result.MISSED and "`skin`" in str(told.value)


def test_too_many_neighbours_are_told():
    """By name, with what to do; with more room the run goes on."""
    with pytest.raises(nc.SimulationError, match="'ball [0-9]+' and 'ball [0-9]+' in 'all'") as told:
        system, state = cloud(8, capacity=2)
        nc.simulate(system, state, dt=1e-3, steps=3)
    assert told.value.result is nc.Result.OVERFLOW and "`capacity`" in str(told.value)


def test_small_scenes_list_their_pairs():
    """Below fifty balls, without being asked; pairs that are ignored are never in contact."""
    scene, ball = nc.Scene(), {"shape": nc.Sphere(RADIUS), "density": 900.0}
    balls = [scene.add(nc.RigidBody(**ball, position=(0.1 * k, 0, 0))) for k in range(50)]
    assert len(scene.add(nc.Contact(all_pairs_of=balls[:49], stiffness=1e5))) == 49 * 24
    assert len(scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5))) == 1
    scene = nc.Scene()
    balls = [scene.add(nc.RigidBody(**ball, position=(0.1 * k, 0, 0))) for k in range(3)]
    ignored = [balls[:2], balls[1:]]
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5, ignore=ignored, capacity=4))
    system, state = scene.compile()
    assert float(system.energy(state).total) == 0.0
    assert np.abs(np.asarray(nc.simulate(system, state, dt=1e-3, steps=3).v)).max() == 0.0


HARD = "capacity and skin .* of spheres, capsules and points with a stiffness"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"capacity": 4, "stiffness": None}, HARD),
        ({"skin": 0.1, "friction": 0.3}, HARD),
        ({"capacity": 3, "one_pass": True}, "one_pass is no option of spheres"),
        ({"capacity": 0}, "capacity"),
        ({"skin": -0.1}, "skin"),
    ],
)
def test_wrong_input(given, words):
    """What there is no search for, and no numbers."""
    with pytest.raises(ValueError, match=words):
        cloud(3, **given)


def test_wrong_scheme():
    """Orders above two are refused."""
    system, state = cloud(3, capacity=2)
    with pytest.raises(ValueError, match="order two"):
        nc.simulate(system, state, dt=1e-3, steps=2, scheme=nc.EnergyMomentum(order=4))
