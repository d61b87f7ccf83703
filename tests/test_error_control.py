"""Substeps chosen by their error: tolerances are met, conservation holds, derivatives are exact."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.results import Result
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.error_control import SECOND, Tolerance, Trial, follow
from natcoord_jax.stepping.plan import Plan

FOURTH = nc.EnergyMomentum(order=4)
DT, STEPS = 0.1, 20
"""Ten times too long a step for the double pendulum, and until it has swung through."""


@cache
def pendulum():
    example = gallery.load("double_pendulum")
    return example.system, example.state


def swung(rtol, order=2, **options):
    system, state = pendulum()
    options = dict(dt=DT, steps=STEPS, extra_substeps=1500) | options
    return nc.simulate(system, state, rtol=rtol, scheme=nc.EnergyMomentum(order=order), **options)


@cache
def exactly():
    system, state = pendulum()
    return nc.simulate(system, state, dt=0.01, steps=200, scheme=nc.EnergyMomentum(order=8)).q[-1]


def error(found):
    return float(jnp.max(jnp.abs(found.q[-1] - exactly())))


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_errors_follow_the_tolerance(order):
    system, _ = pendulum()
    wide, narrow = swung(1e-4, order), swung(1e-6, order)
    for found, tolerance in ((wide, 1e-4), (narrow, 1e-6)):
        assert error(found) <= 1e3 * tolerance  # errors of some hundred substeps, grown with the motion
        report = account(system, found)
        assert report.energy_error <= tol.ENERGY
        assert max(report.directors, report.joints) <= tol.CONSTRAINT
        assert int(found.steps_taken) > STEPS and int(found.steps_rejected) > 0
        np.testing.assert_allclose(found.t, DT * np.arange(STEPS + 1), rtol=1e-12)
    # The error of a substep is h^(p+1): lengths fall with that root of the tolerance.
    ratio = int(narrow.steps_taken) / int(wide.steps_taken)
    assert ratio == pytest.approx(100 ** (1 / (order + 1)), rel=0.3)
    assert error(narrow) <= 0.2 * error(wide)


def test_the_same_again_in_jit_and_in_lanes():
    one, other = swung(1e-4), jax.jit(swung)(1e-4)
    np.testing.assert_array_equal(one.q, swung(1e-4).q)
    assert int(one.steps_taken) == int(other.steps_taken)
    np.testing.assert_allclose(one.q, other.q, rtol=tol.SAME_TRAJECTORY, atol=tol.SAME_TRAJECTORY)
    lanes = jax.jit(jax.vmap(swung))(jnp.array([1e-4, 1e-3]))
    assert int(lanes.steps_taken[1]) < int(lanes.steps_taken[0]) == int(one.steps_taken)
    np.testing.assert_allclose(lanes.q[0], one.q, rtol=tol.SAME_TRAJECTORY, atol=tol.SAME_TRAJECTORY)
    assert np.all(np.asarray(lanes.result) == 0)


RTOL, ANGLES = {2: 1e-4, 4: 1e-5}, {2: (-1.5, 0.3), 4: (0.3, -1.5)}
"""For some ten to twenty substeps of several lengths, another number from each start."""


def turned(angle, rtol=1e-4, **options):
    system, state = pendulum()
    start = system.with_coordinate(state, "hinge 2", angle)
    return nc.simulate(system, start, dt=DT, steps=5, rtol=rtol, throw=False, **options)


def check_counts(slots, course):
    """Counters against the record of attempts: every substep is a whole and two halves, which are kept."""
    accepted, times = np.asarray(slots.accepted), np.asarray(slots.states.t)
    points = times[accepted]
    assert np.all(np.diff(points) > 0), "no two accepted substeps end at one time"
    assert len(points) == int(course.taken) and points[-1] == pytest.approx(5 * DT, rel=1e-12)
    # Unused slots say step 0; there nothing was rejected, or it would have more parts than two.
    first = np.asarray(slots.step) == 0
    assert np.sum(accepted & first) == 2
    attempts = np.sum(~first) - np.sum(accepted & ~first)
    rejected = (attempts - np.sum(accepted & ~first) / 2) / 3
    assert rejected == int(course.rejected) > 0


@pytest.mark.parametrize(
    "order", [pytest.param(2, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.exhaustive)]
)
def test_derivatives_follow_the_accepted_substeps(order):
    """As those of the same substeps made one by one, of lengths that do not depend on anything; in lanes."""
    system, state = pendulum()
    scheme = nc.EnergyMomentum(order=order)
    rtol, (other, angle) = RTOL[order], ANGLES[order]
    start = system.with_coordinate(state, "hinge 2", angle)
    plan = Plan(5, 256, 1e-16, None, None, scheme.tableau)
    tolerance = Tolerance(jnp.array(rtol), jnp.array(rtol))
    slots, ending = run_slots(plan, system, start, jnp.zeros((5, order // 2, 0)), jnp.array(DT), tolerance)
    check_counts(slots, ending.course)
    lengths = np.asarray(slots.fraction)[np.asarray(slots.accepted)] * DT
    assert len(lengths) > 10 and len(set(np.round(lengths, 12))) >= (3 if order == 2 else 2)
    assert np.sum(lengths) == pytest.approx(5 * DT, rel=1e-12)

    @jax.jit
    @jax.grad
    def one_by_one(angle):
        after, _ = jax.lax.scan(
            lambda s, h: (nc.step(system, s, None, h, scheme=scheme), None),
            system.with_coordinate(state, "hinge 2", angle),
            jnp.asarray(lengths),
        )
        return jnp.sum(after.q[4] ** 2 + after.v[4] ** 3)

    def value(angle):
        found = turned(angle, rtol, scheme=scheme)
        return jnp.sum(found.q[-1, 4] ** 2 + found.v[-1, 4] ** 3), (found.steps_taken, found.steps_rejected)

    # The other lane takes another number of substeps.
    slopes, (taken, rejected) = jax.jit(jax.vmap(jax.grad(value, has_aux=True)))(jnp.array([other, angle]))
    assert int(taken[1]) == len(lengths) != int(taken[0])
    assert int(rejected[1]) == int(ending.course.rejected)
    slope = float(slopes[1])
    assert slope == pytest.approx(float(one_by_one(angle)), rel=tol.SAME_GRADIENT)
    if order == 2:
        along = float(jax.jit(lambda x: jax.jvp(lambda x: value(x)[0], (x,), (1.0,))[1])(angle))
        assert along == pytest.approx(slope, rel=tol.SAME_GRADIENT)


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

    def missed(found):
        return float(jnp.max(jnp.abs(found.q[-1] - exact)))

    chosen = nc.simulate(system, state, dt=0.5, steps=1, rtol=1e-4, extra_substeps=1000, scheme=FOURTH)
    count = int(chosen.steps_taken)
    assert count <= 600 and missed(chosen) <= 1e-4
    equal = nc.simulate(system, state, dt=0.5 / count, steps=count, extra_substeps=1000, scheme=FOURTH)
    assert missed(equal) > 100 * missed(chosen)


def test_inputs_change_at_the_ends_of_steps():
    """A wheel under a torque that is switched: exact at the ends of steps whatever the substeps."""
    scene = nc.Scene()
    wheel = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 0.5), name="wheel"))
    hinge = scene.add(nc.Revolute(nc.ground, wheel, point=(0, 0, 0), axis=(0, 0, 1), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    torques = jnp.array([[3.0], [-40.0], [0.0], [25.0]])
    found = nc.simulate(system, state, dt=0.3, inputs=torques, rtol=1e-4)
    rates = np.concatenate([[0.0], np.cumsum(0.3 * torques[:, 0] / 0.5)])
    np.testing.assert_allclose(system.sense(found, hinge).rates[:, 0], rates, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(found.inputs, torques)
    assert int(found.steps_taken) > 8


def test_events_and_saved_steps():
    low = nc.simulate(
        *pendulum(), dt=DT, steps=STEPS, rtol=1e-4, until=lambda s: s.q[4, 0] + 0.2, extra_substeps=1500
    )
    assert Result(int(low.result)) is Result.EVENT
    every = swung(1e-4, save_every=5)
    assert every.q.shape[0] == 5
    np.testing.assert_allclose(every.t, 5 * DT * np.arange(5), rtol=1e-12)
    assert error(every) <= 1e-1


def test_what_cannot_be_met_is_reported():
    few = swung(1e-6, extra_substeps=50, throw=False)
    assert Result(int(few.result)) is Result.MAX_SUBSTEPS
    assert 0 < int(few.failed_step) < STEPS and bool(jnp.all(jnp.isfinite(few.q)))
    with pytest.raises(nc.SimulationError, match="rtol"):
        swung(1e-30, atol=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(rtol=-1e-3), "rtol is -0.001"),
        (dict(rtol=1e-3, atol=np.nan), "atol is not finite: nan"),
        (dict(rtol=None, atol=1e-3), "without rtol"),
        (dict(rtol=0.0), "both zero"),
        (dict(rtol=(1e-3, 1e-4)), "rtol has shape"),
    ],
)
def test_wrong_tolerances(options, message):
    with pytest.raises(ValueError, match=message):
        nc.simulate(*pendulum(), dt=DT, steps=2, **options)


def test_a_rejected_substep_begins_where_it_began():
    """The three attempts of one substep, the last one too far off."""
    _, state = pendulum()
    moved = eqx.tree_at(lambda s: s.q, state, state.q + 1.0)
    tolerance = Tolerance(jnp.array(1e-6), jnp.array(1e-6))
    yes, no = jnp.array(True), jnp.array(False)
    tableau = FOURTH.tableau
    left = jnp.zeros(1)
    first = follow(tolerance, Trial.first(state, left), state, state, yes, no, tableau)
    assert int(first.change) == 0 and float(first.fraction) == 0.5
    second = follow(tolerance, first.trial, first.state, moved, yes, no, tableau)
    assert int(second.change) == 1 and int(second.trial.phase) == SECOND and float(second.done) == 0.5
    third = follow(tolerance, second.trial, second.state, moved, yes, no, tableau)
    assert int(third.change) == -1 and bool(third.trial.undone) and bool(third.failed)
    np.testing.assert_array_equal(third.state.q, state.q)
    assert float(third.done) == 0.0 and float(third.fraction) == pytest.approx(0.2)
