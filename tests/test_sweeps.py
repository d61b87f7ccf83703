"""Sweeps: every row once, whatever happens on the way."""

import concurrent.futures as futures
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from sweeping import AXES, LINE, LINES, SWEEP, angle, line, swing

import natcoord_jax as nc
from natcoord_jax.sweeps import run as running
from natcoord_jax.sweeps.grid import Grid

pytestmark = pytest.mark.skipif(find_spec("zarr") is None, reason="no zarr: install the extra store")
TESTS = Path(__file__).parent
ENV = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])}
SUMS = LINE["x"][:, None] + LINE["y"]


def started(*command, **env):
    return subprocess.Popen(
        [sys.executable, str(TESTS / "sweeping.py"), *map(str, command)],
        env=ENV | env,
        text=True,
        stdout=subprocess.PIPE,
    )


def is_whole(found):
    """Every row is there, with the value that is due."""
    assert found.complete and found.done.all()
    assert repr(found) == "<sweep: 140 of 140 rows done, axes of (20, 7); pair, sum>"
    np.testing.assert_array_equal(found["sum"], SUMS)
    np.testing.assert_array_equal(found["pair"][..., 1], np.broadcast_to(LINE["y"], (20, 7)))


def test_rows_are_in_blocks_of_one_bucket():
    grid = Grid.of(AXES, ("steps",), 5)
    assert grid.names == ["dt", "steps", "mass", "torque"] and grid.shape == (3, 3, 4)
    blocks = [grid.block(k) for k in range(grid.blocks)]
    rows = [row for block in blocks for row in range(block.first, block.first + block.count)]
    assert rows == list(range(36))
    assert [block.place for block in blocks] == [5 * k for k in range(len(blocks))]
    for block in blocks:
        values = grid.values(np.arange(block.first, block.first + block.count))
        assert (values["steps"] <= dict(block.rooms)["steps"]).all()
    assert {dict(block.rooms)["steps"] for block in blocks} == {64, 256}
    # A billion of rows takes no more memory than their axes.
    many = Grid.of({name: np.arange(1000.0) for name in "abc"}, (), 65536)
    assert many.rows == 10**9 and many.block(many.blocks - 1).count == 10**9 % 65536
    assert many.values(np.array([123456789])) == {"a": 123.0, "b": 456.0, "c": 789.0}


@pytest.mark.slow
def test_variants_are_those_of_single_runs(tmp_path, programs):
    system, state = swing()
    found = nc.sweep(angle, store=tmp_path / "sweep", **SWEEP)
    assert sum(name == "jit(lanes)" for name in programs) == 2  # (one program a bucket)
    for k, (dt, steps) in enumerate(zip(*AXES["dt", "steps"])):
        for i, mass in enumerate(AXES["mass"]):
            for j, torque in enumerate(AXES["torque"]):
                code = nc.Result(int(found["result"][k, i, j]))
                if np.isnan(torque):
                    assert code is nc.Result.NONFINITE
                    continue
                given = {"dt": dt, "steps": int(steps), "inputs": np.array([torque])}
                run = nc.simulate(system.set("arm", mass=mass), state, **given)
                assert code is nc.Result.SUCCESSFUL
                last = run.states.coordinates[-1, 0]
                np.testing.assert_allclose(found["angle"][k, i, j], last, rtol=1e-12)
    told = found.explain()
    assert "36 of 36 rows are done" in told and "27: successful" in told and "9: a number became" in told


def test_a_killed_sweep_goes_on_without_a_missing_or_doubled_row(tmp_path, monkeypatch):
    store = tmp_path / "sweep"
    process = started("slowly", store)
    try:
        while process.poll() is None:
            if (store / "zarr.json").exists() and len(list((store / "done" / "c").glob("*"))) > 4:
                break
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    before = nc.Sweep(store)
    done = before.done_blocks
    assert process.returncode == -signal.SIGKILL and 4 < done.sum() < len(done)
    assert np.isnan(before["sum"][~before.done]).all()
    worked = []
    once = running._worked
    monkeypatch.setattr(running, "_worked", lambda *given: worked.append(given[2]) or once(*given))
    is_whole(nc.sweep(line, store=store, **LINES))
    assert worked == np.flatnonzero(~done).tolist()
    with pytest.raises(ValueError, match="holds another sweep: the values of 'x' differ"):
        nc.sweep(line, {**LINE, "x": np.arange(20.0) + 1}, block=4, store=store)
    with pytest.raises(ValueError, match="holds another sweep: function differ"):
        nc.sweep(max, LINE, block=4, store=store)


