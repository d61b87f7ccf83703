"""Impacts that are located in a step: energy, their order, rest, derivatives of the motion, wrong input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.maths.impact_law import collision_impulses

FLOOR = nc.Plane(normal=(0, 0, 1))
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg
LOCATED = nc.EnergyMomentum(max_events=8)
G = 9.81


def drop(restitution=1.0, height=1.0, speed=0.3, **options):
    """A mass of 1 kg above a floor."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0.5, 0, height), velocity=(0, 0, speed), name="mass"))
    scene.add(nc.Contact(mass, FLOOR, restitution=restitution, name="bounce", **options))
    return scene.compile()


def begun(state, by):
    """Higher by the first, faster by the second."""
    return eqx.tree_at(
        lambda s: (s.q, s.v), state, (state.q.at[0, 2].add(by[0]), state.v.at[0, 2].add(by[1]))
    )


def after_one_bounce(x, v, t, e=1.0):
    """Height and its derivatives by x and v."""
    u = np.sqrt(v**2 + 2 * G * x)
    s = t - (v + u) / G
    rebound, by_u = e * u * s - G * s**2 / 2, e * s - (e * u - G * s) / G
    return rebound, by_u * G / u, by_u * v / u - (e * u - G * s) / G


@pytest.mark.parametrize("h", [0.02, 0.00125])
def test_drop(h):
    """The height after a bounce and its energy do not know of the step."""
    system, state = drop()
    found = nc.simulate(system, state, dt=h, steps=round(1 / h), scheme=LOCATED)
    assert float(found.q[-1, 0, 2]) == pytest.approx(after_one_bounce(1.0, 0.3, 1.0)[0], abs=1e-12)
    assert nc.balance(system, found).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    np.testing.assert_allclose(np.asarray(found.t), h * np.arange(round(1 / h) + 1), atol=1e-13)
    report = nc.contacts(system, found)
    assert report.impacts.sum() == 1 and report.notes == ()


def test_several_bounces_in_a_step():
    """Six in steps longer than the time between two of them, as high each time; e of the speed is left."""
    system, state = drop(height=0.05, speed=0.0)
    found = nc.simulate(system, state, dt=0.35, steps=4, scheme=LOCATED)
    period, speed = 2 * np.sqrt(0.1 / G), np.sqrt(0.1 * G)
    since = (1.4 + period / 2) % period
    assert float(found.q[-1, 0, 2]) == pytest.approx(speed * since - G * since**2 / 2, abs=1e-11)
    assert nc.contacts(system, found).impacts.max() >= 2
    system, state = drop(restitution=0.5, speed=0.0)
    found = nc.simulate(system, state, dt=0.9, steps=1, scheme=LOCATED)
    assert float(found.q[-1, 0, 2]) == pytest.approx(after_one_bounce(1.0, 0.0, 0.9, 0.5)[0], abs=1e-12)
    lost = float(system.work(found)["bounce"][-1])
    assert lost == pytest.approx(-0.75 * G, abs=1e-11)


@pytest.mark.parametrize("gap", [1e-3, 1e-9])
def test_cradle(gap):
    """In steps of a quarter of a second the impacts are in turn: the last ball has all of the speed."""
    scene = nc.Scene()
    places = [-0.3, *(0.2 + gap) * np.arange(1, 5)]
    speeds = [1.0, 0.0, 0.0, 0.0, 0.0]
    balls = [
        scene.add(nc.RigidBody(**BALL, position=(x, 0, 0), velocity=(v, 0, 0)))
        for x, v in zip(places, speeds)
    ]
    for one, other in zip(balls, balls[1:]):
        scene.add(nc.Contact(one, other))
    system, state = scene.compile()
    found = nc.simulate(system, state, dt=0.25, steps=3, scheme=LOCATED)
    final = [float(system.sense(found, ball).velocity[-1, 0]) for ball in balls]
    np.testing.assert_allclose(final, [0, 0, 0, 0, 1], atol=1e-13)
    balance = nc.balance(system, found)
    assert max(balance.energy.max(), balance.momentum.max()) <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.parametrize("restitution", [0.5, 0.0])
