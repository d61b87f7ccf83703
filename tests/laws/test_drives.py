"""What drives prescribe: energies, momenta and works are those of the motion that is asked for.

With kinks at the ends of steps, where the rate jumps, after a stop, and held still under load.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

GRAVITY, ARM, MASS, INERTIA = 9.81, 0.5, 1.0, 0.1
DT, STEPS = 0.01, 100
AWAY, BACK = 0.3, 0.7
SCHEMES = {
    "2": nc.EnergyMomentum(),
    "2 with kicks": nc.EnergyMomentum(kick=True),
    "4": nc.EnergyMomentum(order=4),
}
CLOSED = 1e-12
"""Energies in terms of the largest, of a motion of one coordinate that is known."""


class Profile(eqx.Module):
    """Angle [rad]: a ramp that stops, a triangle, a sine; kinks are at ends of steps."""

    ramp: jax.Array
    triangle: jax.Array
    sine: jax.Array

    def __call__(self, t):
        rising = jnp.clip(t - AWAY, 0.0, BACK - AWAY)
        return (
            self.ramp * rising
            + self.triangle * (rising - jnp.clip(t - 0.5, 0.0, BACK - 0.5) * 2.0)
            + self.sine * jnp.sin(3.0 * t)
        )


PROFILES = {"ramp": (1.0, 0.0, 0.0), "triangle": (0.0, 1.3, 0.0), "sine": (0.0, 0.0, 0.7), "sum": (1, 1, 0.5)}


def arm(function):
    """A bar on a driven hinge under gravity."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    body = nc.RigidBody(mass=MASS, inertia=(0.01, INERTIA, INERTIA), com=(ARM, 0, 0), name="bar")
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(body), axis=(0, 1, 0), name="hinge"))
    scene.add(nc.Drive(hinge, function=function, name="drive"))
    return scene.compile(assemble=True)


