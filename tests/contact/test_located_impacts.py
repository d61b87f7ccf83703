"""Impacts that are located in a step: energy, their order, rest, derivatives of the motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import BALL, FLOOR
from differences import assert_v_shaped

import natcoord_jax as nc

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


def falls(restitution, height, speed, *, dt, steps):
    """A run of that many steps; all share one program."""
    system, state = drop()
    system = system.set("bounce", restitution=restitution)
    start = begun(state, (height - 1.0, speed - 0.3))
    trajectory = nc.simulate(system, start, dt=dt, steps=nc.Steps(steps, 240), scheme=LOCATED)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    return system, trajectory


@pytest.mark.slow
def test_a_bounce_does_not_know_of_the_step():
    """Its height and energy, at any length of the step, of several bounces in one, too."""
    for h in (0.02, 0.005):
        system, run = falls(1.0, 1.0, 0.3, dt=h, steps=round(1 / h))
        assert float(run.q[-1, 0, 2]) == pytest.approx(after_one_bounce(1.0, 0.3, 1.0)[0], abs=1e-12)
        t = np.asarray(run.t)[: round(1 / h) + 1]
        np.testing.assert_allclose(t, h * np.arange(len(t)), atol=1e-13)
        report = nc.contacts(system, run)
        assert report.impacts.sum() == 1 and report.notes == ()
    # Six bounces in steps longer than the time between two of them, as high each time.
    system, run = falls(1.0, 0.05, 0.0, dt=0.35, steps=4)
    period, speed = 2 * np.sqrt(0.1 / G), np.sqrt(0.1 * G)
    since = (1.4 + period / 2) % period
    assert float(run.q[-1, 0, 2]) == pytest.approx(speed * since - G * since**2 / 2, abs=1e-11)
    assert nc.contacts(system, run).impacts.max() >= 2
    system, run = falls(0.5, 1.0, 0.0, dt=0.9, steps=1)
    assert float(run.q[-1, 0, 2]) == pytest.approx(after_one_bounce(1.0, 0.0, 0.9, 0.5)[0], abs=1e-12)
    assert float(system.work(run)["bounce"][-1]) == pytest.approx(-0.75 * G, abs=1e-11)
    # Infinitely many end: after so many in a step the law of whole steps makes what is left of it.
    for restitution in (0.5, 0.0):
        system, run = falls(restitution, 1.0, 0.3, dt=0.05, steps=60)
        assert np.abs(np.asarray(run.v)[-5:]).max() <= 1e-13
        assert np.abs(np.asarray(run.q)[-5:, 0, 2]).max() <= 1e-11
        assert float(system.work(run)["bounce"][-1]) == pytest.approx(-(G + 0.045), rel=1e-11)
        if restitution:
            # The last bounce at the sum of all times of flight.
            u = np.sqrt(0.09 + 2 * G)
            end = (0.3 + u) / G + 2 * u / G * restitution / (1 - restitution)
            still = np.asarray(run.t)[np.abs(np.asarray(run.v)[:, 0, 2]) <= 1e-9]
            assert end - 0.05 <= still.min() <= end + 0.1


@pytest.mark.exhaustive
def test_a_cradle():
    """In steps of a quarter of a second the impacts are in turn: the last ball has all of the speed."""
    for gap in (1e-3, 1e-9):
        scene = nc.Scene()
        balls = [
            scene.add(nc.RigidBody(**BALL, position=(x, 0, 0), velocity=(v, 0, 0)))
            for x, v in zip([-0.3, *(0.2 + gap) * np.arange(1, 5)], (1.0, 0.0, 0.0, 0.0, 0.0))
        ]
        for one, other in zip(balls, balls[1:]):
            scene.add(nc.Contact(one, other))
        system, state = scene.compile()
        run = nc.simulate(system, state, dt=0.25, steps=3, scheme=LOCATED)
        final = [float(system.sense(run, ball).velocity[-1, 0]) for ball in balls]
        np.testing.assert_allclose(final, [0, 0, 0, 0, 1], atol=1e-13)
        balance = nc.balance(system, run)
        assert max(balance.energy.max(), balance.momentum.max()) <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.exhaustive
def test_more_impacts_than_allowed():
    """What is left of such a step is that of the law for whole steps, and the report says so."""
    system, state = drop(height=0.05, speed=0.0, restitution=0.9)
    run = nc.simulate(system, state, dt=0.35, steps=2, scheme=nc.EnergyMomentum(max_events=1))
    assert int(run.result) == 0
    report = nc.contacts(system, run)
    assert report.notes[0].startswith("impact inside a step: bounce")
    assert nc.balance(system, run).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.exhaustive
def test_box_on_four_corners():
    """Contacts that close at the same instant: no corner is first."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(nc.RigidBody(shape=nc.Box((0.4, 0.6, 0.2)), density=100.0, position=(0, 0, 0.5)))
    scene.add(nc.Contact(box, FLOOR))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.02, steps=40, scheme=LOCATED)
    assert nc.balance(system, run).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    spin = np.asarray(system.sense(run, box).angular_velocity)
    assert np.abs(spin).max() <= 1e-11
    height = 0.1 + after_one_bounce(0.4, 0.0, 0.5)[0]
    assert float(system.sense(run, box).position[25, 2]) == pytest.approx(height, abs=1e-11)


