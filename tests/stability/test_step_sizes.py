"""Steps from far too large to far too small, stiff springs and fast spins.

What could go wrong: Newton's iteration ends on a wrong branch or not at all when a body turns by a radian a
step or a spring swings hundreds of times in one; differences of nearly equal numbers eat the digits when the
step is tiny; multipliers grow as 1/h and spoil the matrix; a spin of 10^4 rad/s hides the precession in its
own round-off.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from motions import SECOND_AND_FOURTH, one_body, simulate

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.stepping.endpoint import endpoints

pytestmark = pytest.mark.slow

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


@pytest.mark.parametrize("turn", [0.01, 0.1, 0.5, 1.0, 2.0])
@SECOND_AND_FOURTH
def test_radians_in_a_step(order, turn):
    """From 0.01 to 2 rad a step: everything is kept; substeps are allowed and seldom needed."""
    system, state = spinning()
    trajectory = simulate(system, state, order=order, dt=turn, steps=200, extra_substeps=400)
    found = account(system, trajectory)
    assert int(trajectory.steps_taken) <= 200 * (1.0 if turn <= 1.0 else 1.05)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT


def coarse_runs(scene, run, seconds, numbers):
    """Result codes of runs with far too long steps, and by how much the energy of those that end is off."""
    energy = jax.jit(lambda state: scene.system.energy(state).total)
    start = energy(scene.state)
    for number in numbers:
        for stretch in np.linspace(1.0, 1.1, 25, endpoint=False):
            end = run(seconds / number * stretch, number)
            yield int(end.result), abs(float(energy(end.state) - start)) / abs(start)


@pytest.mark.parametrize("order", [2, 6])
def test_steps_far_too_long_are_refused_or_keep_energy(order):
    """Linkages that turn by a radian and more a step, through positions in which their loops are singular.

    Stages next to such a position need forces without bound; what is rounding beside these is not beside the
    motion. Of 200 runs at most one may end with the message that steps were too long.
    """
    scene = gallery.load("four_bar")
    run = endpoints(scene.system, scene.state, scheme=nc.EnergyMomentum(order=order))
    found = list(coarse_runs(scene, run, 2.0, (6, 8, 10, 12, 16, 20, 24, 32)))
    failed = [code for code, _ in found if code]
    assert set(failed) <= {int(nc.Result.MAX_ITERATIONS), int(nc.Result.DIVERGED)}
    assert len(failed) <= 1
    assert max(error for code, error in found if not code) <= tol.FAR_TOO_LONG_ENERGY


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


@pytest.mark.parametrize("swing", [0.1, 1.0, 10.0, 100.0, 1000.0])
@SECOND_AND_FOURTH
def test_stiff_springs(order, swing):
    """Up to 10^3 radians of a spring's swing a step: energy is kept, in substeps where it must be."""
    system, state = stiff(swing)
    trajectory = simulate(system, state, order=order, dt=STIFF_STEP, steps=200, extra_substeps=3000)
    found = account(system, trajectory)
    # Newton's iteration follows some radians of a spring's swing; beyond, a step in two needs two parts.
    taken, rejected = int(trajectory.steps_taken), int(trajectory.steps_rejected)
    assert (taken, rejected) == (200, 0) if swing <= 10.0 else taken <= 400
    exchanged = found.exchanged()
    assert all(exchanged[name] >= share for name, share in EXCHANGED.items()), exchanged
    assert found.turned >= 0.5
    assert found.energy_error <= tol.ENERGY
    assert max(found.directors, found.joints) <= tol.CONSTRAINT


@SECOND_AND_FOURTH
def test_a_retry_that_is_not_enough_says_so(order):
    """Without substeps to spend, a step that fails ends the run with its number; before it all is sound."""
    system, state = stiff(10.0)
    trajectory = simulate(
        system, state, order=order, dt=25 * STIFF_STEP, steps=40, extra_substeps=0, throw=False
    )
    result = nc.Result(int(trajectory.result))
    sound = account(system, trajectory)
    assert bool(jnp.all(jnp.isfinite(trajectory.q)))
    assert sound.energy_error <= tol.ENERGY
    assert result.ok or f"step {int(trajectory.failed_step)} " in system.explain(trajectory)
    assert not result.ok, "no step failed: nothing is tested"


