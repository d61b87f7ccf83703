"""What accuracy costs in time: rows, reference, table, figure and command line."""

import json
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import cli, gallery


@cache
def measured():
    example = gallery.load("pendulum")
    return nc.accuracy(example.system, example.state, 1.0, orders=(2, 4), steps=(25, 50, 100, 200), repeats=1)


def test_rows_tell_the_order():
    found = measured()
    assert [(r.order, r.steps) for r in found.rows] == [(o, n) for o in (2, 4) for n in (25, 50, 100, 200)]
    for order in (2, 4):
        errors = [r.error for r in found.rows if r.order == order]
        observed = np.log2(np.divide(errors[:-1], errors[1:]))
        assert np.all(np.abs(observed - order) <= tol.HIGH_ORDER_TOLERANCE * order), observed
    assert all(r.wall_s > 0 and r.newton > 0 and r.drift <= tol.ENERGY for r in found.rows)
    assert found.reference_error <= 0.2 * min(r.error for r in found.rows)


def test_the_reference_is_true():
    """Its end is that of a run of another order, within the error that it states."""
    example = gallery.load("pendulum")
    found = measured()
    other = nc.simulate(
        example.system, example.state, dt=1 / 64, steps=64, scheme=nc.EnergyMomentum(order=6), save_every=64
    )
    coarse = nc.simulate(example.system, example.state, dt=1 / 50, steps=50)
    error = float(jnp.max(jnp.abs(coarse.q[-1] - other.q[-1])))
    row = next(r for r in found.rows if (r.order, r.steps) == (2, 50))
    assert row.error == pytest.approx(error, rel=1e-5)


def test_cheapest_and_table():
    found = measured()
    best = found.cheapest(1e-5)
    assert best is not None and best.error <= 1e-5
    assert found.cheapest(1e-30) is None
    text = str(found)
    assert "cheapest for an error of 1e-06" in text and "reference: order 4" in text and "compiled in" in text


def test_figure(tmp_path):
    nc.plot(measured()).savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.slow
def test_other_quantities():
    example = gallery.load("pendulum")
    found = nc.accuracy(
        example.system, example.state, 1.0, orders=(2, 4), steps=(25,), repeats=1,
        quantities={"height": lambda state: state.q[0, 2], "speed": lambda state: jnp.sum(state.v[0] ** 2)},
    )  # fmt: skip
    assert found.rows[0].errors.keys() == {"height", "speed"}
    assert found.rows[0].error == found.rows[0].errors["height"]


@pytest.mark.parametrize("t_end", [0.0, -1.0, float("nan")])
def test_bad_end_times_are_refused(t_end):
    example = gallery.load("pendulum")
    with pytest.raises(ValueError, match="t_end"):
        nc.accuracy(example.system, example.state, t_end)


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ["--time", "0.5", "--orders", "2,4", "--json", "found.json", "--plot", "found.png"]
    assert cli.main(["accuracy", "pendulum", *options]) == 0
    assert "cheapest for an error of" in capsys.readouterr().out
    report = json.loads((tmp_path / "found.json").read_text("utf-8"))
    assert report.keys() >= {"scene", "rows", "compile_s", "reference_error"}
    assert report["rows"][0].keys() >= {"order", "steps", "error", "wall_s", "newton", "drift"}
    assert (tmp_path / "found.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["accuracy", "nothing"], "no scene 'nothing'"),
        (["accuracy", "pendulum", "--orders", "2,3"], "even number"),
        (["accuracy", "pendulum", "--orders", "two"], "--orders"),
        (["accuracy", "pendulum", "--time", "-1"], "--time"),
        (["accuracy", "reorientation"], "optimal control"),
        (["run", "pendulum", "--order", "5"], "even number"),
    ],
)
def test_bad_options(arguments, said, capsys):
    assert cli.main(arguments) == 2
    assert said in capsys.readouterr().err
