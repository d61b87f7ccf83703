"""The laws of mechanics at every order from two to ten, with kicks and without, and derivatives.

Could go wrong: a coefficient of five stages that is right to ten digits; work of motors, drives and dampers
that is summed up with other weights than the motion; a quadrature of a spring's forces that is exact for few
stages only; kicks that carry momentum; a rule for derivatives that knows two stages.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account

import natcoord_jax as nc

ORDERS = (2, 4, 6, 8, 10)
STEPS, DT = 100, 0.05
EXCHANGED = 0.1
"""Of the energy, what springs exchange and what every actuator gives or takes."""

# Compiling takes all the time. Two stages and one have tests of their own, and fewer than five differ little.
USUAL = {(6, True), (10, True)}
EVERY_ORDER = [
    pytest.param(order, kick, marks=[] if (order, kick) in USUAL else pytest.mark.slow)
    for order in ORDERS
    for kick in (True, False)
    if (order, kick) != (2, False)
]


def beat(t):
    """Angle of the driven hinge [rad]."""
    return 0.6 * (1 - jnp.cos(3.0 * t))


@cache
def machine():
    """A free hub with an arm on a motor and a driven fin; a spring with a law of its own, and a damper.

    All forces are internal: both momenta are kept. The whole drifts, lest momentum be zero.
    """
    scene = nc.Scene()
    drift, spin = np.array([0.4, -0.2, 0.3]), np.array([0.3, -0.5, 1.0])

    def part(name, place, inertia):
        body = nc.RigidBody(
            mass=1.0,
            inertia=inertia,
            com=(0.1, 0.05, -0.02),
            position=place,
            velocity=drift + np.cross(spin, place),
            angular_velocity=spin,
            name=name,
        )
        return scene.add(body)

    hub = part("hub", (0.0, 0.0, 0.0), (0.3, 0.4, 0.5))
    arm = part("arm", (0.5, 0.0, 0.0), (0.1, 0.15, 0.2))
    fin = part("fin", (-0.5, 0.0, 0.0), (0.08, 0.1, 0.12))
    elbow = scene.add(nc.Revolute(hub, arm, point=(0.3, 0.0, 0.0), axis=(0.0, 1.0, 0.5), name="elbow"))
    root = scene.add(nc.Revolute(hub, fin, point=(-0.3, 0.0, 0.0), axis=(1.0, 0.0, 0.2), name="root"))
    scene.add(nc.JointTorque(elbow, name="motor"))
    scene.add(nc.Drive(root, function=beat, name="drive"))
    ends = nc.Point(hub, (0.0, 0.4, 0.1)), nc.Point(arm, (0.7, 0.1, 0.2))
    law = lambda x: 40.0 * (x - 0.5) ** 2 + 60.0 * (x - 0.5) ** 4  # noqa: E731
    scene.add(nc.NonlinearSpring(ends, name="spring", law=law))
    tips = nc.Point(arm, (0.8, 0.0, 0.0)), nc.Point(fin, (-0.7, 0.1, 0.0))
    scene.add(nc.Damper(tips, name="damper", damping=0.8))
    return scene.compile()


@pytest.mark.slow
@pytest.mark.parametrize(("order", "kick"), EVERY_ORDER)
def test_a_machine_with_motor_drive_damper_and_spring(order, kick):
    """Energy is the work done, momenta are kept, velocities are tangent with kicks."""
    system, state = machine()
    scheme = nc.EnergyMomentum(order=order, kick=kick)
    torques = 2.0 * jnp.sin(2.0 * scheme.times(DT, STEPS))[..., None]
    inputs = torques[:, 0] if order == 2 else torques
    trajectory = nc.simulate(system, state, dt=DT, inputs=inputs, scheme=scheme)
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.exchanged()["spring"] >= EXCHANGED
    assert sorted(found.works) == ["damper", "drive", "motor"]
    assert min(np.ptp(found.works[name]) for name in ("damper", "motor")) >= EXCHANGED * found.energy_scale
    assert np.ptp(found.works["drive"]) >= 0.1 * EXCHANGED * found.energy_scale
    assert np.all(np.diff(found.works["damper"]) < 0), "a damper gives no energy"
    assert found.energy_error <= tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum_error() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.spin_error() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert max(found.directors, found.joints) <= tol.CONSTRAINT_OF_A_SMALL_SCENE
    rates = float(jnp.max(system.constraint_errors(trajectory).velocity))
    if kick:
        assert rates <= tol.TANGENT_OF_A_SMALL_SCENE
    else:
        assert rates > tol.TANGENT, "velocities are tangent without kicks: the comparison means nothing"
    if order >= 4:
        angle = np.asarray(system.coordinate(trajectory, "root"))
        np.testing.assert_allclose(angle, np.asarray(beat(trajectory.t)), atol=tol.CONSTRAINT)


def last(stiffness, order, steps=5):
    """A number of the end of a pendulum with a motor, a damper and a coil, as a function of the coil."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arm = nc.RigidBody(
        mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.5, 0.0, 0.0), angular_velocity=(0.0, 1.0, 0.0), name="arm"
    )
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(arm), axis=(0.0, 1.0, 0.0), name="hinge"))
    scene.add(nc.JointSpring(hinge, stiffness=stiffness, rest=1.0, name="coil"))
    scene.add(nc.JointDamper(hinge, damping=0.1, name="damper"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    scheme = nc.EnergyMomentum(order=order)
    torques = jnp.sin(3.0 * scheme.times(0.1, steps))[..., None]
    found = nc.simulate(system, state, dt=0.1, inputs=torques, scheme=scheme, throw=False)
    return jnp.sum(found.q[-1] ** 3) + 0.1 * jnp.sum(found.v[-1] ** 2) + jnp.sum(found.states.work[-1])


@pytest.mark.parametrize(
    "order", [pytest.param(6, marks=pytest.mark.slow), pytest.param(10, marks=pytest.mark.exhaustive)]
)
def test_a_gradient(order):
    """In reverse, of a loss that has the work of motor and damper in it, against differences."""
    at, h = 8.0, 0.02
    both = jax.jit(jax.value_and_grad(lambda stiffness: last(stiffness, order)))
    values = [float(both(at + k * h)[0]) for k in (-2, -1, 1, 2)]
    difference = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
    slope = float(both(at)[1])
    assert abs(slope) >= 1e-2, "nothing depends on the parameter: nothing is tested"
    assert slope == pytest.approx(difference, rel=tol.DIFFERENCE_BEST)