def test_comes_to_rest(restitution):
    """Infinitely many bounces end: after so many in a step the law of whole steps makes the rest of it."""
    system, state = drop(restitution=restitution)
    found = nc.simulate(system, state, dt=0.05, steps=60, scheme=LOCATED)
    assert int(found.result) == 0
    assert (
        np.abs(np.asarray(found.v)[-5:]).max() <= 1e-13
        and np.abs(np.asarray(found.q)[-5:, 0, 2]).max() <= 1e-12
    )
    balance = nc.balance(system, found)
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.work(found)["bounce"][-1]) == pytest.approx(-(G + 0.045), rel=1e-12)
    if restitution:
        # The last bounce at the sum of all times of flight.
        u = np.sqrt(0.09 + 2 * G)
        end = (0.3 + u) / G + 2 * u / G * restitution / (1 - restitution)
        still = np.asarray(found.t)[np.abs(np.asarray(found.v)[:, 0, 2]) <= 1e-9]
        assert end - 0.05 <= still.min() <= end + 0.1


def test_more_impacts_than_allowed():
    """The rest of such a step is that of the law for whole steps, and the report says so."""
    system, state = drop(height=0.05, speed=0.0, restitution=0.9)
    found = nc.simulate(system, state, dt=0.35, steps=2, scheme=nc.EnergyMomentum(max_events=1))
    assert int(found.result) == 0
    report = nc.contacts(system, found)
    assert report.notes[0].startswith("impact inside a step: bounce")
    assert nc.balance(system, found).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


