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
from motions import orders, simulate

import natcoord_jax as nc
from natcoord_jax import Result, SimulationError

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


IMPOSSIBLE = 1e12  # [N m]: no substep that is left is short enough
LANES = {
    "sound": (1.0, Result.SUCCESSFUL),
    "no number": (jnp.nan, Result.NONFINITE),
    "another": (-2.0, Result.SUCCESSFUL),
    "blown": (IMPOSSIBLE, Result.MAX_SUBSTEPS),
    "infinite": (jnp.inf, Result.NONFINITE),
}


@orders(second="users")
def test_sick_lanes(order):
    """Inputs that are no numbers, and a blow beyond all substeps; others are what they are alone.

    Could go wrong: such a number spoils all unknowns of the step, and the first, the other hinge, is named.
    """
    system, _ = arms()
    torques = jnp.stack([history(value) for value, _ in LANES.values()])
    batch = jax.vmap(program(order))(torques)
    assert [Result(int(x)) for x in batch.result] == [code for _, code in LANES.values()]
    np.testing.assert_array_equal(batch.failed_step, [STEPS, SICK, STEPS, SICK, SICK])
    np.testing.assert_array_equal(batch.failed_part[jnp.array([0, 2])], -1)
    words = system.explain(batch).splitlines()
    assert words[0] == "3 of 5 lanes failed" and len(words) == 3, words
    _, sick, blown = sorted(words, key=lambda line: ("became infinite" in line) + 2 * ("substeps" in line))
    assert "a number became infinite" in sick and "lane 1 in step 500" in sick
    assert "not finite: the input 'motor 1'" in sick
    assert "more substeps were needed" in blown and "lane 3 in step 500" in blown
    assert re.search(r"worst residual at joint 'hinge [01]'", blown)
    sound = np.asarray(batch.q[0])
    for lane, (name, (_, code)) in enumerate(LANES.items()):
        places = np.asarray(batch.q[lane])
        assert np.all(np.isfinite(places)), name
        assert np.max(np.abs(places[: SICK + 1] - sound[: SICK + 1])) <= tol.SAME_TRAJECTORY, name
        if not code.ok:
            assert np.all(places[SICK + 1 :] == places[SICK + 1]), (
                f"{name}: the last sound state is not repeated"
            )
    for lane in (0, 1, 2):
        alone = program(order)(torques[lane])
        assert int(alone.result) == int(batch.result[lane])
        assert np.max(np.abs(batch.q[lane] - alone.q)) <= tol.SAME_TRAJECTORY
        if lane == 1:
            assert float(alone.failed_time) == pytest.approx(SICK * STEP, abs=1e-12)
            assert "step 500 at t = 0.5 s" in system.explain(alone)


def apart(released: int):
    """Two pendulums on their own: one hangs at rest, one is released horizontally."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    for k in range(2):
        com = (0.5, 0.0, 0.0) if k == released else (0.0, 0.0, -0.5)
        arm = nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=com, name=f"arm {k}")
        scene.add(nc.Revolute(nc.ground, scene.add(arm), point=(0, 0, 0), axis=(0, 1, 0), name=f"hinge {k}"))
    return scene.compile()


@orders(second="")
def test_a_step_that_cannot_be_made(order):
    """Far too long, without substeps to spend: an eager call says where, with what was computed before.

    The pendulum at rest has nothing to do with it: the other one's hinge is named.
    """
    released = 1 if order == 2 else 0
    system, state = apart(released)
    with pytest.raises(SimulationError, match=rf"in step \d+ at t = .*joint 'hinge {released}'") as caught:
        simulate(system, state, order=order, dt=1.0, steps=7, extra_substeps=0)
    run = caught.value.trajectory
    assert caught.value.result is Result(int(run.result)) is Result.MAX_SUBSTEPS
    assert bool(jnp.all(jnp.isfinite(run.q)))
    assert bool(jnp.all(run.q[int(run.failed_step) + 1 :] == run.q[-1]))


def singular(inertia: float):
    """An ideal rod that may spin about itself; its inertia there is set to zero after the checks."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = nc.RigidBody(mass=1.0, inertia=(inertia, 0.1, 0.1), com=(0.5, 0, 0), name="rod")
    scene.add(nc.Spherical(nc.ground, scene.add(rod), point=(0.0, 0.0, 0.0), name="ball"))
    return scene


@orders(second="")
def test_a_singular_scene(order):
    """Refused by name when built; inside jit, where it cannot be, no number that is not one is returned."""
    with pytest.raises(ValueError, match=r"'ball'|'rod'"):
        singular(0.0).compile()
    system, state = singular(0.01).compile()
    block = system.get("rod", "mass_block")

    @jax.jit
    def lighter(factor):
        # Moments of the two axes across carry the inertia about the rod.
        thin = block.at[2, 2].multiply(factor).at[3, 3].multiply(factor)
        changed = system.set("rod", mass_block=thin)
        return simulate(changed, state, order=order, dt=0.01, steps=20, throw=False)

    sound, run = lighter(1.0), lighter(0.0)
    assert Result(int(sound.result)) is Result.SUCCESSFUL
    assert bool(jnp.all(jnp.isfinite(run.q)))
    assert not Result(int(run.result)).ok
    assert int(run.failed_step) == 0 and float(run.failed_time) == 0.0
    words = system.explain(run)
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
run = nc.simulate(system, state, dt=jax.numpy.float32(0.1), steps=3)
assert run.q.dtype == "float64"
"""


def test_single_precision_is_refused():
    """There is no way to single precision, asked for or not, and none of its numbers passes for double.

    A scene is refused with the line to add; a system whose numbers were cast afterwards is refused too. What
    remains true of single precision is nothing: no claim of this library is made for it. A step given in
    single precision is taken as the number it is; the trajectory stays double.
    """
    process = subprocess.run([sys.executable, "-c", ASKED], cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:] + process.stdout


@pytest.mark.slow
def test_a_drive_beyond_a_dead_centre_is_named():
    """A rod between two slides at right angles, one of them driven as far as the rod is long: no smaller step
    gets it there."""
    scene = nc.Scene()
    places = {"driven": (0.6, 0.0, 0.0), "other": (0.0, 0.8, 0.0)}
    blocks = [
        scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), position=place, name=name))
        for name, place in places.items()
    ]
    slides = [
        scene.add(nc.Prismatic(nc.ground, b, axis=places[b.name], name=f"slide of {b.name}")) for b in blocks
    ]
    scene.add(nc.Rod(tuple(map(nc.Point, blocks)), name="rod"))
    scene.add(nc.Drive(slides[0], function=lambda t: 0.5 * t, name="drive"))
    system, state = scene.compile(assemble=True)
    with pytest.raises(
        nc.SimulationError, match="'drive' asks for what the mechanism cannot follow"
    ) as caught:
        nc.simulate(system, state, dt=0.05, steps=40)
    assert "smaller dt" not in str(caught.value) and 0.75 < float(caught.value.trajectory.t[-1]) < 0.8
