"""Scenes of the gallery: each runs, keeps its balances, and meets the numbers that are known of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.gallery.spacecraft import TABLE, TORQUE, compare_torques

ELSEWHERE = ("plugging", "panel_slew", "reorientation", "robot_cable", "tennis")
"""Scenes that have tests of their own, and take long."""
SLOW = ("pendulum", "fast_top", "open_tree", "bicycle", "rattleback")
"""Scenes that compile quickly and are not among those of `test_golden`."""
# Balances after a few steps of round-off, relative; loops and drives are solved a little less sharply.
BALANCE = 1e-11
# Second-order error of the suggested step in the quantities below [m, rad/s, relative].
ACCURACY = 5e-3
# Half a unit of the last digit that the table of the paper's manoeuvre prints.
DIGITS = {5: (5e-4, 0.05, 0.5), 10: (0.05, 0.05, 0.5), 20: (0.05, 0.05, 0.05), 40: (0.05, 0.05, 0.05)}
DIGITS |= {80: (5e-4, 0.05, 0.005)}


def keeps_its_balances(example, trajectory):
    errors = nc.balance(example.system, trajectory)
    assert errors.energy.max() <= BALANCE
    assert errors.momentum is None or errors.momentum.max() <= BALANCE
    assert errors.angular_momentum is None or errors.angular_momentum.max() <= BALANCE
    assert float(example.system.constraint_errors(trajectory).position.max()) <= BALANCE


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else pytest.mark.exhaustive)
        for name in gallery.SCENES
        if name not in ELSEWHERE
    ],
)
def test_scenes_run_and_keep_their_balances(name):
    example = gallery.load(name)
    assert example.name == name
    assert gallery.describe(name).endswith(".")
    assert example.system.structure.dofs == example.facts.get("dofs", example.system.structure.dofs)
    keeps_its_balances(example, example.simulate(steps=20))


def test_an_unknown_scene_is_refused():
    with pytest.raises(ValueError, match="no scene 'merry_go_round'"):
        gallery.load("merry_go_round")


def test_double_pendulum_meets_its_reference():
    example = gallery.load("double_pendulum")
    trajectory = example.simulate(steps=500, dt=0.001)
    keeps_its_balances(example, trajectory)
    last = np.asarray(trajectory.q)[-1].reshape(-1, 4, 3)[1]
    tip = last[0] + last[1]
    assert tip == pytest.approx(np.array(example.facts["tip"][0.5]), abs=1e-4)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "time"), [("free_body", 1.0), ("dzhanibekov", 3.0)])
def test_spinning_bodies_meet_their_references(name: str, time: float):
    example = gallery.load(name)
    steps = 4000
    trajectory = example.simulate(steps=steps, dt=time / steps)
    keeps_its_balances(example, trajectory)
    q, v = (np.asarray(x)[-1].reshape(4, 3)[1:] for x in (trajectory.q, trajectory.v))
    spin = 0.5 * np.sum(np.cross(q, v), axis=0)
    assert q @ spin == pytest.approx(np.array(example.facts["body rates"][time]), abs=ACCURACY)


def test_heavy_top_has_the_energy_of_its_reference():
    example = gallery.load("heavy_top")
    energy = float(example.system.energy(example.state).total)
    assert energy == pytest.approx(example.facts["energy"], abs=1e-8)


def test_the_stiff_chain_is_that_of_the_peers():
    """Could go wrong: the scene whose times are published is not the one that the peers are given."""
    work_precision = pytest.importorskip("benchmarks.work_precision", reason="only a checkout has it")
    example = gallery.load("stiff_chain")
    work_precision.check_start("stiff_chain", example)
    stored = example.system.energy(example.state).stores
    assert len([name for name in stored if name.startswith("spring")]) == 5
    assert all(float(stored[f"spring {k}"]) > 0 for k in range(1, 6))


@pytest.mark.slow
def test_the_stiff_chain_swings_slowly():
    """Fast modes, of 80 rad a step, stay at rest: springs are stretched as the swing wants, by a micron."""
    example = gallery.load("stiff_chain")
    trajectory = example.simulate(steps=100)
    assert int(trajectory.steps_taken) == 100
    q = np.asarray(trajectory.q).reshape(101, -1, 4, 3)
    middle, along = q[:, :, 0], q[:, :, 3]
    gaps = np.linalg.norm((middle - 0.1 * along)[:, :-1] - (middle + 0.1 * along)[:, 1:], axis=-1)
    assert np.max(np.abs(gaps - 0.1)) <= 1e-6
    assert np.max(np.abs(middle - middle[0])) >= 0.5, "it does not swing"


@pytest.mark.exhaustive
def test_torque_formulas_give_the_table_of_the_paper():
    comparisons = {(c.formula, c.steps): c for c in compare_torques()}
    for steps, (energy, wrong_energy, wrong_momentum) in TABLE.items():
        digits = DIGITS[steps]
        right, wrong = comparisons["contravariant", steps], comparisons["covariant", steps]
        assert right.energy[-1] == pytest.approx(energy, abs=digits[0])
        assert wrong.energy[-1] == pytest.approx(wrong_energy, abs=digits[1])
        assert wrong.angular_momentum[-1] == pytest.approx(wrong_momentum, abs=digits[2])
        assert np.abs(right.angular_momentum).max() <= 1e-9 * 3 * TORQUE * 5.0
        assert right.t.shape == right.energy.shape == (steps + 1,)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", gallery.SCENES)
def test_modes_of_differentiation_agree(name: str):
    """Forward and reverse, along a change of velocities and one of all masses."""
    example, steps = gallery.load(name), 20
    system, rng = example.system, np.random.default_rng(0)
    inputs = jnp.ones((steps, len(system.structure.inputs)))
    weights, faster = rng.normal(size=(2, *example.state.q.shape))
    point, changes = (example.state.v, jnp.ones(())), (jnp.asarray(faster), jnp.ones(()))

    def loss(point):
        v, factor = point
        heavier = eqx.tree_at(lambda s: s.mass, system, factor * system.mass)
        start = eqx.tree_at(lambda s: s.v, example.state, v)
        end = nc.simulate(heavier, start, dt=example.dt, steps=steps, inputs=inputs).states
        return jnp.sum(weights * (end.q[-1] + end.v[-1]))

    (by_v, by_factor), slope = jax.jit(lambda x: (jax.grad(loss)(x), jax.jvp(loss, (x,), (changes,))[1]))(
        point
    )
    terms = np.append(np.ravel(by_v * faster), by_factor)
    assert np.max(np.abs(terms)) > 0, "nothing is tested"
    assert abs(float(slope) - terms.sum()) <= tol.SAME_DERIVATIVE * np.max(np.abs(terms))