def test_box_on_four_corners():
    """Contacts that close at the same instant: no corner is first."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(nc.RigidBody(shape=nc.Box((0.4, 0.6, 0.2)), density=100.0, position=(0, 0, 0.5)))
    scene.add(nc.Contact(box, FLOOR))
    system, state = scene.compile()
    found = nc.simulate(system, state, dt=0.02, steps=40, scheme=LOCATED)
    assert nc.balance(system, found).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    spin = np.asarray(system.sense(found, box).angular_velocity)
    assert np.abs(spin).max() <= 1e-11
    height = 0.1 + after_one_bounce(0.4, 0.0, 0.5)[0]
    assert float(system.sense(found, box).position[25, 2]) == pytest.approx(height, abs=1e-11)


def test_law_of_collisions():
    """No contact pulls; those that push part at e of the speed of closing; energy by the formula."""
    rng = np.random.default_rng(3)
    for count in (1, 3, 6):
        lever = rng.normal(size=(count, 4))  # six contacts of four freedoms: W is singular
        matrix, rates = jnp.asarray(lever @ lever.T), jnp.asarray(lever @ rng.normal(size=4))
        on, e = jnp.ones(count, bool), jnp.full(count, 0.7)
        found = collision_impulses(matrix, rates, e, on)
        plastic = collision_impulses(matrix, rates, 0.0 * e, on)
        parting = rates + matrix @ plastic
        assert plastic.min() >= 0 and parting.min() >= -1e-12 and np.abs(plastic * parting).max() <= 1e-12
        pushing = np.asarray(found) > 0
        np.testing.assert_allclose((rates + matrix @ found)[pushing], -0.7 * rates[pushing], atol=1e-12)
        work = float(found @ (rates + 0.5 * matrix @ found))
        assert work == pytest.approx(-0.5 * (1 - 0.49) * float(plastic @ matrix @ plastic), rel=1e-12)


def test_collision_at_the_end_of_a_seesaw():
    """A beam on two supports that is hit beyond one of them leaves the other, which does not hold it back."""
    scene = nc.Scene()
    beam = scene.add(nc.RigidBody(shape=nc.Box((2.0, 0.1, 0.1)), density=100.0, position=(0, 0, 0.05)))
    for x in (-0.3, 0.3):
        support = (
            nc.Point(nc.ground, (x, 0, 0)),
            nc.Direction(nc.ground, (0, 0, 1)),
            nc.Point(beam, (x, 0, 0)),
        )
        scene.add(nc.GapConstraint(support, nc.SphereOnPlane(radius=0.0), restitution=0.0))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0.9, 0, 0.3), velocity=(0, 0, -1.0)))
    top = nc.Point(beam, (0.9, 0, 0.1)), nc.Direction(beam, (0, 0, 1)), nc.Point(ball)
    scene.add(nc.GapConstraint(top, nc.SphereOnPlane(radius=0.0)))
    system, state = scene.compile()
    found = nc.simulate(system, state, dt=0.1, steps=3, scheme=LOCATED)
    spin = np.asarray(system.sense(found, beam).angular_velocity)[-1]
    assert spin[1] > 0.1
    assert nc.balance(system, found).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


def bounces(x, v, t):
    """Height after any number of bounces that lose nothing, and its derivatives."""
    u = np.sqrt(v**2 + 2 * G * x)
    first = (v + u) / G
    number = np.where(t > first, np.floor((t - first) * G / (2 * u)) + 1, 0)
    s = t - first - (number - 1) * 2 * u / G
    turned = s - (u - G * s) * (2 * number - 1) / G  # by u
    height = np.where(number > 0, u * s - G * s**2 / 2, x + v * t - G * t**2 / 2)
    by_x = np.where(number > 0, turned * G / u, 1.0)
    return height, by_x, np.where(number > 0, turned * v / u - (u - G * s) / G, t), number


@pytest.mark.slow
def test_derivatives_of_a_drop():
    """Those of the motion at any step, forward and in reverse; also by the restitution and gravity."""
    system, state = drop()

    def end(by, e, dt, steps):
        given = nc.simulate(
            system.set("bounce", restitution=e),
            begun(state, by),
            dt=dt,
            steps=nc.Steps(steps, 800),
            scheme=LOCATED,
            throw=False,
        )
        return given.q[-1, 0, 2]

    forward, reverse = (jax.jit(d(end, argnums=(0, 1))) for d in (jax.jacfwd, jax.grad))
    exact = after_one_bounce(1.0, 0.3, 1.0)[1:]
    np.testing.assert_allclose(exact, (1.284175, 0.103574), atol=1e-6)
    u = np.sqrt(0.09 + 2 * G)
    for h in (0.02, 0.005, 0.00125):
        for found in (f(jnp.zeros(2), 1.0, h, round(1 / h)) for f in (forward, reverse)):
            np.testing.assert_allclose(found[0], exact, rtol=0, atol=1e-12)
            assert float(found[1]) == pytest.approx(u * (1 - (0.3 + u) / G), abs=1e-12)


@pytest.mark.slow
def test_lanes_with_other_impacts():
    """64 drops from other heights, of none to five bounces: each lane has the derivative of its own motion."""
    system, state = drop(speed=0.0)

    def end(by):
        return nc.simulate(system, begun(state, by), dt=0.02, steps=50, scheme=LOCATED, throw=False).q[
            -1, 0, 2
        ]

    starts = jnp.stack([jnp.linspace(-0.95, 4.5, 64), jnp.linspace(-0.4, 0.4, 64)], axis=1)
    height, slope = jax.jit(jax.vmap(jax.value_and_grad(end)))(starts)
    *exact, number = bounces(1.0 + starts[:, 0], starts[:, 1], 1.0)
    assert len(np.unique(number)) >= 4
    np.testing.assert_allclose(height, exact[0], atol=1e-11)
    np.testing.assert_allclose(slope, np.stack(exact[1:], axis=1), rtol=1e-10, atol=1e-10)