@pytest.mark.parametrize(
    "scheme", [pytest.param(name, marks=() if name == "2" else pytest.mark.slow) for name in SCHEMES]
)
@pytest.mark.parametrize("name", PROFILES)
def test_energies_and_work_are_those_of_the_prescribed_motion(name, scheme):
    function = Profile(*map(jnp.asarray, map(float, PROFILES[name])))
    system, state = arm(function)
    run = nc.simulate(system, state, dt=DT, steps=STEPS, scheme=SCHEMES[scheme])
    angle, rate = jax.vmap(lambda t: jax.jvp(function, (t,), (jnp.ones(()),)))(run.t)
    # At a kink the rate has two values.
    smooth = np.min(np.abs(np.asarray(run.t)[:, None] - np.array([AWAY, 0.5, BACK])), axis=1) > 0.5 * DT
    kinetic = 0.5 * (INERTIA + MASS * ARM**2) * np.asarray(rate) ** 2
    total = kinetic - MASS * GRAVITY * ARM * np.sin(angle)
    energy, scale = system.energy(run), np.max(np.abs(total)) + np.max(kinetic)
    error = CLOSED * scale if scheme != "2" or name in ("ramp", "triangle") else (3.0 * DT) ** 4 * scale
    np.testing.assert_allclose(np.asarray(energy.kinetic)[smooth], kinetic[smooth], atol=error)
    work = np.asarray(system.work(run)["drive"])
    np.testing.assert_allclose(work[smooth], (total - total[0])[smooth], atol=error)
    spin = np.asarray(system.angular_momentum(run))[:, 1]
    np.testing.assert_allclose(
        spin[smooth], (INERTIA + MASS * ARM**2) * np.asarray(rate)[smooth], atol=10 * np.sqrt(error)
    )
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_what_hangs_on_a_driven_crank_keeps_the_account(order):
    """One joint is driven with kinks, the other free: the drive's work is all that energy changes by."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    crank = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), com=(0.5, 0, 0), name="crank"))
    bar = nc.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), com=(0.5, 0, 0), position=(1, 0, 0), name="bar")
    axle = scene.add(nc.Revolute(nc.ground, crank, axis=(0, 1, 0), name="axle"))
    scene.add(nc.Revolute(crank, scene.add(bar), point=(1, 0, 0), axis=(0, 1, 0), name="elbow"))
    function = Profile(jnp.asarray(3.0), jnp.asarray(0.0), jnp.asarray(0.0))
    scene.add(nc.Drive(axle, function=function, name="drive"))
    system, state = scene.compile()
    ends = []
    for dt in (0.01, 0.005):
        run = nc.simulate(system, state, dt=dt, steps=round(1.0 / dt), scheme=nc.EnergyMomentum(order=order))
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE
        rates = np.asarray(system.sense(run, "axle").rates)[:, 0]
        assert abs(rates[-1]) <= tol.TANGENT and abs(rates[round(0.5 / dt)] - 3.0) <= tol.TANGENT
        ends.append(float(system.coordinate(run, "elbow")[-1]))
    # (Kinks cost order four one order: differences fall by nine where steps are halved.)
    assert abs(ends[0] - ends[1]) <= {2: 1e-3, 4: 1e-5}[order]


@cache
def held(com):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), com=com, name="bar"))
    hinge = scene.add(nc.Revolute(nc.ground, body, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.Drive(hinge, function=lambda t: 0.0 * t, name="drive"))
    return scene.compile()


@pytest.mark.parametrize(
    "scheme",
    [
        nc.EnergyMomentum(kick=True),
        pytest.param(nc.EnergyMomentum(order=4), marks=pytest.mark.exhaustive),
        pytest.param(nc.EnergyMomentum(order=6), marks=pytest.mark.exhaustive),
    ],
    ids=["kicks", "order 4", "order 6"],
)
@pytest.mark.slow
def test_a_bar_that_is_held_still_stays(scheme):
    system, state = held((0.5, 0.0, 0.0))
    for dt in (0.01, 1e-4):
        run = nc.simulate(system, state, dt=dt, steps=10, scheme=scheme)
        assert float(jnp.max(jnp.abs(run.q - state.q))) <= tol.CONSTRAINT


def dwelling(t):
    """A rise of 1 in half a second, without jumps of the acceleration, and rest thereafter."""
    part = jnp.clip(2.0 * t, 0.0, 1.0)
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_arm_that_is_driven_to_a_pose_dwells_there(scheme):
    """Nothing is left to move freely; bars carry their weight stretched out as well as hanging down."""
    for com in ((0.5, 0, 0), (0, 0, -0.5)):
        scene, carrier = nc.Scene(), nc.ground
        scene.add(nc.Gravity())
        for k, angle in enumerate((-0.7, 0.9)):
            place = 2.0 * k * np.array(com)
            bar = nc.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), com=com, position=place, name=f"bar {k}")
            bar = scene.add(bar)
            hinge = scene.add(nc.Revolute(carrier, bar, point=place, axis=(0, 1, 0), name=f"hinge {k}"))
            scene.add(nc.Drive(hinge, function=lambda t, a=angle: a * dwelling(t), name=f"drive {k}"))
            carrier = bar
        system, state = scene.compile()
        run = nc.simulate(system, state, dt=DT, steps=STEPS, scheme=SCHEMES[scheme])
        assert float(np.max(system.energy(run).kinetic[60:])) <= CLOSED
        for k, angle in enumerate((-0.7, 0.9)):
            reached = system.coordinate(run, f"hinge {k}")[50:]
            np.testing.assert_allclose(reached, angle, atol=tol.CONSTRAINT)
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
def test_reactions_are_those_of_the_prescribed_motion():
    """Of a ramp that stops: the hinge holds the weight, and pulls with m l w^2 while the bar turns."""
    system, state = arm(Profile(*map(jnp.asarray, map(float, PROFILES["ramp"]))))
    run = nc.simulate(system, state, dt=DT, steps=STEPS)
    angle = np.asarray(system.coordinate(run, "hinge"))
    along = np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=1)
    pull = np.asarray(system.sense(run, "hinge").force) - MASS * GRAVITY * np.array([0.0, 0.0, 1.0])
    turning = (run.t > AWAY + 0.5 * DT) & (run.t < BACK - 0.5 * DT)
    still = run.t > BACK + 0.5 * DT
    np.testing.assert_allclose(pull[turning], -MASS * ARM * along[turning], atol=tol.TANGENT)
    np.testing.assert_allclose(pull[still], 0.0, atol=tol.TANGENT)
    speed = np.linalg.norm(system.momentum(run), axis=1) / MASS
    np.testing.assert_allclose(speed[turning], ARM, atol=tol.TANGENT)
    np.testing.assert_allclose(speed[still], 0.0, atol=tol.TANGENT)


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_a_drive_that_jumps_is_named(order):
    for at in (0.3, 0.305):
        system, state = arm(lambda t, at=at: jnp.where(t > at, 1.0, 0.0))
        run = nc.simulate(
            system, state, dt=DT, steps=STEPS, scheme=nc.EnergyMomentum(order=order), throw=False
        )
        assert nc.Result(int(run.result)) is nc.Result.JUMPED
        assert "drive 'drive'" in system.explain(run)
