"""Inputs that jump: blows, switched torques, motion that is prescribed for a while.

What could go wrong: a guess from the past that is far off after a jump; work and impulses that are booked at
another time than they act; a retried step that applies a blow twice; prescribed motion whose kinks leave
velocities behind.
"""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import tolerances as tol
from accounts import account
from motions import losses, orders, simulate

import natcoord_jax as nc

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


def jolted(order, inputs, dt=STEP):
    """The craft under its inputs; one program for all of them."""
    system, state = craft()
    return simulate(system, state, order=order, dt=dt, inputs=inputs, extra_substeps=600)


@orders(fourth="slow")
def test_jumping_inputs(order):
    """Energy is the work done, at round-off; momentum changes by the impulse, and by nothing else."""
    lost = {}
    for kind in ("blow", "bang", "noise"):
        inputs = history(kind)
        laws = account(craft()[0], jolted(order, inputs))
        lost[kind] = losses(laws)
        quiet = np.all(np.asarray(inputs)[:, 1:] == 0.0, axis=1)
        total, spin = laws.momenta.sum(axis=1), laws.spins.sum(axis=1)
        scale = tol.MOMENTUM * np.max(np.linalg.norm(laws.momenta, axis=-1).sum(axis=1))
        turning = tol.ANGULAR_MOMENTUM * np.max(np.linalg.norm(laws.spins, axis=-1).sum(axis=1))
        moved = np.linalg.norm(np.diff(total, axis=0), axis=-1)
        turned = np.linalg.norm(np.diff(spin, axis=0), axis=-1)
        thrust = np.abs(np.asarray(inputs)[:, 1]) * STEP
        more = {
            "momentum without a thrust": (np.max(moved[quiet], initial=0.0), scale),
            "angular momentum without a torque": (np.max(turned[quiet], initial=0.0), turning),
            "momentum beyond that of the thruster": (np.max(moved - thrust), scale),
        }
        lost[kind] |= {law: error for law, (error, bound) in more.items() if not error <= bound}
    assert not any(lost.values()), lost


@orders(fourth="slow")
def test_a_blow_is_the_impulse_whatever_the_step(order):
    """One step of torque 1/h turns the body at rest as an impulse does: the same spin to first order."""
    spins = []
    for h in (1e-4, 1e-6, 1e-8):
        inputs = jnp.zeros((STEPS, 5)).at[1].set(jnp.array([0.0, 0.0, 1.0, 0.0, 0.0]) / h)
        spins.append(craft()[0].angular_momentum(jolted(order, inputs, h))[-1])
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


@cache
def cranked(order):
    system, state = driven(True)
    return simulate(system, state, order=order, dt=STEP, steps=STEPS, extra_substeps=STEPS)


@orders(second="slow")
def test_prescribed_motion_switched_on_and_off(order):
    """Kinks at ends of steps: the angle is the prescribed one, and energy is the drive's work."""
    (system, _), run = driven(True), cranked(order)
    assert not losses(account(system, run))
    angle = np.asarray(system.coordinate(run, "axle"))
    np.testing.assert_allclose(angle, np.asarray(switched(run.t)), atol=tol.CONSTRAINT)
    assert abs(float(system.work(run)["drive"][-1])) > 1.0


@orders()
def test_a_drive_that_lets_go(order):
    """A state that a drive left behind is the start of the free motion, which keeps its energy."""
    free, still = driven(False)
    released = jax.tree.map(lambda x: x[100], cranked(order).states)
    start = dataclasses.replace(
        still, **{name: getattr(released, name) for name in ("t", "q", "v", "coordinates")}
    )
    assert not losses(account(free, simulate(free, start, order=order, dt=STEP, steps=STEPS)))
