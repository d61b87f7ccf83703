"""Substeps chosen by their error: tolerances are met, conservation holds, derivatives are exact."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from law_cases import SCHEMES, lane

import natcoord_jax as nc
from natcoord_jax import gallery

DT, STEPS = 0.1, 20
"""Ten times too long a step for the double pendulum, and until it has swung through."""


@cache
def pendulum():
    example = gallery.load("double_pendulum")
    return example.system, example.state


def swung(rtol, order=2, **options):
    system, state = pendulum()
    options = dict(dt=DT, steps=STEPS, extra_substeps=1500) | options
    return nc.simulate(system, state, rtol=rtol, scheme=SCHEMES[f"order {order}"], **options)


@cache
def exactly():
    """Its end, by Richardson's formula from two runs of order four in one program."""
    system, state = pendulum()
    coarse, fine = (
        nc.simulate(system, state, dt=DT * STEPS / n, steps=n, scheme=SCHEMES["order 4"]).q[-1]
        for n in (500, 1000)
    )
    return np.asarray(fine + (fine - coarse) / 15)


def error(result):
    return float(np.max(np.abs(np.asarray(result.q[-1]) - exactly())))


@pytest.mark.parametrize("order", [lane((order,), set(), {(2,)}) for order in (2, 4)])
def test_errors_follow_the_tolerance(order):
    system, _ = pendulum()
    wide, narrow = swung(1e-4, order), swung(1e-6, order)
    for result, tolerance in ((wide, 1e-4), (narrow, 1e-6)):
        assert error(result) <= 1e3 * tolerance  # errors of some hundred substeps, grown with the motion
        report = account(system, result)
        assert report.energy_error <= tol.ENERGY
        assert max(report.directors, report.joints) <= tol.CONSTRAINT
        assert int(result.steps_taken) > STEPS and int(result.steps_rejected) > 0
        np.testing.assert_allclose(result.t, DT * np.arange(STEPS + 1), rtol=1e-12)
    # The error of a substep is h^(p+1): lengths fall with that root of the tolerance.
    ratio = int(narrow.steps_taken) / int(wide.steps_taken)
    assert ratio == pytest.approx(100 ** (1 / (order + 1)), rel=0.3)
    assert error(narrow) <= 0.2 * error(wide)


def test_what_cannot_be_met_is_reported():
    with pytest.raises(nc.SimulationError, match="rtol"):
        swung(1e-30, atol=0.0)


@pytest.mark.exhaustive
def test_what_there_is_no_room_for_is_reported():
    few = swung(1e-6, extra_substeps=50, throw=False)
    assert nc.Result(int(few.result)) is nc.Result.MAX_SUBSTEPS
    assert 0 < int(few.failed_step) < STEPS and bool(jnp.all(jnp.isfinite(few.q)))


WRONG = {
    "rtol is -0.001": dict(rtol=-1e-3),
    "atol is not finite: nan": dict(rtol=1e-3, atol=np.nan),
    "without rtol": dict(rtol=None, atol=1e-3),
    "both zero": dict(rtol=0.0),
    "rtol has shape": dict(rtol=(1e-3, 1e-4)),
}


def test_wrong_tolerances_are_refused():
    for message, options in WRONG.items():
        with pytest.raises(ValueError, match=message):
            nc.simulate(*pendulum(), dt=DT, steps=2, **options)


@pytest.mark.exhaustive
def test_the_same_again_in_jit_and_in_lanes():
    one, other = swung(1e-4), jax.jit(swung)(1e-4)
    np.testing.assert_array_equal(one.q, swung(1e-4).q)
    assert int(one.steps_taken) == int(other.steps_taken)
    np.testing.assert_allclose(one.q, other.q, rtol=tol.SAME_TRAJECTORY, atol=tol.SAME_TRAJECTORY)
    lanes = jax.jit(jax.vmap(swung))(jnp.array([1e-4, 1e-3]))
    assert int(lanes.steps_taken[1]) < int(lanes.steps_taken[0]) == int(one.steps_taken)
    np.testing.assert_allclose(lanes.q[0], one.q, rtol=tol.SAME_TRAJECTORY, atol=tol.SAME_TRAJECTORY)
    assert np.all(np.asarray(lanes.result) == 0)


ANGLES = jnp.array([-1.5, 0.3])
"""Of the second hinge at the start, the numbers that derivatives are taken by; in lanes."""


def number(run):
    """Of the end of a run, with the counts of its substeps, as a function of angle and tolerance."""
    system, state = pendulum()

    def value(angle, rtol):
        result = run(system, system.with_coordinate(state, "hinge 2", angle), rtol)
        counts = result.steps_taken, result.steps_rejected
        # Velocities of order two have parts across the constraints, which converge as steps do not.
        return jnp.sum(result.q[-1] ** 3), counts

    return value


