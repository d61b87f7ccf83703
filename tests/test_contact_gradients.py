"""Derivatives through contact: their order in the step, what grazes, lanes that differ, aiming by bounces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import assert_v_shaped

import natcoord_jax as nc

FLOOR = nc.Plane(normal=(0, 0, 1))
EXACT = 1.284175
"""Derivative of the height after 1 s by that at the start: a drop of 1 m from 0.3 m/s on a hard floor."""
SOFT = -5.1402e-7
"""The same height by the stiffness of a floor of 1e4 N/m under 1 kg [m^2/N], by pieces of exact solutions."""


def drop(**contact):
    """A mass of 1 kg, 1 m above a floor, that begins with 0.3 m/s upwards."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 1.0), velocity=(0, 0, 0.3), name="mass"))
    scene.add(nc.Contact(mass, FLOOR, name="bounce", **contact))
    return scene.compile()


def at_height(state, by):
    return eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].add(by))


@pytest.mark.slow
def test_derivative_by_stiffness_is_of_order_two():
    """Six steps in a contact are good to 5 %, twelve to 1.5 %; the report counts them and says so."""
    system, state = drop(stiffness=1e4)
    errors = []
    for h in (1e-2, 5e-3, 2.5e-3, 1.25e-3):
        steps = round(1 / h)
        run = lambda k, h=h, steps=steps: nc.simulate(  # noqa: E731
            system.set("bounce", stiffness=k), state, dt=h, steps=steps
        )
        found = float(jax.jvp(lambda k, run=run: run(k).q[-1, 0, 2], (1e4,), (1.0,))[1])
        errors.append(abs(found / SOFT - 1))
        report = nc.contacts(system, run(1e4))
        assert report.steps_in_contact[0] == pytest.approx(0.0314 / h, abs=2.1)
        assert any("fewer than six" in note for note in report.notes) == (h > 5.5e-3)
    assert errors[1] <= 0.05 and errors[2] <= 0.015 and errors[3] <= 0.005
    assert errors[0] / errors[3] > 20


@pytest.mark.slow
def test_derivative_through_an_impact_inside_a_step():
    """That of the program: V-shaped, as the note says, and not the one of the motion."""
    system, state = drop(restitution=1.0)

    def end(x):
        return nc.simulate(system, at_height(state, x), dt=5e-3, steps=200, throw=False).q[-1, 0, 2]

    slope = float(jax.grad(end)(1e-3))
    assert_v_shaped(end, 1e-3, 1.0, slope)
    assert abs(slope - EXACT) > 0.1
    report = nc.contacts(system, nc.simulate(system, at_height(state, 1e-3), dt=5e-3, steps=200))
    assert report.notes == ("impact inside a step: bounce; derivatives are those of the program",)
    # A difference within the margin agrees; the gap moves as the mass does.
    step = 0.2 * float(report.margin.min())
    apart = (end(1e-3 + step) - end(1e-3 - step)) / (2 * step)
    assert float(apart) == pytest.approx(slope, rel=1e-5)


@pytest.mark.slow
def test_grazing():
    """Past a disc: the nearer to its rim, the steeper without a stiffness; with one bounded, and 0 beyond."""
    slopes = {}
    for name, contact in (("hard", {"restitution": 1.0}), ("soft", {"stiffness": 1e4})):
        scene = nc.Scene()
        ball = nc.RigidBody(mass=1.0, inertia=(1.0,) * 3, shape=nc.Sphere(0.5), position=(-2, 0, 0))
        ball = scene.add(ball)
        post = scene.add(nc.RigidBody(mass=1e9, inertia=(1e9,) * 3, shape=nc.Sphere(0.5)))
        scene.add(nc.Contact(post, ball, name="post", **contact))
        system, state = scene.compile()

        def side(b, system=system, state=state):
            given = state.q.at[0, 1].add(b), state.v.at[0, 0].set(1.0)
            start = eqx.tree_at(lambda s: (s.q, s.v), state, given)
            return nc.simulate(system, start, dt=2e-3, steps=1500, throw=False).q[-1, 0, 1]

        slope = jax.jit(jax.grad(side))
        slopes[name] = [float(slope(b)) for b in (0.9, 0.99, 0.99999, 1.001)]
    assert np.isfinite(list(slopes.values())).all()
    hard, soft = np.abs(slopes["hard"]), np.abs(slopes["soft"])
    assert hard[2] > 3 * hard[1] > 6 * hard[0]
    assert soft[2] < 0.5 * hard[2]
    assert slopes["hard"][3] == pytest.approx(1.0) and slopes["soft"][3] == pytest.approx(1.0)


@pytest.mark.slow
def test_lanes_with_other_contacts():
    """64 drops from other heights with friction and spin: each lane has the derivative that it has alone."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = nc.RigidBody(shape=nc.Sphere(0.1), density=300.0, position=(0, 0, 0.2), velocity=(1.0, 0, 0))
    ball = scene.add(ball)
    scene.add(nc.Contact(ball, FLOOR, restitution=0.6, friction=0.2, name="bounce"))
    system, state = scene.compile()

    def run(x):
        return nc.simulate(system, at_height(state, x), dt=0.01, steps=60, throw=False)

    def end(x):
        return run(x).q[-1, 0, 0]

    starts = jnp.linspace(0.0, 0.5, 64)
    together = jax.jit(jax.vmap(jax.value_and_grad(end)))(starts)
    every = jax.jit(jax.vmap(run))(starts)
    report, impacts = nc.contacts(system, every), np.asarray(every.states.contacts)[:, -1, 0, 2]
    assert len(np.unique(impacts)) >= 3
    np.testing.assert_array_equal(report.impacts.sum(axis=(1, 2)), impacts)
    np.testing.assert_allclose(report.gap[..., 0], np.asarray(every.q)[:, :, 0, 2] - 0.1, atol=1e-14)
    alone = jax.jit(jax.value_and_grad(end))
    for k in range(0, 64, 9):
        np.testing.assert_allclose([x[k] for x in together], alone(starts[k]), rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_throw_that_hits_after_two_bounces():
    """Two speeds for two coordinates of a target, by Newton's method through both impacts."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.PointMass(mass=0.5, position=(0, 0, 1.0), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, stiffness=1e4, restitution=0.8, speed=5.0, name="floor"))
    system, state = scene.compile()
    target, dt, steps = jnp.array([3.0, 0.4]), 2e-3, 800

    def thrown(speeds):
        moving = eqx.tree_at(lambda s: s.v, state, state.v.at[0, ::2].add(speeds))
        return nc.simulate(system, moving, dt=dt, steps=steps, throw=False)

    miss = jax.jit(lambda speeds: thrown(speeds).q[-1, 0, ::2] - target)
    slope, speeds = jax.jit(jax.jacfwd(miss)), jnp.array([1.5, 1.0])
    for _ in range(12):
        change = -jnp.linalg.solve(slope(speeds), miss(speeds))
        speeds = speeds + change * jnp.minimum(1.0, 0.5 / jnp.max(jnp.abs(change)))
    assert np.abs(miss(speeds)).max() <= 1e-9
    pushes = np.asarray(nc.contacts(system, thrown(speeds)).active)[:, 0].astype(int)
    assert np.sum(np.diff(pushes) > 0) == 2
