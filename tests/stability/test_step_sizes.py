"""Steps from far too large to far too small, stiff springs and fast spins.

What could go wrong: Newton's iteration ends on a wrong branch or not at all when a body turns by a radian a
step or a spring swings hundreds of times in one; differences of nearly equal numbers eat the digits when the
step is tiny; a spin of 10^4 rad/s hides the precession in its own round-off.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from motions import losses, one_body, orders, simulate

import natcoord_jax as nc
from natcoord_jax import gallery

# --- large steps ------------------------------------------------------------------------------------------


@cache
def spinning():
    """A free body that tumbles with a period of some seven radians of its spin."""
    body = nc.RigidBody(
        mass=1.0,
        inertia=(1.0, 2.0, 2.5),
        com=(0.1, -0.05, 0.2),
        velocity=(0.3, -0.2, 0.1),
        angular_velocity=(0.2, 1.0, 0.1),
        name="body",
    )
    return one_body(body, gravity=(0.0, 0.0, 0.0), joint=None)


@orders(fourth="slow")
def test_radians_in_a_step(order):
    """From 0.01 to 2 rad a step: all is kept; substeps are allowed and seldom needed."""
    (system, state), lost = spinning(), {}
    for turn in (0.01, 0.1, 0.5, 1.0, 2.0):
        run = simulate(system, state, order=order, dt=turn, steps=200, extra_substeps=400)
        laws = account(system, run)
        lost[turn] = losses(laws)
        more = {
            "substeps": (int(run.steps_taken), 200 * (1.0 if turn <= 1.0 else 1.05)),
            "momentum": (laws.momentum_error(), tol.MOMENTUM),
            "angular momentum": (laws.spin_error(), tol.ANGULAR_MOMENTUM),
        }
        lost[turn] |= {law: error for law, (error, bound) in more.items() if not error <= bound}
    assert not any(lost.values()), lost


@pytest.mark.parametrize(
    "order",
    [pytest.param(2, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.exhaustive)],
)
def test_steps_far_too_long_are_refused_or_keep_energy(order):
    """Linkages that turn by a radian and more a step, through positions in which their loops are singular.

    Stages next to such a position need forces without bound; what is rounding beside these is not beside the
    motion. Of 200 runs at most one may end with the message that steps were too long.
    """
    scene = gallery.load("four_bar")

    @jax.jit
    @jax.vmap
    def end(dt, number):
        steps = nc.Steps(number, 32)
        run = simulate(scene.system, scene.state, order=order, dt=dt, steps=steps, throw=False)
        energy = scene.system.energy(run.states).total
        return run.result, jnp.abs(energy[-1] / energy[0] - 1.0)

    numbers = np.repeat([6, 8, 10, 12, 16, 20, 24, 32], 25)
    stretched = np.tile(np.linspace(1.0, 1.1, 25, endpoint=False), 8)
    codes, errors = map(np.asarray, end(2.0 / numbers * stretched, numbers))
    failed = codes[codes > 0]
    assert set(failed.tolist()) <= {int(nc.Result.MAX_ITERATIONS), int(nc.Result.DIVERGED)}
    assert len(failed) <= 1
    assert np.max(errors[codes == 0]) <= tol.FAR_TOO_LONG_ENERGY


# --- stiff springs ----------------------------------------------------------------------------------------

STIFF_STEP = 0.02
WOUND = 3.0
"""Energy [J] of each spring at the start, of some 20 J that move."""
EXCHANGED = {"stay": 0.1, "coil": 0.01}
"""Of the energy that moves. Steps of hundreds of radians see little of the coil."""


@cache
def stiff(swing: float):
    """Two bodies in a row, with springs of `swing` radians a step at and about the joint between them.

    They swing as a pendulum. The springs are wound up at the start, for what is excited by the pendulum falls
    with their stiffness, to a millionth of the energy.
    """
    stiffness = (swing / STIFF_STEP) ** 2
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arms = []
    for k in range(2):
        arm = nc.RigidBody(
            mass=1.0,
            inertia=(0.02, 0.1, 0.1),
            com=(0.5, 0.0, 0.0),
            position=(float(k), 0.0, 0.0),
            angular_velocity=(0.0, 2.0, 0.0),
            velocity=(0.0, 0.0, -2.0 * k),
            name=f"arm {k}",
        )
        arms.append(scene.add(arm))
    scene.add(nc.Spherical(nc.ground, arms[0], point=(0.0, 0.0, 0.0), name="pivot"))
    joint = scene.add(
        nc.Revolute(arms[0], arms[1], point=(1.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="elbow")
    )
    angle, stretch = np.sqrt(2 * WOUND / np.array([0.2 * stiffness, stiffness]))
    scene.add(nc.JointSpring(joint, stiffness=0.2 * stiffness, rest=angle, name="coil"))
    ends = nc.Point(nc.ground, (1.0, 1.0, 0.0)), nc.Point(arms[0], (1.0, 0.0, 0.0))
    scene.add(nc.Spring(ends, name="stay", stiffness=stiffness, length=1.0 - stretch))
    return scene.compile()


@orders(fourth="slow")
def test_stiff_springs(order):
    """Up to 10^3 radians of a spring's swing a step: energy is kept, in substeps where it must be.

    Newton's iteration follows some radians of a spring's swing; beyond, a step in two needs two parts.
    """
    lost = {}
    for swing in (0.1, 1.0, 10.0, 100.0, 1000.0):
        system, state = stiff(swing)
        run = simulate(system, state, order=order, dt=STIFF_STEP, steps=200, extra_substeps=3000)
        laws = account(system, run)
        lost[swing] = losses(laws, turned=0.5)
        taken, rejected = int(run.steps_taken), int(run.steps_rejected)
        if not ((taken, rejected) == (200, 0) if swing <= 10.0 else taken <= 400):
            lost[swing]["substeps, rejected"] = taken, rejected
        exchanged = laws.exchanged()
        if not all(exchanged[name] >= share for name, share in EXCHANGED.items()):
            lost[swing]["energy exchanged, so that nothing is tested"] = exchanged
    assert not any(lost.values()), lost


@orders()
def test_a_retry_that_is_not_enough_says_so(order):
    """Without substeps to spend, a step that fails ends the run with its number; before it all is sound."""
    system, state = stiff(10.0)
    run = simulate(system, state, order=order, dt=25 * STIFF_STEP, steps=40, extra_substeps=0, throw=False)
    assert not nc.Result(int(run.result)).ok, "no step failed: nothing is tested"
    assert f"step {int(run.failed_step)} " in system.explain(run)
    assert bool(jnp.all(jnp.isfinite(run.q)))
    assert account(system, run).energy_error <= tol.ENERGY


# --- tiny steps -------------------------------------------------------------------------------------------

PERIOD = 2.0  # [s], of the slowest small motion of these scenes, roughly
TINY = [3, 5, 7, 9]


@cache
def loaded(name: str):
    return gallery.load(name)


@pytest.mark.parametrize(
    ("order", "name"),
    [
        pytest.param(2, "four_bar", marks=pytest.mark.slow),
        pytest.param(4, "four_bar", marks=pytest.mark.exhaustive),
        pytest.param(2, "double_pendulum", marks=pytest.mark.exhaustive),
        pytest.param(4, "double_pendulum", marks=pytest.mark.exhaustive),
    ],
)
def test_tiny_steps(order, name):
    """Down to 1e-9 of the period: Newton converges at once, and nothing is lost to small differences."""
    scene, steps, lost = loaded(name), 300, {}
    accelerations = np.asarray(scene.system.instant(scene.state).accelerations)
    for digits in TINY:
        h = PERIOD * 10.0**-digits
        run = simulate(scene.system, scene.state, order=order, dt=h, steps=steps)
        laws = account(scene.system, run)
        lost[digits] = losses(laws, energy=tol.TINY_STEP, constraint=tol.TINY_STEP, turned=0.0)
        gained = np.asarray(run.v[-1] - run.v[0]) / (steps * h)
        more = {
            "substeps": (int(run.steps_taken), steps),
            "iterations": (int(run.iterations_max), tol.TINY_STEP_ITERATIONS),
            "acceleration": (
                np.max(np.abs(gained - accelerations)),
                tol.short_time(steps * h) * np.max(np.abs(accelerations)),
            ),
        }
        lost[digits] |= {law: error for law, (error, bound) in more.items() if not error <= bound}
    assert not any(lost.values()), lost


# --- fast tops --------------------------------------------------------------------------------------------


@orders(second="slow")
def test_fast_tops(order):
    """10^4 rad/s: the laws hold at all steps, and what can be seen of the motion is right.

    Steps of 0.05 rad (nutation 0.009 rad a step) resolve the nodding. Larger ones do not all: at 20 rad a
    step (nutation 3.6 rad) order two takes 169 degrees for 20 rad, its largest rotation, and order four
    eight substeps; the mean precession is that of the spin's angular momentum all the same.
    """
    scene, steps, lost = loaded("fast_top"), 400, {}
    system, facts = scene.system, scene.facts
    for angle in (0.05, 1.0, 2.0, 20.0):
        run = simulate(
            system,
            scene.state,
            order=order,
            dt=angle / facts["spin"],
            steps=steps,
            extra_substeps=64 * steps,
        )
        laws = account(system, run)
        lost[angle] = losses(laws, turned=0.0)
        if not laws.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM:
            lost[angle]["angular momentum"] = laws.spin_error(axes=[2])
        most = steps if angle <= 2.0 else (1.1 if order == 2 else 8.0) * steps
        if not (steps if angle <= 2.0 else steps + 1) <= int(run.steps_taken) <= most:
            lost[angle]["substeps"] = int(run.steps_taken)
        if angle < 0.1:
            tilt = np.arccos(np.asarray(run.q)[:, 3, 2])
            seen = {"nodding": float(np.ptp(tilt))}
        else:
            seen = {"precession": precession(run)}
        lost[angle] |= {
            name: size for name, size in seen.items() if size != pytest.approx(facts[name], rel=tol.FAST_TOP)
        }
    assert not any(lost.values()), lost


def precession(trajectory) -> float:
    """Mean rate of the axis about the vertical [rad/s], by a line through its angle."""
    axis = np.asarray(trajectory.q)[:, 3]
    angle = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    return float(np.polyfit(np.asarray(trajectory.t), angle, 1)[0])
