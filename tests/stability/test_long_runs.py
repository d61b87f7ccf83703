"""A million steps, and motions that no integrator can follow.

What could go wrong: an error of one rounding that has the same sign in every step (Newton's last correction,
coefficients of the method, a frame that is orthonormal to round-off only) is invisible in a thousand steps
and makes 1e-10 of a million; and a chaotic path hides an energy that is wrong.
"""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from motions import Drift, losses, simulate

import natcoord_jax as nc
from natcoord_jax import gallery

MILLION = 10**6
SAVED = 1000
STEP = {"heavy_top": 1e-3, "dzhanibekov": 1e-2}  # 0.15 and 0.05 rad a step
KEPT_AXES = {"heavy_top": (2,), "dzhanibekov": (0, 1, 2)}

BOOST = {"heavy_top": (0.0, 0.0, 0.0), "dzhanibekov": (1e-3, -2e-3, 1.5e-3)}
"""Velocities [m/s] that the bodies get: without one the free body has no momentum to lose. It travels 27 m;
were it faster, the rounding of its position would be the error of its angular momentum about the origin."""

TOPS = pytest.mark.parametrize(
    ("name", "order"),
    [
        pytest.param("dzhanibekov", 4, marks=pytest.mark.slow),
        pytest.param("heavy_top", 2, marks=pytest.mark.slow),
        pytest.param("dzhanibekov", 2, marks=pytest.mark.exhaustive),
        pytest.param("heavy_top", 4, marks=pytest.mark.exhaustive),
        pytest.param("dzhanibekov", 6, marks=pytest.mark.exhaustive),
        pytest.param("heavy_top", 6, marks=pytest.mark.exhaustive),
    ],
)


@cache
def example(name: str):
    return gallery.load(name)


@cache
def long_run(name: str, order: int):
    scene = example(name)
    state = dataclasses.replace(scene.state, v=scene.state.v.at[0].add(jnp.array(BOOST[name])))
    options = dict(dt=STEP[name], steps=MILLION, save_every=MILLION // SAVED)
    return account(scene.system, simulate(scene.system, state, order=order, **options))


def drifts(name: str, laws) -> dict[str, Drift]:
    """Of energy and of every component of the momenta that is kept."""
    energy = laws.kinetic + sum(laws.stores.values())
    errors = {"energy": (energy - energy[0]) / laws.energy_scale}
    kept = {"spin": (laws.spins, KEPT_AXES[name])}
    if name != "heavy_top":
        kept["momentum"] = (laws.momenta, (0, 1, 2))
    for what, (parts, axes) in kept.items():
        total, scale = parts.sum(axis=1), np.max(np.sum(np.linalg.norm(parts, axis=-1), axis=1))
        errors |= {f"{what} {k}": (total[:, k] - total[0, k]) / scale for k in axes}
    return {what: Drift.of(error, MILLION) for what, error in errors.items()}


@TOPS
def test_a_million_steps(name, order):
    """At the default settings all is within 1e-10, and energy within far less."""
    laws = long_run(name, order)
    bounds = {"energy": tol.MILLION_STEPS_ENERGY[order], "constraint": tol.MILLION_STEPS_CONSTRAINT}
    assert not losses(laws, **bounds)
    assert laws.spin_error(axes=KEPT_AXES[name]) <= tol.MILLION_STEPS
    if name != "heavy_top":
        assert np.max(np.linalg.norm(laws.momenta, axis=-1)) >= 1e-3, "there is no momentum to lose"
        assert laws.momentum_error() <= tol.MILLION_STEPS


@TOPS
def test_no_trend(name, order):
    """At the default settings, too, drifts are walks without direction: all at order two.

    At orders four and six some are not. What is steady is listed by name, with a bound for every step: a
    fraction of a rounding, which a million steps add up to 3e-12.
    """
    for what, drift in drifts(name, long_run(name, order)).items():
        steady = tol.STEADY_PARTS.get((name, order, what.split()[0]))
        if steady is None:
            assert abs(drift.score) <= tol.SCORE, (what, drift)
        else:
            assert abs(drift.rate) + 2 * drift.error <= steady, (what, drift)


@pytest.mark.parametrize(
    "order",
    [pytest.param(4, marks=pytest.mark.slow), pytest.param(10, marks=pytest.mark.exhaustive)],
)
def test_no_trend_at_long_steps(order):
    """A body turns by 1.5 rad in each step.

    Could go wrong: coefficients that are rounded once, and lose 1e-15 of the energy in each.
    """
    scene, steps = example("heavy_top"), 20_000
    run = simulate(scene.system, scene.state, order=order, dt=0.01, steps=steps, save_every=steps)
    start, end = map(float, scene.system.energy(run).total)
    assert abs(end - start) <= tol.LONG_STEPS * steps * abs(start)


@pytest.mark.slow
@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_trends_are_found(alike):
    """Walks score as their direction deserves, also where each increment is like the one before."""
    generator = np.random.default_rng(0)
    scores = {0.0: [], 1.0: []}
    for _ in range(200):
        increments = generator.normal(size=1000)
        for k in range(1, 1000):
            increments[k] += alike * increments[k - 1]
        for steady, runs in scores.items():
            # Ten standard errors of the mean increment.
            pull = 10.0 * steady / np.sqrt(1000) / (1 - alike)
            runs.append(Drift.of(np.cumsum(np.append(0.0, increments + pull)), 10**6).score)
    assert np.std(scores[0.0]) == pytest.approx(1.0, abs=0.2)
    assert np.mean(np.abs(scores[0.0]) > tol.SCORE) <= 0.01
    assert np.mean(np.abs(scores[1.0]) > tol.SCORE) >= 0.99


# --- chaos ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "order",
    [pytest.param(2, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.exhaustive)],
)
def test_laws_outlive_the_path(order):
    """Two rods turn over for ever: starts 1e-9 rad apart lead to other paths within 500 s; each keeps its
    energy."""
    scene, paths = example("double_pendulum"), []
    for nudge in (0.0, 1e-9):
        state = scene.system.with_coordinate(scene.state, "hinge 2", nudge)
        run = simulate(scene.system, state, order=order, dt=0.005, steps=100_000, save_every=100)
        assert not losses(account(scene.system, run)), nudge
        paths.append(np.asarray(run.q))
    apart = np.max(np.abs(paths[0] - paths[1]), axis=(1, 2))
    assert apart[0] <= 1e-8
    assert np.max(apart) >= 1.0, "not chaotic: the test means nothing"


@pytest.mark.parametrize(
    "seconds",
    [
        pytest.param(10, marks=pytest.mark.exhaustive),
        pytest.param(100, marks=pytest.mark.exhaustive),
        pytest.param(2000, marks=pytest.mark.exhaustive),
    ],
)
def test_gradients_of_a_chaotic_path(seconds):
    """They grow as the path forgets its start. Could go wrong: a number that is none of them; and no word of
    why there is none where it is too large: `nc.tangent_growth` tells, whatever the time."""
    scene = example("double_pendulum")
    system, state = scene.system, scene.state
    steps = dict(dt=0.01, steps=100 * seconds, save_every=100)

    def height(angle):
        start = system.with_coordinate(state, "hinge 2", angle)
        run = simulate(system, start, checkpoint=True, throw=False, **steps)
        return run.q[-1, 4, 2], run.result

    gradient = jax.jit(jax.value_and_grad(height, has_aux=True))
    (value, result), slope = gradient(0.01)
    assert int(result) == 0
    assert bool(jnp.isfinite(value))
    growth = nc.tangent_growth(system, system.with_coordinate(state, "hinge 2", 0.01), **steps)
    too_large = [line for line in growth.explain().splitlines() if "too large to be numbers" in line]
    if seconds == 10:
        assert float(growth.decades[-1]) > 4, "not chaotic: the test means nothing"
        along = jax.jvp(lambda a: height(a)[0], (0.01,), (1.0,))[1]
        np.testing.assert_allclose(slope, along, rtol=1e-7)
        ends = [height(0.01 + change)[0] for change in (-1e-8, 1e-8)]
        np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-8, rtol=1e-3)
        return
    assert 0.8 <= float(growth.rate) <= 1.5  # [1/s]
    if seconds == 100:
        # The path depends on rounding of its start, and so does its derivative; the rate of growth does not.
        assert "nowhere" in too_large[0]
        assert 0.8 <= np.log(abs(float(slope))) / seconds <= 1.5
    else:
        assert not bool(jnp.isfinite(slope))
        assert "from t = " in too_large[0] and growth.decades[-1] > 308
