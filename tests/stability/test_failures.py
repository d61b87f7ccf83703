"""Failures on purpose, and precision that was not asked for.

What could go wrong: a NaN that is returned as a result, or that reaches back into states that were sound; a
run that ends without saying where; a batch that is lost with one of its lanes; numbers of single precision
that pass for those of double.
"""

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from motions import SECOND_AND_FOURTH, simulate

import natcoord_jax as nc
from natcoord_jax.core.results import Result, SimulationError
from natcoord_jax.stepping import after_attempt

ROOT = Path(__file__).resolve().parents[2]
STEP, SICK, STEPS = 0.001, 500, 600


@cache
def arms():
    """Two arms with motors."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    carrier = nc.ground
    for k in range(2):
        arm = nc.RigidBody(
            mass=1.0, inertia=(0.02, 0.1, 0.1), com=(0.5, 0, 0), position=(float(k), 0, 0), name=f"arm {k}"
        )
        body = scene.add(arm)
        hinge = scene.add(
            nc.Revolute(carrier, body, point=(float(k), 0, 0), axis=(0, 1, 0), name=f"hinge {k}")
        )
        scene.add(nc.JointTorque(hinge, name=f"motor {k}"))
        carrier = body
    return scene.compile()


def history(bad):
    """Torques of every step, the second one `bad` in step 500."""
    torques = jnp.sin(0.01 * jnp.arange(STEPS))[:, None] * jnp.array([3.0, 1.0])
    return torques.at[SICK, 1].set(bad)


@cache
def program(order):
    """Inside jit, where nothing can be refused beforehand."""
    system, state = arms()
    return jax.jit(lambda u: simulate(system, state, order=order, dt=STEP, inputs=u, throw=False))


def run(torques, order):
    return program(order)(torques)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
@SECOND_AND_FOURTH
def test_an_input_that_is_no_number(order, bad):
    """In step 500: the result says so, by step, time and input; before it all is as in a sound run.

    Could go wrong: such a number spoils all unknowns of the step, and the first, the other hinge, is named.
    """
    system, _ = arms()
    found, sound = run(history(bad), order), run(history(1.0), order)
    assert Result(int(found.result)) is Result.NONFINITE
    assert Result(int(sound.result)) is Result.SUCCESSFUL
    assert int(found.failed_step) == SICK
    assert float(found.failed_time) == pytest.approx(SICK * STEP, abs=1e-12)
    words = system.explain(found)
    assert "step 500 at t = 0.5 s" in words and "not finite: the input 'motor 1'" in words
    for x, y in zip(jax.tree.leaves(found.states), jax.tree.leaves(sound.states), strict=True):
        assert np.array_equal(x[: SICK + 1], y[: SICK + 1]), "the failure reaches back"
        assert bool(jnp.all(x[SICK:] == x[SICK])), "states after the failure repeat the last sound one"


IMPOSSIBLE = 1e12  # [N m]: no substep that is left is short enough


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_sick_lanes(order):
    """One with an input that is no number, one with a blow beyond all substeps; others are what they are."""
    system, _ = arms()
    torques = jnp.stack([history(1.0), history(jnp.nan), history(-2.0), history(IMPOSSIBLE)])
    found = jax.vmap(lambda u: run(u, order))(torques)
    assert [Result(int(x)) for x in found.result] == [
        Result.SUCCESSFUL, Result.NONFINITE, Result.SUCCESSFUL, Result.MAX_SUBSTEPS
    ]  # fmt: skip
    np.testing.assert_array_equal(found.failed_step, [STEPS, SICK, STEPS, SICK])
    assert bool(jnp.all(jnp.isfinite(found.q)))
    for lane in (0, 2):
        alone = run(torques[lane], order)
        assert np.max(np.abs(found.q[lane] - alone.q)) <= tol.SAME_TRAJECTORY
    sound = np.asarray(found.q[0])
    for lane in (1, 3):
        assert np.max(np.abs(found.q[lane, : SICK + 1] - sound[: SICK + 1])) <= tol.SAME_TRAJECTORY
        rest = found.q[lane, SICK + 1 :]
        assert bool(jnp.all(rest == rest[0])), "states after the failure repeat the last one"
    words = system.explain(found).splitlines()
    assert words[0] == "2 of 4 lanes failed" and len(words) == 3
    _, sick, blown = words
    assert "a number became infinite" in sick and "lane 1 in step 500" in sick
    assert "not finite: the input 'motor 1'" in sick
    assert "more substeps were needed" in blown and "lane 3 in step 500" in blown
    assert re.search(r"worst residual at joint 'hinge [01]'", blown)
    np.testing.assert_array_equal(found.failed_part[jnp.array([0, 2])], -1)


def test_a_feedback_that_breaks():
    """The same by a function of time, raised by an eager call with what was computed."""
    system, state = arms()

    def feedback(t, _):
        return jnp.sqrt(0.4995 - t) * jnp.ones(2)

    with pytest.raises(SimulationError, match=r"step 500 at t = 0.5 s") as caught:
        nc.simulate(system, state, dt=STEP, steps=STEPS, inputs=feedback)
    assert caught.value.result is Result.NONFINITE
    assert bool(jnp.all(jnp.isfinite(caught.value.trajectory.q)))
    assert int(caught.value.trajectory.steps_taken) == SICK


def apart(released: int):
    """Two pendulums on their own: one hangs at rest, one is released horizontally."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    for k in range(2):
        com = (0.5, 0.0, 0.0) if k == released else (0.0, 0.0, -0.5)
        arm = nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=com, name=f"arm {k}")
        scene.add(nc.Revolute(nc.ground, scene.add(arm), point=(0, 0, 0), axis=(0, 1, 0), name=f"hinge {k}"))
    return scene.compile()