def slopes(run):
    """Derivatives in reverse, with the counts: one program for all tolerances."""
    return jax.jit(jax.vmap(jax.grad(number(run), has_aux=True), (0, None)))


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4])
def test_derivatives_follow_the_accepted_substeps(order):
    """In lanes that take other numbers of substeps: forward as in reverse, as near as the tolerance says."""

    def controlled(system, start, rtol):
        options = {"scheme": SCHEMES[f"order {order}"], "extra_substeps": 600, "throw": False}
        return nc.simulate(system, start, dt=DT, steps=5, rtol=rtol, **options)

    def fine(system, start, rtol):
        fourth = SCHEMES["order 4"]
        return nc.simulate(system, start, dt=DT / 40, steps=200, throw=False, scheme=fourth)

    program, exact = slopes(controlled), np.asarray(slopes(fine)(ANGLES, 0.0)[0])
    errors = []
    for rtol in (1e-4, 1e-6):
        reverse, (taken, rejected) = program(ANGLES, rtol)
        errors.append(np.abs(np.asarray(reverse) - exact))
    assert int(taken[0]) != int(taken[1]) and int(jnp.min(rejected)) > 0
    assert np.all(errors[1] <= 0.3 * errors[0]) and np.all(errors[1] <= 1e-2 * np.abs(exact))
    value = number(controlled)
    forward = jax.jit(jax.vmap(lambda x: jax.jvp(lambda y: value(y, 1e-6)[0], (x,), (1.0,))[1]))(ANGLES)
    np.testing.assert_allclose(forward, reverse, rtol=tol.SAME_GRADIENT)


@pytest.mark.exhaustive
def test_derivatives_of_halved_steps_are_those_of_half_steps():
    """A tolerance that any step meets leaves the two halves of each: their derivative is exact."""

    def controlled(system, start, rtol):
        return nc.simulate(system, start, dt=DT / 4, steps=8, rtol=rtol, throw=False)

    def halved(system, start, rtol):
        return nc.simulate(system, start, dt=DT / 8, steps=16, throw=False)

    reverse, (taken, _) = slopes(controlled)(ANGLES, 1.0)
    assert taken.tolist() == [16, 16]
    np.testing.assert_allclose(reverse, slopes(halved)(ANGLES, 1.0)[0], rtol=tol.SAME_GRADIENT)


@pytest.mark.exhaustive
def test_short_substeps_where_motion_is_fast_for_a_moment():
    """Beads of 1, 100 and 10^4 kg on strings: the light one snaps once, at hundreds of radians a second."""
    scene = nc.Scene()
    carrier, place = nc.ground, np.zeros(3)
    scene.add(nc.Gravity())
    for k in range(3):
        following = place + np.array([0.5, 0.1 * k, -0.1])
        bead = scene.add(nc.PointMass(mass=100.0**k, position=following, name=f"bead {k}"))
        scene.add(nc.Distance(carrier, bead, point=following, parent_point=place, name=f"string {k}"))
        carrier, place = bead, following
    system, state = scene.compile()
    exact = nc.simulate(system, state, dt=5e-6, steps=100_000, save_every=100_000).q[-1]

    def missed(result):
        return float(jnp.max(jnp.abs(result.q[-1] - exact)))

    fourth = {"scheme": SCHEMES["order 4"], "extra_substeps": 1000}
    chosen = nc.simulate(system, state, dt=0.5, steps=1, rtol=1e-4, **fourth)
    count = int(chosen.steps_taken)
    assert count <= 600 and missed(chosen) <= 1e-4
    equal = nc.simulate(system, state, dt=0.5 / count, steps=count, **fourth)
    assert missed(equal) > 100 * missed(chosen)


# --- inputs -----------------------------------------------------------------------------------------------


def wheel():
    """On a motor, with an inertia of a half about its axis."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 0.5), name="wheel"))
    hinge = scene.add(nc.Revolute(nc.ground, body, point=(0, 0, 0), axis=(0, 0, 1), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


@pytest.mark.exhaustive
def test_inputs_change_at_the_ends_of_steps():
    """A torque that is switched: exact at the ends of steps whatever the substeps."""
    system, state = wheel()
    torques = jnp.array([[3.0], [-40.0], [0.0], [25.0]])
    result = nc.simulate(system, state, dt=0.3, inputs=torques, rtol=1e-4)
    rates = np.concatenate([[0.0], np.cumsum(0.3 * torques[:, 0] / 0.5)])
    np.testing.assert_allclose(system.sense(result, "hinge").rates[:, 0], rates, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(result.inputs, torques)
    assert int(result.steps_taken) > 8


@pytest.mark.exhaustive
def test_inputs_of_substeps_lie_on_those_of_the_step():
    """A step that is made in parts sees the same torque history: exactly, for a polynomial of it."""
    system, state = wheel()
    scheme, dt, steps = SCHEMES["order 6"], 0.3, 4
    t = scheme.times(dt, steps)
    torques = 20.0 * (1.0 + t - 3.0 * t**2)[..., None]
    result = nc.simulate(system, state, dt=dt, inputs=torques, scheme=scheme, rtol=1e-8)
    assert int(result.steps_taken) > 2 * steps, "no step is made in more parts than two"
    end = np.asarray(result.t)
    rates = 40.0 * (end + end**2 / 2 - end**3)
    np.testing.assert_allclose(system.sense(result, "hinge").rates[:, 0], rates, rtol=1e-10, atol=1e-10)


@pytest.mark.exhaustive
def test_events_and_saved_steps():
    low = nc.simulate(
        *pendulum(), dt=DT, steps=STEPS, rtol=1e-4, until=lambda s: s.q[4, 0] + 0.2, extra_substeps=1500
    )
    assert nc.Result(int(low.result)) is nc.Result.EVENT
    saved = swung(1e-4, save_every=5)
    assert saved.q.shape[0] == 5
    np.testing.assert_allclose(saved.t, 5 * DT * np.arange(5), rtol=1e-12)
    assert error(saved) <= 1e-1
