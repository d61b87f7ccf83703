"""Inverse dynamics and computed torque: paths are followed, with parts that no input acts on."""

import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc


def smooth(s):
    return 10 * s**3 - 15 * s**4 + 6 * s**5


@pytest.fixture(scope="module")
def flexible_arm():
    """A motor-driven rod with a soft beam at its end, under gravity."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), com=(0.25, 0, 0), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    section = nc.CircularSection(radius=0.01, E=2e7, density=1000.0)
    beam = scene.add(nc.Beam(section, [(0.5, 0, 0), (1.1, 0, 0)], elements=6, start=rod, damping=0.02))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return (*scene.compile(), beam)


@pytest.mark.exhaustive
def test_a_flexible_arm_follows_the_path(flexible_arm):
    system, state, beam = flexible_arm
    assert system.structure.solver == "recursive"
    steps, dt = 50, 0.01
    path = 1.2 * smooth(np.linspace(0.0, 1.0, steps + 1)[1:, None])
    inputs, states = nc.inverse_dynamics(system, state, path, dt=dt)
    run = nc.simulate(system, state, dt=dt, inputs=inputs)
    assert float(jnp.abs(run.states.coordinates[1:] - path).max()) < 1e-10
    np.testing.assert_allclose(states.q, run.q[1:], atol=1e-9)
    assert nc.balance(system, run).energy.max() < 1e-11
    # The beam lags behind: it is not part of what is prescribed.
    tip = system.sense(run, beam.end).position[-1]
    angle = float(np.arctan2(-tip[2], tip[0]))
    assert abs(angle - 1.2) > 0.02


@pytest.mark.slow
def test_a_passive_joint_moves_as_it_must():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cart = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="cart"))
    pole = scene.add(nc.RigidBody(mass=0.3, inertia=(0.01, 0.01, 0.01), com=(0, 0, -0.5), name="pole"))
    rail = scene.add(nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="rail"))
    hinge = scene.add(nc.Revolute(cart, pole, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointForce(rail, name="push"))
    system, state = scene.compile()
    path = 0.8 * smooth(np.linspace(0.0, 1.0, 41)[1:, None])
    inputs, states = nc.inverse_dynamics(system, state, path, dt=0.02, joints=[rail])
    run = nc.simulate(system, state, dt=0.02, inputs=inputs)
    np.testing.assert_allclose(states.q, run.q[1:], atol=1e-11)
    np.testing.assert_allclose(system.coordinate(run, rail)[1:], path[:, 0], atol=1e-11)
    assert float(jnp.abs(system.coordinate(run, hinge)).max()) > 0.2
    # Momentum: the push is all that acts along the rail.
    pushed = 0.02 * np.cumsum(inputs[:, 0])
    np.testing.assert_allclose(system.momentum(run)[1:, 0], pushed, atol=1e-10)
    with pytest.raises(ValueError, match="cannot bring about the path in step 0.*joints="):
        twice = np.concatenate([path, path], axis=1)
        nc.inverse_dynamics(system, state, twice, dt=0.02)
    with pytest.raises(ValueError, match=r"shape \(40, 2\).*'rail \[0\]'"):
        nc.inverse_dynamics(system, state, twice, dt=0.02, joints=["rail"])


@pytest.mark.exhaustive
def test_computed_torque_holds_an_unstable_path(flexible_arm):
    system, state, _ = flexible_arm
    steps, dt = 50, 0.01
    path = -1.4 * smooth(np.linspace(0.0, 1.0, steps + 1)[1:, None])  # up, where gravity pulls it down
    control = nc.computed_torque(system, state, path, dt=dt, bandwidth=40.0)
    run = nc.simulate(system, state, dt=dt, steps=steps, inputs=control)
    np.testing.assert_allclose(run.states.coordinates[1:], path, atol=1e-10)
    pushed = system.with_coordinate(state, "hinge", 0.05)
    run = nc.simulate(system, pushed, dt=dt, steps=steps, inputs=control)
    error = run.states.coordinates[1:] - path
    # What is left is the beam, which the push has set swinging.
    assert float(abs(error[0, 0])) > 0.03 and float(abs(error[-1, 0])) < 0.01


@pytest.mark.slow
def test_errors_decay_at_the_bandwidth():
    """On a disc the error is that of the formulas, with a double pole."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
    hinge = scene.add(nc.Revolute(nc.ground, disc))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    dt, bandwidth, steps = 0.1, 3.0, 40
    control = nc.computed_torque(system, state, np.zeros((steps, 1)), dt=dt, bandwidth=bandwidth)
    # So small that the angle of a step is its tangent.
    push = 1e-4
    pushed = system.with_coordinate(state, hinge, push)
    run = nc.simulate(system, pushed, dt=dt, steps=steps, inputs=control)
    p = np.exp(-bandwidth * dt)
    alpha, beta = (1 - p) ** 2 / 2, (1 - p) * (3 + p) / 4
    matrix = np.array([[1 - alpha, 1 - beta], [-2 * alpha, 1 - 2 * beta]])
    np.testing.assert_allclose(np.linalg.eigvals(matrix), p, atol=1e-7)
    expected = [(np.linalg.matrix_power(matrix, k) @ [push, 0.0])[0] for k in range(steps + 1)]
    np.testing.assert_allclose(run.states.coordinates[:, 0], expected, atol=1e-14)
