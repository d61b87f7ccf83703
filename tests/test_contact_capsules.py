"""Capsules and spheres that look for their neighbours: found as by all pairs, pushed as by listed ones."""

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
from natcoord_jax.effects.contact.near_capsules import near_capsules
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.near_spheres import each_once
from natcoord_jax.mechanics.full import FullStep

RADIUS, LENGTH = 0.1, 0.2
SEARCH = jax.jit(near_capsules, static_argnums=3)


def links(count, listed=False, joined=False, apart=0.34, **contact):
    """Capsules and, each third, balls on a lattice, with velocities at random, and contact of each with each.

    The first two may hang on each other by a joint; the second and the third are then ignored.
    """
    random, edge = np.random.default_rng(3), int(np.ceil(count ** (1 / 3)))
    lattice = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    places = apart * lattice + 0.01 * random.normal(size=lattice.shape)
    velocities = 2.0 * random.normal(size=places.shape) + (1.0, 0, 0)
    spins = 3.0 * random.normal(size=places.shape)
    if joined:
        velocities[:2], spins[:2] = velocities[0], 0.0
    scene, bodies = nc.Scene(), []
    for k, (x, v, w) in enumerate(zip(places, velocities, spins)):
        body = {"shape": nc.Sphere(RADIUS) if k % 3 == 2 else nc.Capsule(RADIUS, LENGTH), "density": 900.0}
        moving = {"position": x, "velocity": v, "angular_velocity": w}
        bodies.append(scene.add(nc.RigidBody(**body, **moving, name=f"link {k}")))
    if joined:
        scene.add(nc.Spherical(*bodies[:2], point=0.5 * (places[0] + places[1])))
    ignored = [tuple(bodies[1:3])] if joined else []
    law = {"stiffness": 2e5, **contact}
    if listed:
        out = [set(bodies[:2]), set(bodies[1:3])] if joined else []
        for pair in combinations(bodies, 2):
            if set(pair) not in out:
                scene.add(nc.Contact(*pair, **law))
    else:
        scene.add(nc.Contact(all_pairs_of=bodies, ignore=ignored, name="all", **{"capacity": 7, **law}))
    return scene.compile()


def segments(count):
    """Ends of segments, each third of no length, and radii, at random in a box with some room."""
    random, edge = np.random.default_rng(count), 0.17 * count ** (1 / 3)
    middle, half = random.uniform(-edge, edge, (3, count)), 0.5 * LENGTH * random.normal(size=(3, count))
    half[:, ::3] = 0.0
    return jnp.asarray(np.stack([middle - half, middle + half])), random.uniform(0.5, 1.0, count) * RADIUS


def distances(ends):
    """Of each segment from each, from many points of either."""
    along = np.linspace(0.0, 1.0, 41)[:, None, None]
    points = np.asarray(ends[0] + along * (ends[1] - ends[0]))  # (41, 3, n)
    apart = [np.linalg.norm(points[..., None] - p[:, None], axis=1).min(axis=0) for p in points]
    return np.min(apart, axis=0)


@pytest.mark.parametrize("count", (3, 60))
def test_search_equals_all_pairs(count):
    """All that touch are found, from both sides, and nothing that does not; pairs are each there once."""
    ends, radii = segments(count)
    exempt = jnp.full((count, 1), -1).at[0, 0].set(1).at[1, 0].set(0)
    found = SEARCH(ends, jnp.asarray(radii), exempt, 20)
    assert (np.asarray(found.left_out) == -1).all()
    seen = {(int(a), int(found.others[a, k])) for a, k in zip(*np.nonzero(np.asarray(found.near)))}
    gaps = distances(ends) - radii - radii[:, None]
    np.fill_diagonal(gaps, 1.0)
    gaps[0, 1] = gaps[1, 0] = 1.0
    # What points of the segments tell is the distance but for half of their spacing.
    assert set(map(tuple, np.argwhere(gaps <= 0).tolist())) <= seen
    assert seen <= set(map(tuple, np.argwhere(gaps <= 0.02 * LENGTH).tolist()))
    pairs = each_once(found)
    there = np.asarray(pairs.both).T[np.asarray(pairs.there)]
    assert sorted(map(tuple, there.tolist())) == sorted(p for p in seen if p[0] < p[1])
    numbers = jnp.asarray(np.random.default_rng(0).normal(size=pairs.both.shape))
    wanted = np.zeros(count)
    for k in np.flatnonzero(np.asarray(pairs.there)):
        wanted[np.asarray(pairs.both[:, k])] += np.asarray(numbers[:, k])
    np.testing.assert_allclose(pairs.summed(numbers), wanted, atol=1e-13)


def test_no_room_is_told():
    """Of what touches; what only the spheres around capsules touch needs none."""
    ends = jnp.zeros((2, 3, 12)).at[1, 0].set(1.0).at[:, 1].set(0.05 * jnp.arange(12))
    none = jnp.full((12, 0), -1)
    thin, thick = (SEARCH(ends, jnp.full(12, r), none, 3) for r in (0.03, 0.06))
    assert (np.asarray(thin.left_out) == -1).all() and int(jnp.sum(thin.near)) == 22
    one, other = np.asarray(thick.left_out)
    assert one >= 0 and abs(one - other) <= 2