@pytest.mark.slow
def test_a_pool_of_processes_works_it_through(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    context = multiprocessing.get_context("spawn")
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        is_whole(nc.sweep(line, store=tmp_path / "sweep", executor=pool, **LINES))
    with pytest.raises(ValueError, match="pass its name as `store`"):
        nc.sweep(line, executor=pool, **LINES)


def lost(x, y):
    """A worker that dies once, in the middle."""
    import pathlib

    import jax

    flag = pathlib.Path(os.environ["LOST"])
    if flag.exists():
        flag.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"sum": x + y, "pair": jax.numpy.stack([x, y])}


@pytest.mark.slow
def test_a_pool_that_loses_a_process_is_followed_by_another(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    monkeypatch.setenv("LOST", str(tmp_path / "flag"))
    context = multiprocessing.get_context("spawn")
    nc.sweep(lost, {"x": [0.0], "y": [0.0]}, store=tmp_path / "other")  # (nobody dies without the flag)
    table = running._table(lost, Grid.of(LINE, (), 4), tmp_path / "sweep")
    (tmp_path / "flag").touch()
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        with pytest.raises(RuntimeError, match="blocks are done: call nc.sweep again"):
            nc.sweep(lost, store=tmp_path / "sweep", executor=pool, **LINES)
    assert not table.complete
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        is_whole(nc.sweep(lost, store=tmp_path / "sweep", executor=pool, **LINES))


@pytest.mark.slow
def test_two_dask_workers_one_of_which_is_killed(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    monkeypatch.setenv("LOST", str(tmp_path / "flag"))
    running._table(lost, Grid.of(LINE, (), 4), tmp_path / "sweep")
    (tmp_path / "flag").touch()
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1"}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        is_whole(nc.sweep(lost, store=tmp_path / "sweep", executor=client.get_executor(), **LINES))
    assert not (tmp_path / "flag").exists()


@pytest.mark.slow
def test_lanes_go_to_all_devices(tmp_path):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    process = started("devices", tmp_path / "two", XLA_FLAGS=flags)
    told, _ = process.communicate()
    assert process.returncode == 0 and told.startswith("2 36 of 36 rows are done")
    swing()
    one = nc.sweep(angle, store=tmp_path / "one", **SWEEP)
    np.testing.assert_allclose(nc.Sweep(tmp_path / "two")["angle"], one["angle"], rtol=1e-12)


@pytest.mark.slow
def test_two_processes_of_a_job_share_it(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [started("share", tmp_path / "sweep", k, port) for k in range(2)]
    try:
        told = [process.communicate(timeout=120)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [x.split()[-1] for x in told] == ["2", "2"]
    is_whole(nc.Sweep(tmp_path / "sweep"))


def test_what_does_not_fit_is_refused(tmp_path):
    with pytest.raises(ValueError, match="'x' needs a list of values"):
        nc.sweep(line, {"x": [], "y": [1.0]})
    with pytest.raises(ValueError, match="as many lists of one length as names"):
        nc.sweep(line, {("x", "y"): ([1.0, 2.0], [1.0])})
    with pytest.raises(ValueError, match=r"there is no axis \['steps'\]"):
        nc.sweep(line, LINE, buckets=("steps",))
    with pytest.raises(ValueError, match="there is no sweep in"):
        nc.Sweep(tmp_path / "nothing")
    with pytest.raises(KeyError, match="it has"):
        nc.sweep(line, {"x": [1.0], "y": [1.0]})["product"]


def test_steps_are_traced_up_to_a_largest_number():
    system, state = swing()
    whole = nc.simulate(system, state, dt=0.01, steps=7)
    some = nc.simulate(system, state, dt=0.01, steps=nc.Steps(7, 64))
    np.testing.assert_allclose(some.q[:8], whole.q, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(some.q[8:], np.broadcast_to(some.q[7], (57, 4, 3)))
    assert int(some.result) == 0 and int(some.steps_taken) == 7
    many = nc.simulate(system, state, dt=0.01, steps=nc.Steps(65, 64), throw=False)
    assert nc.Result(int(many.result)) is nc.Result.MAX_SUBSTEPS
    with pytest.raises(ValueError, match="every state saved"):
        nc.simulate(system, state, dt=0.01, steps=nc.Steps(10, 20), save_every=5)