# --- tiny steps -------------------------------------------------------------------------------------------

PERIOD = 2.0  # [s], of the slowest small motion of these scenes, roughly
TINY = [3, 5, 7, 9]


@cache
def loaded(name: str):
    return gallery.load(name)


@pytest.mark.parametrize("digits", TINY)
@pytest.mark.parametrize("name", ["double_pendulum", "four_bar"])
@SECOND_AND_FOURTH
def test_tiny_steps(order, name, digits):
    """Down to 1e-9 of the period: Newton converges at once, and nothing is lost to small differences."""
    scene, h, steps = loaded(name), PERIOD * 10.0**-digits, 300
    trajectory = simulate(scene.system, scene.state, order=order, dt=h, steps=steps)
    found = account(scene.system, trajectory)
    assert int(trajectory.steps_taken) == steps
    assert int(trajectory.iterations_max) <= tol.TINY_STEP_ITERATIONS
    assert found.energy_error <= tol.TINY_STEP
    assert max(found.directors, found.joints) <= tol.TINY_STEP
    gained = (trajectory.v[-1] - trajectory.v[0]) / (steps * h)
    wanted = scene.system.instant(scene.state).accelerations
    assert np.max(np.abs(gained - wanted)) <= tol.short_time(steps * h) * np.max(np.abs(wanted))


@eqx.filter_jit
def first_matrix(system, state, h, tableau):
    """Jacobian of the first step at the guess it begins with."""
    equations = prepare(system, state, jnp.zeros(len(system.structure.inputs)), h, tableau)
    return equations.jacobian(equations.guess())


@pytest.mark.parametrize("name", ["double_pendulum", "four_bar"])
@SECOND_AND_FOURTH
def test_condition_of_the_equations_is_flat(order, name):
    """The matrix of a step has, for small steps, one condition number."""
    scene, tableau = loaded(name), nc.EnergyMomentum(order=order).tableau
    steps = [jnp.asarray(PERIOD * 10.0**-digits) for digits in TINY]
    found = [np.linalg.cond(first_matrix(scene.system, scene.state, h, tableau)) for h in steps]
    assert found[0] <= tol.CONDITION
    np.testing.assert_allclose(found, found[0], rtol=tol.FLAT)


# --- fast tops --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spin_a_step", [0.05, 1.0, 2.0, 20.0])
@SECOND_AND_FOURTH
def test_fast_tops(order, spin_a_step):
    """10^4 rad/s: the laws hold at every step, and what can be seen of the motion is right.

    Steps of 0.05 rad (nutation 0.009 rad a step) resolve the nodding. Larger ones do not all: at 20 rad a
    step (nutation 3.6 rad) order two takes 169 degrees for 20 rad, its largest rotation, and order four
    eight substeps; the mean precession is that of the spin's angular momentum all the same.
    """
    scene, steps = loaded("fast_top"), 400
    system, facts = scene.system, scene.facts
    trajectory = simulate(
        system,
        scene.state,
        order=order,
        dt=spin_a_step / facts["spin"],
        steps=steps,
        extra_substeps=64 * steps,
    )
    found = account(system, trajectory)
    if spin_a_step <= 2.0:
        assert int(trajectory.steps_taken) == steps
    else:
        assert steps < int(trajectory.steps_taken) <= (1.1 if order == 2 else 8.0) * steps
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT
    if spin_a_step < 0.1:
        tilt = np.arccos(np.asarray(trajectory.q)[:, 3, 2])
        assert np.ptp(tilt) == pytest.approx(facts["nodding"], rel=tol.FAST_TOP)
    else:
        assert precession(trajectory) == pytest.approx(facts["precession"], rel=tol.FAST_TOP)


def precession(trajectory) -> float:
    """Mean rate of the axis about the vertical [rad/s], by a line through its angle."""
    axis = np.asarray(trajectory.q)[:, 3]
    angle = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    return float(np.polyfit(np.asarray(trajectory.t), angle, 1)[0])