@SECOND_AND_FOURTH
def test_newton_starved(order, monkeypatch):
    """With one factorisation and no patience the iteration cannot converge, and says so at the first step.

    The pendulum at rest has nothing to do with it: the other one's hinge is named.
    """
    from natcoord_jax.stepping import newton

    released = 1 if order == 2 else 0
    system, state = apart(released)
    monkeypatch.setattr(newton, "NEWTON_ROUNDS", 1)
    monkeypatch.setattr(newton, "CHORD_ITERATIONS", 1)
    monkeypatch.setattr(after_attempt, "SMALLEST_FRACTION", 1.0)
    jax.clear_caches()
    try:
        with pytest.raises(
            SimulationError, match=rf"did not converge.* in step 0 at t = 0 s.*joint 'hinge {released}'"
        ) as caught:
            simulate(system, state, order=order, dt=0.37, steps=7, newton_tol=1e-16)
    finally:
        jax.clear_caches()
    assert caught.value.result is Result.MAX_ITERATIONS
    assert bool(jnp.all(caught.value.trajectory.q == state.q))


def singular(inertia: float):
    """An ideal rod that may spin about itself; its inertia there is set to zero after the checks."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = nc.RigidBody(mass=1.0, inertia=(inertia, 0.1, 0.1), com=(0.5, 0, 0), name="rod")
    scene.add(nc.Spherical(nc.ground, scene.add(rod), point=(0.0, 0.0, 0.0), name="ball"))
    return scene


@SECOND_AND_FOURTH
def test_a_singular_scene(order):
    """Refused by name when built; inside jit, where it cannot be, no number that is not one is returned."""
    with pytest.raises(ValueError, match=r"'ball'|'rod'"):
        singular(0.0).compile()
    system, state = singular(0.01).compile()

    @jax.jit
    def lighter(factor):
        mass = system.mass.at[0, 1, 1].add(0.0)
        moment = mass[:, 2, 2]
        # E^ii of the two long axes carry the inertia about the rod: half the trace of what is taken away.
        mass = mass.at[0, 2, 2].set(factor * moment[0]).at[0, 3, 3].set(factor * mass[0, 3, 3])
        changed = system.__class__(**(vars(system) | {"mass": mass}))
        return simulate(changed, state, order=order, dt=0.01, steps=20, throw=False)

    sound, found = lighter(1.0), lighter(0.0)
    assert Result(int(sound.result)) is Result.SUCCESSFUL
    assert bool(jnp.all(jnp.isfinite(found.q)))
    assert not Result(int(found.result)).ok
    assert int(found.failed_step) == 0 and float(found.failed_time) == 0.0
    words = system.explain(found)
    assert "in step 0 at t = 0 s" in words and ("'ball'" in words or "'rod'" in words)


# --- single precision -------------------------------------------------------------------------------------

ASKED = """
import jax
import natcoord_jax as nc
try:
    nc.Scene()
except ValueError as error:
    assert 'jax.config.update("jax_enable_x64", True)' in str(error), error
else:
    raise SystemExit("a scene was built in single precision")
jax.config.update("jax_enable_x64", True)
scene = nc.Scene()
body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0.0, 1.0, 0.1)))
system, state = scene.compile()
single = jax.tree.map(lambda x: x.astype("float32") if x.dtype == "float64" else x, (system, state))
for run in (lambda: nc.simulate(*single, dt=0.1, steps=3), lambda: nc.step(*single, dt=0.1)):
    try:
        run()
    except ValueError as error:
        assert "float32" in str(error) and "double precision" in str(error), error
    else:
        raise SystemExit("numbers of single precision were taken")
found = nc.simulate(system, state, dt=jax.numpy.float32(0.1), steps=3)
assert found.q.dtype == "float64"
"""


def test_single_precision_is_refused():
    """There is no way to single precision, asked for or not, and none of its numbers passes for double.

    A scene is refused with the line to add; a system whose numbers were cast afterwards is refused too. What
    remains true of single precision is nothing: no claim of this library is made for it. A step given in
    single precision is taken as the number it is; the trajectory stays double.
    """
    found = subprocess.run([sys.executable, "-c", ASKED], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr[-2000:] + found.stdout
