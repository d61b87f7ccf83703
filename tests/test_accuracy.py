"""What accuracy costs in time: rows, reference, table, figure and command line."""

import dataclasses
import importlib
import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import cli, gallery
from natcoord_jax.analysis.accuracy import FALLING, FLAT, ROUND_OFF, SAMPLES, drift, note_of
from natcoord_jax.analysis.accuracy_table import Row


@cache
def measured():
    example = gallery.load("pendulum")
    return nc.accuracy(example.system, example.state, 1.0, orders=(2, 4), steps=(25, 50, 100, 200), repeats=1)


@pytest.mark.slow
def test_rows_tell_the_order():
    results = measured()
    assert [(r.order, r.steps) for r in results.rows] == [(o, n) for o in (2, 4) for n in (25, 50, 100, 200)]
    for order in (2, 4):
        errors = [r.error for r in results.rows if r.order == order]
        observed = np.log2(np.divide(errors[:-1], errors[1:]))
        assert np.all(np.abs(observed - order) <= tol.HIGH_ORDER_TOLERANCE * order), observed
    assert all(r.wall_s > 0 and r.newton > 0 and r.drift <= tol.ENERGY for r in results.rows)
    assert results.reference_error <= 0.2 * min(r.error for r in results.rows)


@pytest.mark.exhaustive
def test_the_reference_is_true():
    """Its end is that of a run of another order, within the error that it states."""
    example = gallery.load("pendulum")
    results = measured()
    other = nc.simulate(
        example.system, example.state, dt=1 / 64, steps=64, scheme=nc.EnergyMomentum(order=6), save_every=64
    )
    coarse = nc.simulate(example.system, example.state, dt=1 / 50, steps=50)
    error = float(jnp.max(jnp.abs(coarse.q[-1] - other.q[-1])))
    row = next(r for r in results.rows if (r.order, r.steps) == (2, 50))
    assert row.error == pytest.approx(error, rel=1e-5)


@pytest.mark.slow
def test_cheapest_and_table():
    results = measured()
    best = results.cheapest(1e-5)
    assert best is not None and best.error <= 1e-5
    assert results.cheapest(1e-30) is None
    text = str(results)
    assert "cheapest for an error of 1e-06" in text and "reference: order 4" in text and "compiled in" in text


REFERENCE = 1e-12


NOTES = [
    (1e-3, np.inf, ""),  # the first run of an order
    (2.5e-4, 1e-3, ""),
    (0.99 * FALLING * 1e-3, 1e-3, ""),
    (1.01 * FALLING * 1e-3, 1e-3, "does not fall"),
    (2e-3, 1e-3, "does not fall"),
    (1.01 * ROUND_OFF * REFERENCE, 1e-9, "does not fall"),
    (0.99 * ROUND_OFF * REFERENCE, 1e-9, "round-off"),
    (1.01 * FLAT * REFERENCE, 2e-12, "round-off"),
    (1.01 * FLAT * REFERENCE, 1e-10, ""),  # falls, and is not yet as good
    (0.99 * FLAT * REFERENCE, 1e-10, "as good as the reference"),
    (0.99 * FLAT * REFERENCE, 1e-12, "as good as the reference"),
    (0.0, 0.0, "as good as the reference"),
]


def test_notes():
    """Could go wrong: a curve that rounding ends passes for one that a defect ends, or the other way."""
    for error, before, said in NOTES:
        assert note_of(error, before, REFERENCE) == said, (error, before)


def by_hand(*rows, reference_error=REFERENCE):
    made = tuple(
        Row(order, steps, error, {"positions": error}, wall_s, 2.0, 1e-15, result)
        for order, steps, error, wall_s, result in rows
    )
    return nc.Accuracy(1.0, made, reference_error, (10, 64), {2: 1.0, 4: 2.0})