@pytest.mark.exhaustive
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
    run = nc.simulate(system, state, dt=0.02, steps=15, scheme=LOCATED)
    spin = np.asarray(system.sense(run, beam).angular_velocity)[-1]
    assert spin[1] > 0.1
    assert nc.balance(system, run).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


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


@pytest.mark.exhaustive
def test_derivatives_of_a_drop():
    """Those of the motion at any step, forward and in reverse; also by the restitution and gravity."""
    system, state = drop()

    def end(by, e, dt, steps):
        run = nc.simulate(
            system.set("bounce", restitution=e),
            begun(state, by),
            dt=dt,
            steps=nc.Steps(steps, 800),
            scheme=LOCATED,
            throw=False,
        )
        return run.q[-1, 0, 2]

    forward, reverse = (jax.jit(d(end, argnums=(0, 1))) for d in (jax.jacfwd, jax.grad))
    exact = after_one_bounce(1.0, 0.3, 1.0)[1:]
    np.testing.assert_allclose(exact, (1.284175, 0.103574), atol=1e-6)
    u = np.sqrt(0.09 + 2 * G)
    for h in (0.02, 0.005, 0.00125):
        for by_start, by_restitution in (f(jnp.zeros(2), 1.0, h, round(1 / h)) for f in (forward, reverse)):
            np.testing.assert_allclose(by_start, exact, rtol=0, atol=1e-12)
            assert float(by_restitution) == pytest.approx(u * (1 - (0.3 + u) / G), abs=1e-12)


@pytest.mark.exhaustive
def test_derivatives_in_the_full_form():
    """The time of an impact depends on the start, whichever equations say what a part of a step is."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 1.0), velocity=(0, 0, 0.3), name="mass"))
    scene.add(nc.Contact(mass, FLOOR, restitution=1.0, name="bounce"))
    system, state = scene.compile(solver="full")

    def end(by):
        moved = begun(state, by)
        return nc.simulate(system, moved, dt=0.02, steps=50, scheme=LOCATED, throw=False).q[-1, 0, 2]

    np.testing.assert_allclose(
        jax.jit(jax.grad(end))(jnp.zeros(2)), after_one_bounce(1.0, 0.3, 1.0)[1:], atol=1e-12
    )


@pytest.mark.exhaustive
def test_lanes_with_other_impacts():
    """64 drops from other heights, of none to five bounces: each has the derivative of its own motion."""
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


@pytest.mark.exhaustive
def test_derivatives_where_surfaces_graze():
    """A throw at a ceiling: steeper the more slowly it is met, finite at the top, and flagged there."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0.5, 0, 0), velocity=(0, 0, 0.0), name="mass"))
    scene.add(nc.Contact(mass, nc.Plane(normal=(0, 0, -1), point=(0, 0, 1.0)), name="ceiling"))
    system, state = scene.compile()

    def run(v):
        return nc.simulate(system, begun(state, (0.0, v)), dt=0.02, steps=40, scheme=LOCATED, throw=False)

    slope = jax.jit(jax.jacfwd(lambda v: run(v).q[-1, 0, 2]))
    top = np.sqrt(2 * G)
    for faster in (1e-2, 1e-4, 1e-6):
        v = top * (1 + faster)
        w = np.sqrt(v**2 - 2 * G)
        # It falls as if it had been thrown later by twice the time that it would have been beyond.
        late = 0.8 + 2 * w / G
        assert float(slope(v)) == pytest.approx(late + (v - G * late) * 2 * v / (w * G), rel=1e-7)
        assert nc.contacts(system, run(v)).notes == ()
    for beside in (-1e-15, 0.0, 1e-15, 1e-13):
        assert np.isfinite(slope(top * (1 + beside)))
        assert nc.contacts(system, run(top * (1 + beside))).notes[0].startswith("grazing: ceiling")
    assert float(slope(top * (1 - 1e-6))) == pytest.approx(0.8, abs=1e-12)