def test_energies_are_those_of_listed_pairs():
    """Of capsules and balls that overlap in the assembled pose, some of them in no contact."""
    given = {"joined": True, "apart": 0.2}
    found = [
        float(s.energy(x).total - s.energy(x).kinetic)
        for s, x in (links(6, **given), links(6, True, **given))
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-12) and found[1] > 1.0


@pytest.mark.slow
def test_motion_is_that_of_listed_pairs():
    """Some of them, two of which are joined and two ignored, against a gap of each pair: to rounding."""
    given, found = {"joined": True, "restitution": 0.6, "speed": 3.0, "law": "hertz"}, []
    for listed in (False, True):
        system, state = links(6, listed, **given)
        trajectory = nc.simulate(system, state, dt=1e-3, steps=120)
        works = sum(np.asarray(x) for x in system.energy(trajectory).stores.values())
        found.append((np.asarray(trajectory.q), works))
        assert nc.balance(system, trajectory).energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-11)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-9 * found[1][1].max())
    assert found[1][1].max() > 0.1


@pytest.mark.slow
def test_a_cloud_keeps_what_it_should():
    """Fifty that collide in free flight: energy, momentum, angular momentum; Newton's method is quick."""
    system, state = links(50, capacity=None)
    assert [type(group.effect) for group in system.effects] == [CapsuleContacts]
    trajectory = nc.simulate(system, state, dt=1e-3, steps=80)
    assert int(trajectory.iterations) <= 8 * 80
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert balance.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    stored = np.asarray(system.energy(trajectory).stores["all"])
    assert stored.max() > 0.05 * np.asarray(system.energy(trajectory).kinetic).max()


@pytest.mark.exhaustive
def test_derivatives_and_lanes():
    """Where they are after collisions by how fast one of them is, in both modes and in a batch."""
    system, state = links(5, capacity=4)

    def spread(x):
        start = eqx.tree_at(lambda s: s.v, state, state.v.at[0].add(x * jnp.array([1.0, 0.5, 0.2])))
        return jnp.sum(nc.simulate(system, start, dt=1e-3, steps=50).q[-1, ::4] ** 2)

    slope = jax.grad(spread)(0.0)
    assert float(jax.jvp(spread, (0.0,), (1.0,))[1]) == pytest.approx(float(slope), rel=tol.SAME_GRADIENT)
    alone = jax.jit(spread)
    assert_v_shaped(alone, 0.0, 1.0, slope, steps=10.0 ** -np.arange(1.5, 8.0, 0.5))
    lanes = jnp.array([0.0, -1.0, 0.5])
    np.testing.assert_allclose(jax.vmap(spread)(lanes), [alone(x) for x in lanes], rtol=1e-12)


def test_matrices_are_nearly_derivatives():
    """What Newton's method takes for the Jacobian, of capsules and balls that overlap and hardly turn."""
    system, state = links(5, capacity=4, joined=True, apart=0.2)
    slow = eqx.tree_at(lambda s: s.v, state, 0.01 * state.v)

    @jax.jit
    def matrices(system, state):
        step = FullStep.prepare(system, state, jnp.zeros(0), jnp.asarray(1e-3), gauss(1))
        y = step.guess()
        exact = jax.jacfwd(lambda y: step.residual(y)[0])(y)
        return exact, step.jacobian(y, exact=False), sum(p.to_dense() for p in step.products(y))

    exact, found, couplings = matrices(system, slow)
    forces = np.abs(couplings).max()
    assert forces > 1e-3 * np.abs(exact).max()
    np.testing.assert_allclose(found, exact, atol=0.02 * forces)


def test_wrong_markers():
    """Ends that are not of one body, and markers that are neither centres nor ends."""
    scene = nc.Scene()
    one, other = (scene.add(nc.PointMass(mass=1.0, position=(x, 0, 0))) for x in (0.0, 1.0))
    with pytest.raises(ValueError, match="first ends of all segments and then"):
        nc.CapsuleContacts((nc.Point(one), nc.Point(other)), radii=(0.1,), stiffness=1.0)
    with pytest.raises(ValueError, match="3 markers and 2 radii"):
        nc.CapsuleContacts((nc.Point(one),) * 3, radii=(0.1, 0.1), stiffness=1.0)


@pytest.mark.exhaustive
def test_too_many_neighbours_are_told():
    """By name, with what to do."""
    with pytest.raises(nc.SimulationError, match="'link [0-9]+' and 'link [0-9]+' in 'all'") as told:
        system, state = links(8, capacity=1)
        nc.simulate(system, state, dt=1e-3, steps=3)
    assert told.value.result is nc.Result.OVERFLOW and "`capacity`" in str(told.value)