def test_cheapest_of_rows_made_by_hand():
    """Could go wrong: the run with the fewest steps, the least error, or that failed, not the fastest."""
    results = by_hand(
        (2, 100, 1e-4, 3e-3, "successful"),
        (2, 200, 2e-5, 5e-3, "successful"),
        (4, 10, 9e-5, 4e-3, "successful"),
        (4, 20, 5e-6, 2e-3, "successful"),  # timed by luck: faster than with half the steps
        (6, 5, 1e-7, 1e-3, "max_iterations"),
        (6, 10, 1e-8, 9e-3, "successful"),
    )

    def best(error):
        row = results.cheapest(error)
        return row and (row.order, row.steps)

    assert best(1e-3) == best(1e-4) == best(5e-6) == (4, 20)
    assert best(4.9e-6) == best(1e-8) == (6, 10)
    assert best(9e-9) is None and best(0.1 * REFERENCE) is None
    assert results.to_dict()["cheapest"]["1e-06"] == {"order": 6, "steps": 10}
    assert results.to_dict()["cheapest"]["1e-10"] is None
    assert "cheapest for an error of 0.0001: order 4, 20 steps, 2 ms" in str(results)
    assert "max_iterations" in str(results)
    # What the reference is no better than cannot be promised, whatever the rows say.
    assert by_hand((2, 100, 1e-9, 3e-3, "successful"), reference_error=1e-6).cheapest(1e-8) is None
    slower_first = by_hand((2, 8, 1e-6, 3e-3, "successful"), (4, 8, 1e-6, 2e-3, "successful"))
    row = slower_first.cheapest(1e-6)
    assert row is not None and row.order == 4


def test_drift_is_the_largest_on_the_way():
    """Could go wrong: energy that is lost and found again does not show at the end."""
    example = gallery.load("pendulum")
    system, start = example.system, example.state

    def with_energy(factor):
        return dataclasses.replace(moving, v=factor * moving.v)

    moving = nc.simulate(system, start, dt=0.01, steps=30).states
    moving = jax.tree.map(lambda x: x[-1], moving)
    energy = system.energy(moving)
    kinetic, faster = float(energy.kinetic), with_energy(1.1)
    scale = 1.21 * kinetic + sum(abs(float(x)) for x in energy.stores.values())
    assert drift(system, moving, moving) == 0.0
    assert drift(system, moving, faster, moving) == pytest.approx(0.21 * kinetic / scale, rel=1e-12)
    assert drift(system, moving, faster, moving) == drift(system, moving, moving, faster)


@pytest.mark.slow
def test_the_column_of_drifts_looks_along_the_way(monkeypatch):
    """Up to so many times a run, whose steps the parts add up to, to the same end."""
    example, looked = gallery.load("pendulum"), []

    def listening(system, *states):
        looked.append([float(s.t) for s in states])
        return drift(system, *states)

    # The function of this name hides the module.
    monkeypatch.setattr(importlib.import_module("natcoord_jax.analysis.accuracy"), "drift", listening)
    nc.accuracy(example.system, example.state, 1.0, orders=(2, 4), steps=(25, 100), repeats=1)
    assert [len(times) for times in looked] == 2 * [26, SAMPLES + 1]
    for times in looked:
        assert times[0] == 0.0 and times[-1] == pytest.approx(1.0, rel=1e-12)
        assert max(np.diff(times)) <= 1.0 / 25 + 1e-12


@pytest.mark.slow
def test_figure(tmp_path):
    nc.plot(measured()).savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.exhaustive
def test_other_quantities():
    example = gallery.load("pendulum")
    results = nc.accuracy(
        example.system, example.state, 1.0, orders=(2, 4), steps=(25,), repeats=1,
        quantities={"height": lambda state: state.q[0, 2], "speed": lambda state: jnp.sum(state.v[0] ** 2)},
    )  # fmt: skip
    assert results.rows[0].errors.keys() == {"height", "speed"}
    assert results.rows[0].error == results.rows[0].errors["height"]


def test_bad_end_times_are_refused():
    example = gallery.load("pendulum")
    for t_end in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="t_end"):
            nc.accuracy(example.system, example.state, t_end)


@pytest.mark.exhaustive
def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ["--time", "0.5", "--orders", "2,4", "--json", "found.json", "--plot", "found.png"]
    assert cli.main(["accuracy", "pendulum", *options]) == 0
    assert "cheapest for an error of" in capsys.readouterr().out
    report = json.loads((tmp_path / "found.json").read_text("utf-8"))
    assert report.keys() >= {"scene", "rows", "compile_s", "reference_error"}
    assert report["rows"][0].keys() >= {"order", "steps", "error", "wall_s", "newton", "drift"}
    assert (tmp_path / "found.png").stat().st_size > 10_000


REFUSED = {
    "no scene 'nothing'": "accuracy nothing",
    "even number": "accuracy pendulum --orders 2,3",
    "--orders": "accuracy pendulum --orders two",
    "--time": "accuracy pendulum --time -1",
    "optimal control": "accuracy reorientation",
}


def test_bad_options_are_refused(capsys):
    for said, arguments in [*REFUSED.items(), ("even number", "run pendulum --order 5")]:
        assert cli.main(arguments.split()) == 2, arguments
        assert said in capsys.readouterr().err