@pytest.mark.exhaustive
def test_throw_that_hits_after_two_bounces():
    """Spin, friction, two speeds for two coordinates of a target, by Newton's method through both bounces."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = nc.RigidBody(**BALL, position=(0, 0, 1.0), angular_velocity=(0, 10, 0), name="ball")
    scene.add(nc.Contact(scene.add(ball), FLOOR, restitution=0.8, friction=0.3, name="floor"))
    system, state = scene.compile()

    def thrown(speeds):
        moving = eqx.tree_at(lambda s: s.v, state, state.v.at[0, ::2].add(speeds))
        return nc.simulate(system, moving, dt=0.02, steps=70, scheme=LOCATED, throw=False)

    def miss(speeds):
        return thrown(speeds).q[-1, 0, ::2] - jnp.array([3.0, 0.35])

    miss, slope, speeds = jax.jit(miss), jax.jit(jax.jacfwd(miss)), jnp.array([1.5, 1.0])
    for _ in range(15):
        change = -jnp.linalg.solve(slope(speeds), miss(speeds))
        speeds = speeds + change * jnp.minimum(1.0, 0.5 / jnp.max(jnp.abs(change)))
    assert np.abs(miss(speeds)).max() <= 1e-12
    report = nc.contacts(system, thrown(speeds))
    assert report.impacts.sum() == 2 and report.notes == ()
    along = jnp.array([1.0, 0.5])
    assert_v_shaped(miss, speeds, along, slope(speeds) @ along)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kick", [None, True])
def test_derivatives_of_a_joint(kick):
    """A pendulum meets a wall; the gap is no straight function of how long a part of a step is."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(1.0, 0, 0), name="bob"))
    hinge = scene.add(nc.Revolute(nc.ground, ball, axis=(0, 0, 1), point=(0, 0, 0)))
    scene.add(nc.Contact(ball, nc.Plane(normal=(0, -1, 0), point=(0, 0.6, 0)), restitution=0.7))
    system, state = scene.compile()

    def run(rate):
        start = system.with_coordinate(state, hinge, 0.0, rate=rate)
        scheme = nc.EnergyMomentum(kick=kick, max_events=4)
        return nc.simulate(system, start, dt=0.07, steps=10, scheme=scheme, throw=False)

    moved = run(2.0)
    assert float(system.sense(moved, hinge).rates[-1, 0]) == pytest.approx(-1.4, rel=1e-12)
    assert nc.balance(system, moved).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    angle = jax.jit(lambda rate: run(rate).states.coordinates[-1, 0])
    slope = jax.jit(jax.grad(angle))
    assert_v_shaped(angle, 2.0, 1.0, slope(2.0))
    if kick is None:
        bend = jax.jit(lambda rate: jax.jvp(slope, (rate,), (1.0,))[1])
        assert_v_shaped(slope, 2.0, 1.0, bend(2.0))


@pytest.mark.exhaustive
def test_states_go_from_scheme_to_scheme():
    """A run goes on with whole steps, and the other way round; one step at a time is the same."""
    system, state = drop()
    run = nc.simulate(system, state, dt=0.05, steps=12, scheme=LOCATED)
    back = nc.simulate(system, run[-1], dt=0.05, steps=2)
    again = nc.simulate(system, back[-1], dt=0.05, steps=2, scheme=LOCATED)
    for part in (back, again):
        assert nc.balance(system, part).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    one = state
    for _ in range(12):
        one = nc.step(system, one, dt=0.05, scheme=LOCATED)
    np.testing.assert_allclose(np.asarray(one.q), np.asarray(run.q)[-1], atol=1e-14)
