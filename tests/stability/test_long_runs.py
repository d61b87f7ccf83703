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

from natcoord_jax import gallery

MILLION = 10**6
SAVED = 1000
STEP = {"heavy_top": 1e-3, "dzhanibekov": 1e-2}  # 0.15 and 0.05 rad a step
KEPT_AXES = {"heavy_top": (2,), "dzhanibekov": (0, 1, 2)}

EVERY_TOP = pytest.mark.parametrize("name", STEP)
EVERY_ORDER = pytest.mark.parametrize(
    "order", [2, *(pytest.param(order, marks=pytest.mark.slow) for order in (4, 6))]
)


@cache
def example(name: str):
    return gallery.load(name)


@cache
def long_run(name: str, order: int, **options):
    scene = example(name)
    options |= dict(dt=STEP[name], steps=MILLION, save_every=MILLION // SAVED)
    return account(scene.system, simulate_long(scene.system, scene.state, order=order, **options))


def drifts(name: str, found) -> dict[str, Drift]:
    """Of energy and of every component of the angular momentum that is kept."""
    energy = found.kinetic + sum(found.stores.values())
    spins = found.spins.sum(axis=1)
    scale = np.max(np.sum(np.linalg.norm(found.spins, axis=-1), axis=1))
    errors = {"energy": (energy - energy[0]) / found.energy_scale}
    errors |= {f"spin {k}": (spins[:, k] - spins[0, k]) / scale for k in KEPT_AXES[name]}
    return {what: Drift.of(error, MILLION) for what, error in errors.items()}


@EVERY_ORDER
@EVERY_TOP
def test_a_million_steps(name, order):
    """At the default settings: everything within 1e-10, and next to nothing of it steady."""
    found = long_run(name, order)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.MILLION_STEPS
    assert found.spin_error(axes=KEPT_AXES[name]) <= tol.MILLION_STEPS
    assert name == "heavy_top" or found.momentum_error() <= tol.MILLION_STEPS
    assert max(found.directors, found.joints) <= tol.MILLION_STEPS_CONSTRAINT
    for what, drift in drifts(name, found).items():
        assert abs(drift.rate) <= tol.STEADY_PART[order], (what, drift)


@pytest.mark.slow
@EVERY_TOP
def test_no_trend(name):
    """With Newton's iteration carried to where rounding stops it, drifts are walks without direction."""
    for what, drift in drifts(name, long_run(name, 2, newton_tol=tol.NEWTON_TO_THE_END)).items():
        assert abs(drift.score) <= tol.SCORE, (what, drift)


# --- chaos ------------------------------------------------------------------------------------------------


@cache
def swinging(order: int, nudge: float = 0.0, steps: int = 100_000):
    """Two rods released horizontally; they turn over for ever."""
    scene = example("double_pendulum")
    system, state = scene.system, scene.state
    state = system.with_coordinate(state, "hinge 2", nudge)
    return system, simulate_long(system, state, order=order, dt=0.005, steps=steps, save_every=100)


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
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


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [100, 2000])
def test_gradients_of_a_chaotic_path(seconds):
    """They grow as the path forgets its start; where squares overflow they are not finite, never wrong."""
    scene = example("double_pendulum")
    system, state = scene.system, scene.state

    def height(angle):
        start = system.with_coordinate(state, "hinge 2", angle)
        found = simulate(
            system, start, dt=0.01, steps=100 * seconds, save_every=100, checkpoint=True, throw=False
        )
        return found.q[-1, 4, 2], found.result

    (value, result), slope = jax.jit(jax.value_and_grad(height, has_aux=True), compiler_options=OPTIMISED)(
        0.01
    )
    assert int(result) == 0
    assert bool(jnp.isfinite(value))
    if seconds > 100:
        assert not bool(jnp.isfinite(slope))
    else:
        assert 1e3 <= abs(float(slope)) < np.inf, "not chaotic: the test means nothing"
