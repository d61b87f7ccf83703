"""Contacts of bodies that drives move: they feel the motion that is prescribed, and drives pay for it."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

MU, GRAVITY = 0.3, 9.81
LOCATED = nc.EnergyMomentum(max_events=4)
ROUNDED = 1e-11
"""Works of a run, which sum up what Newton's iteration leaves of each step."""


@cache
def belt(speed, **law):
    """A box on a belt that moves at a speed [m/s]."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    track = scene.add(nc.RigidBody(mass=50.0, inertia=(1, 1, 1), velocity=(speed, 0, 0), name="belt"))
    joint = scene.add(nc.Prismatic(nc.ground, track, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(joint, function=lambda t: speed * t, name="drive"))
    box = scene.add(nc.PointMass(mass=1.0, name="box"))
    scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), body=track), friction=MU, name="contact", **law))
    return scene.compile()


@pytest.mark.parametrize(
    ("scheme", "law"),
    [
        (nc.EnergyMomentum(), {}),
        pytest.param(nc.EnergyMomentum(kick=True), {}, marks=pytest.mark.exhaustive),
        pytest.param(LOCATED, {}, marks=pytest.mark.exhaustive),
        pytest.param(nc.EnergyMomentum(), {"stiffness": 1e5}, marks=pytest.mark.exhaustive),
    ],
    ids=["hard", "kicks", "located", "soft"],
)
def test_a_belt_takes_a_box_along(scheme, law):
    """Until it does, the belt slips by v^2 / (2 mu g): friction takes half of what the drive gives."""
    speed = 1.0
    system, state = belt(speed, **law)
    run = nc.simulate(system, state, dt=0.01, steps=100, scheme=scheme)
    work = {name: float(value[-1]) for name, value in system.work(run).items()}
    assert abs(work["drive"] - speed**2) <= ROUNDED
    assert abs(work["contact"] + 0.5 * speed**2) <= ROUNDED
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE
    taken = speed / (MU * GRAVITY)
    place = float(system.sense(run, "box").position[-1, 0])
    # The step in which slip stops is a whole one.
    assert abs(place - speed * (1.0 - 0.5 * taken)) <= 5e-4
    np.testing.assert_allclose(system.sense(run, "box").velocity[-1, 0], speed, atol=1e-12)


@pytest.mark.parametrize("restitution", [0.5, 0.0], ids=["bounces", "stays"])
@pytest.mark.slow
def test_a_piston_hits_a_ball(restitution):
    """At rest before; then the piston stops, and what stays with it flies on."""
    scene = nc.Scene()
    piston = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), velocity=(1, 0, 0), name="piston"))
    track = scene.add(nc.Prismatic(nc.ground, piston, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(track, function=lambda t: jnp.minimum(t, 0.3), name="drive"))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0.1, 0, 0), name="ball"))
    wall = nc.Plane(normal=(1, 0, 0), body=piston)
    scene.add(nc.Contact(ball, wall, restitution=restitution, name="contact"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.01, steps=60)
    speed = np.asarray(system.sense(run, "ball").velocity)[:, 0]
    np.testing.assert_allclose(speed[20:], 1.0 + restitution, atol=1e-12)
    assert abs(float(system.energy(run).kinetic[-1]) - 0.5 * (1.0 + restitution) ** 2) <= 1e-12
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
def test_a_shaker_carries_what_its_friction_holds():
    """A sine across the limit of friction: the box moves along below it, and slips above."""
    for amplitude, along in ((0.02, True), (0.2, False)):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        table = scene.add(nc.RigidBody(mass=5.0, inertia=(1, 1, 1), name="table"))
        track = scene.add(nc.Prismatic(nc.ground, table, axis=(1, 0, 0), name="track"))
        scene.add(nc.Drive(track, function=lambda t, a=amplitude: a * (1.0 - jnp.cos(8.0 * t)), name="drive"))
        box = scene.add(nc.PointMass(mass=1.0, name="box"))
        scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), body=table), friction=MU, name="contact"))
        system, state = scene.compile()
        run = nc.simulate(system, state, dt=2e-3, steps=500)
        apart = np.asarray(system.sense(run, "box").position - system.sense(run, "table").position)[:, 0]
        acceleration = amplitude * 64.0
        assert along == (acceleration < MU * GRAVITY)
        assert (np.max(np.abs(apart)) <= 1e-5) == along, amplitude
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
def test_a_gripper_lifts_a_box_by_a_drive():
    """Two fingers hold a box by friction, and a drive lifts them."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    palm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01,) * 3, position=(0, 0, 0.3), name="palm"))
    lift = scene.add(nc.Prismatic(nc.ground, palm, axis=(0, 0, 1), name="lift"))
    size = (0.06, 0.04, 0.04)
    box = scene.add(nc.RigidBody(shape=nc.Box(size), density=0.3 / float(np.prod(size)), name="box"))
    for k, y in enumerate((1, -1)):
        finger = nc.RigidBody(mass=0.1, inertia=(1e-4,) * 3, position=(0, 0.02 * y, 0), name=f"finger {k}")
        finger = scene.add(finger)
        joint = scene.add(nc.Prismatic(palm, finger, axis=(0, -y, 0), name=f"slide {k}"))
        scene.add(nc.JointForce(joint, name=f"squeeze {k}"))
        inside = nc.Plane(normal=(0, -y, 0), point=(0, 0.02 * y, 0), body=finger)
        scene.add(nc.Contact(box, inside, friction=0.6, name=f"pad {k}"))
    scene.add(nc.Drive(lift, function=lambda t: 0.25 * t**2, name="drive"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=5e-3, steps=160, inputs=np.array([20.0, 20.0]))
    height = float(system.sense(run, "box").position[-1, 2])
    assert abs(height - 0.25 * 0.8**2) <= 2e-6
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE
