"""A million steps, and motions that no integrator can follow.

What could go wrong: an error of one rounding that has the same sign in every step (Newton's last correction,
coefficients of the method, a frame that is orthonormal to round-off only) is invisible in a thousand steps
and makes 1e-10 of a million; and a chaotic path hides an energy that is wrong.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from motions import OPTIMISED, Drift, simulate, simulate_long

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.stepping.endpoint import endpoints

MILLION = 10**6
SAVED = 1000
STEP = {"heavy_top": 1e-3, "dzhanibekov": 1e-2}  # 0.15 and 0.05 rad a step
KEPT_AXES = {"heavy_top": (2,), "dzhanibekov": (0, 1, 2)}

BOOST = {"heavy_top": (0.0, 0.0, 0.0), "dzhanibekov": (1e-3, -2e-3, 1.5e-3)}
"""Velocities [m/s] that the bodies get: without one the free body has no momentum to lose. It travels 27 m;
were it faster, the rounding of its position would be the error of its angular momentum about the origin."""

EVERY_TOP = pytest.mark.parametrize("name", STEP)
EVERY_ORDER = pytest.mark.parametrize(
    "order",
    [2, pytest.param(4, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.exhaustive)],
)


@cache
def example(name: str):
    return gallery.load(name)


@cache
def long_run(name: str, order: int):
    scene = example(name)
    state = replace_fields(scene.state, v=scene.state.v.at[0].add(jnp.array(BOOST[name])))
    options = dict(dt=STEP[name], steps=MILLION, save_every=MILLION // SAVED)
    return account(scene.system, simulate_long(scene.system, state, order=order, **options))


def drifts(name: str, found) -> dict[str, Drift]:
    """Of energy and of every component of the momenta that is kept."""
    energy = found.kinetic + sum(found.stores.values())
    errors = {"energy": (energy - energy[0]) / found.energy_scale}
    kept = {"spin": (found.spins, KEPT_AXES[name])}
    if name != "heavy_top":
        kept["momentum"] = (found.momenta, (0, 1, 2))
    for what, (parts, axes) in kept.items():
        total, scale = parts.sum(axis=1), np.max(np.sum(np.linalg.norm(parts, axis=-1), axis=1))
        errors |= {f"{what} {k}": (total[:, k] - total[0, k]) / scale for k in axes}
    return {what: Drift.of(error, MILLION) for what, error in errors.items()}


@EVERY_ORDER
@EVERY_TOP
def test_a_million_steps(name, order):
    """At the default settings everything is within 1e-10, and energy within far less."""
    found = long_run(name, order)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.MILLION_STEPS_ENERGY[order]
    assert found.spin_error(axes=KEPT_AXES[name]) <= tol.MILLION_STEPS
    if name != "heavy_top":
        assert np.max(np.linalg.norm(found.momenta, axis=-1)) >= 1e-3, "there is no momentum to lose"
        assert found.momentum_error() <= tol.MILLION_STEPS
    assert max(found.directors, found.joints) <= tol.MILLION_STEPS_CONSTRAINT


@EVERY_ORDER
@EVERY_TOP
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


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 10])
def test_no_trend_at_long_steps(order):
    """A body turns by 1.5 rad in every step.

    Could go wrong: coefficients that are rounded once, and lose 1e-15 of the energy in each.
    """
    scene, steps = example("heavy_top"), 20_000
    run = endpoints(scene.system, scene.state, scheme=nc.EnergyMomentum(order))
    start, end = (scene.system.energy(state).total for state in (scene.state, run(0.01, steps).state))
    assert abs(float(end - start)) <= tol.LONG_STEPS * steps * abs(float(start))


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_trends_are_found(alike):
    """Walks score as their direction deserves, also where each increment is like the one before."""
    generator = np.random.default_rng(0)
    scores = {0.0: [], 1.0: []}
    for _ in range(200):
        increments = generator.normal(size=1000)
        for k in range(1, 1000):
            increments[k] += alike * increments[k - 1]
        for steady, found in scores.items():
            # Ten standard errors of the mean increment.
            pull = 10.0 * steady / np.sqrt(1000) / (1 - alike)
            found.append(Drift.of(np.cumsum(np.append(0.0, increments + pull)), 10**6).score)
    assert np.std(scores[0.0]) == pytest.approx(1.0, abs=0.2)
    assert np.mean(np.abs(scores[0.0]) > tol.SCORE) <= 0.01
    assert np.mean(np.abs(scores[1.0]) > tol.SCORE) >= 0.99


# --- chaos ------------------------------------------------------------------------------------------------


@cache
def swinging(order: int, nudge: float = 0.0, steps: int = 100_000):
    """Two rods released horizontally; they turn over for ever."""
    scene = example("double_pendulum")
    system, state = scene.system, scene.state
    state = system.with_coordinate(state, "hinge 2", nudge)
    return system, simulate_long(system, state, order=order, dt=0.005, steps=steps, save_every=100)


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_laws_outlive_the_path(order):
    """Starts 1e-9 rad apart lead to other paths within 500 s; each keeps its energy."""
    paths = []
    for nudge in (0.0, 1e-9):
        system, trajectory = swinging(order, nudge)
        found = account(system, trajectory)
        assert found.energy_error <= tol.ENERGY
        assert max(found.directors, found.joints) <= tol.CONSTRAINT
        paths.append(np.asarray(trajectory.q))
    apart = np.max(np.abs(paths[0] - paths[1]), axis=(1, 2))
    assert apart[0] <= 1e-8
    assert np.max(apart) >= 1.0, "not chaotic: the test means nothing"


@pytest.mark.parametrize(
    "seconds",
    [
        pytest.param(10, marks=pytest.mark.slow),
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
        found = simulate(system, start, checkpoint=True, throw=False, **steps)
        return found.q[-1, 4, 2], found.result

    gradient = jax.jit(jax.value_and_grad(height, has_aux=True), compiler_options=OPTIMISED)
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
