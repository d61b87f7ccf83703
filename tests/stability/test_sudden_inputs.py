"""Inputs that jump: blows, switched torques, motion that is prescribed for a while.

What could go wrong: a guess from the past that is far off after a jump; work and impulses that are booked at
another time than they act; a retried step that applies a blow twice; prescribed motion whose kinks leave
velocities behind.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from motions import SECOND_AND_FOURTH, simulate

import natcoord_jax as nc

pytestmark = pytest.mark.slow

STEP, STEPS = 0.01, 200


@cache
def craft():
    """A free body with a wheel: three torquers and a thruster on the body, a motor on the wheel."""
    scene = nc.Scene()
    base = scene.add(nc.RigidBody(mass=10.0, inertia=(2.0, 3.0, 4.0), name="base"))
    wheel = nc.RigidBody(mass=2.0, inertia=(0.2, 0.2, 0.3), position=(0.0, 0.0, 0.5), name="wheel")
    hinge = scene.add(
        nc.Revolute(base, scene.add(wheel), point=(0.0, 0.0, 0.5), axis=(0.0, 0.0, 1.0), name="axle")
    )
    scene.add(nc.JointTorque(hinge, name="motor"))
    thruster = nc.BodyForceInput((nc.Point(base, (0.3, 0.0, 0.0)), nc.Direction(base, (0.0, 1.0, 0.0))))
    scene.add(thruster)
    torquers = tuple(nc.Direction(base, axis) for axis in np.eye(3))
    scene.add(nc.BodyTorqueInput(torquers))
    return scene.compile()


def history(kind: str):
    """Inputs by step: motor, thruster, three torques."""
    generator = np.random.default_rng(1)
    number = np.arange(STEPS)
    inputs = np.zeros((STEPS, 5))
    if kind == "blow":  # 10 N m s and 5 N s within one step
        inputs[20] = np.array([10.0, 5.0, -10.0, 7.0, 3.0]) / STEP
    elif kind == "bang":
        inputs = np.where((number[:, None] // np.array([7, 11, 13, 5, 3])) % 2, 20.0, -20.0)
    elif kind == "noise":
        inputs = 50.0 * generator.normal(size=inputs.shape)
    return jnp.asarray(inputs)


@pytest.mark.parametrize("kind", ["blow", "bang", "noise"])
@SECOND_AND_FOURTH
def test_jumping_inputs(order, kind):
    """Energy is the work done, at round-off; momentum changes by the impulse, and by nothing else."""
    system, state = craft()
    inputs = history(kind)
    trajectory = simulate(system, state, order=order, dt=STEP, inputs=inputs, extra_substeps=600)
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
    quiet = np.all(np.asarray(inputs)[:, 1:] == 0.0, axis=1)
    total, spin = found.momenta.sum(axis=1), found.spins.sum(axis=1)
    scale = np.max(np.linalg.norm(found.momenta, axis=-1).sum(axis=1))
    turning = np.max(np.linalg.norm(found.spins, axis=-1).sum(axis=1))
    moved = np.linalg.norm(np.diff(total, axis=0), axis=-1)
    turned = np.linalg.norm(np.diff(spin, axis=0), axis=-1)
    assert np.max(moved[quiet], initial=0.0) <= tol.MOMENTUM * scale
    assert np.max(turned[quiet], initial=0.0) <= tol.ANGULAR_MOMENTUM * turning
    thrust = np.abs(np.asarray(inputs)[:, 1]) * STEP
    assert np.all(moved <= thrust + tol.MOMENTUM * scale), "more momentum than the thruster gives"


@SECOND_AND_FOURTH
def test_a_blow_is_the_impulse_whatever_the_step(order):
    """One step of torque 1/h turns the body at rest as an impulse does: the same spin to first order."""
    system, state = craft()
    spins = []
    for h in (1e-4, 1e-6, 1e-8):
        inputs = jnp.zeros((4, 5)).at[1].set(jnp.array([0.0, 0.0, 1.0, 0.0, 0.0]) / h)
        found = simulate(system, state, order=order, dt=h, inputs=inputs)
        spins.append(system.angular_momentum(found)[-1])
    np.testing.assert_allclose(spins[-1], [1.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(spins[1], spins[2], atol=1e-6)


# --- prescribed motion ------------------------------------------------------------------------------------

AWAY, BACK = 0.5, 1.2  # [s], ends of steps


def switched(t):
    """Rest, 4 rad/s from 0.5 s to 1.2 s, rest again."""
    return 4.0 * (jnp.clip(t, AWAY, BACK) - AWAY)


@cache
def driven(on: bool):
    """A pendulum on a crank, with a drive on the crank or without."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    crank = nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=(0.2, 0.0, 0.0), name="crank")
    crank = scene.add(crank)
    axle = scene.add(nc.Revolute(nc.ground, crank, point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="axle"))
    bob = nc.RigidBody(
        mass=1.0, inertia=(0.05, 0.06, 0.07), com=(0.0, 0.0, -0.3), position=(0.5, 0.0, 0.0), name="bob"
    )
    scene.add(
        nc.Universal(
            crank,
            scene.add(bob),
            point=(0.5, 0.0, 0.0),
            axis=(0.0, 1.0, 0.0),
            second=(1.0, 0.0, 0.0),
            name="ball",
        )
    )
    if on:
        scene.add(nc.Drive(axle, function=switched, name="drive"))
    return scene.compile()


@SECOND_AND_FOURTH
def test_prescribed_motion_switched_on_and_off(order):
    """Kinks at ends of steps: the angle is the prescribed one, and energy is the drive's work."""
    system, state = driven(True)
    trajectory = simulate(system, state, order=order, dt=STEP, steps=STEPS, extra_substeps=STEPS)
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
    angle = np.asarray(system.coordinate(trajectory, "axle"))
    np.testing.assert_allclose(angle, np.asarray(switched(trajectory.t)), atol=tol.CONSTRAINT)
    assert abs(float(system.work(trajectory)["drive"][-1])) > 1.0


@SECOND_AND_FOURTH
def test_a_drive_that_lets_go(order):
    """A state that a drive left behind is the start of the free motion, which keeps its energy."""
    system, state = driven(True)
    stopped = simulate(system, state, order=order, dt=STEP, steps=100).states
    free, rest = driven(False)
    start = nc.State(
        stopped.t[-1], stopped.q[-1], stopped.v[-1], stopped.coordinates[-1], rest.rates, rest.work
    )
    found = account(free, simulate(free, start, order=order, dt=STEP, steps=STEPS))
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
