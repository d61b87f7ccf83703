"""Sweeps: all rows once, whatever happens on the way."""

import concurrent.futures as futures
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from sweeping import AXES, LINE, LINES, STATE, SWEEP, SYSTEM, WORKED, angle, line, rooms

import natcoord_jax as nc

pytest.importorskip("zarr")
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


def is_complete(sweep):
    """All rows are there, with the values that are due."""
    assert sweep.complete and sweep.done.all()
    assert repr(sweep) == "<sweep: 140 of 140 rows done, axes of (20, 7); pair, sum>"
    np.testing.assert_array_equal(sweep["sum"], SUMS)
    np.testing.assert_array_equal(sweep["pair"][..., 1], np.broadcast_to(LINE["y"], (20, 7)))


def assert_only_the_missing_are_worked_through(store):
    """Going on with a sweep that has ended early: no row is missing or made twice."""
    before = nc.Sweep(store)
    missing = ~before.done
    assert 0 < missing.sum() < missing.size
    assert np.isnan(before["sum"][missing]).all()
    WORKED.clear()
    is_complete(nc.sweep(line, store=store, **LINES))
    assert sorted(WORKED) == [(LINE["x"][i], LINE["y"][j]) for i, j in np.argwhere(missing)]


def test_workers_that_never_begin_are_told_from_lost_ones(tmp_path):
    """As where a script lacks its guard: going on does not help."""

    class Broken(futures.Executor):
        def submit(self, function, /, *arguments):
            raise futures.BrokenExecutor("terminated abruptly")

    with pytest.raises(
        RuntimeError, match='0 of .* blocks are done: none by this call.*__name__ == "__main__"'
    ):
        nc.sweep(line, store=tmp_path / "sweep", executor=Broken(), **LINES)


def test_lanes_have_room_for_steps_of_their_bucket():
    """Of 10 to 200 steps: all rows have their values, in blocks of one bucket."""
    steps = np.array([10, 200, 20, 64, 65])
    sweep = nc.sweep(rooms, {"x": np.arange(7.0), "steps": steps}, buckets=("steps",), block=3)
    assert sweep.complete and sweep.shape == (5, 7)  # (steps vary least, so that blocks are of one bucket)
    np.testing.assert_array_equal(sweep["x"], np.zeros((5, 1)) + np.arange(7.0))
    np.testing.assert_array_equal(sweep["number"], steps[:, None] + np.zeros(7))
    np.testing.assert_array_equal(sweep["most"], np.where(steps <= 64, 64, 256)[:, None] + np.zeros(7))


def test_variants_are_those_of_single_runs(programs):
    sweep = nc.sweep(angle, **SWEEP)
    assert sum(name == "jit(lanes)" for name in programs) == 1
    for k, (dt, steps) in enumerate(zip(*AXES["dt", "steps"])):
        for i, mass in enumerate(AXES["mass"]):
            for j, torque in enumerate(AXES["torque"]):
                code = nc.Result(int(sweep["result"][k, i, j]))
                if np.isnan(torque):
                    assert code is nc.Result.NONFINITE
                    continue
                options = {"dt": dt, "steps": int(steps), "inputs": np.array([torque])}
                run = nc.simulate(SYSTEM.set("arm", mass=mass), STATE, **options)
                assert code is nc.Result.SUCCESSFUL
                last = run.states.coordinates[-1, 0]
                np.testing.assert_allclose(sweep["angle"][k, i, j], last, rtol=1e-12)
    words = sweep.explain()
    assert "12 of 12 rows are done" in words and "8: successful" in words and "4: a number became" in words


def test_a_sweep_that_breaks_down_goes_on(tmp_path, monkeypatch):
    """Without a missing or doubled row; what is another sweep is refused."""
    store = tmp_path / "sweep"
    (tmp_path / "flag").touch()
    monkeypatch.setenv("SWEEP_BREAKS", str(tmp_path / "flag"))
    with pytest.raises(Exception, match="this row is broken"):
        nc.sweep(line, store=store, **LINES)
    assert_only_the_missing_are_worked_through(store)
    with pytest.raises(ValueError, match="holds another sweep: the values of 'x' differ"):
        nc.sweep(line, {**LINE, "x": np.arange(20.0) + 1}, block=4, store=store)
    with pytest.raises(ValueError, match="holds another sweep: function differ"):
        nc.sweep(max, LINE, block=4, store=store)


@pytest.mark.slow
def test_a_killed_sweep_goes_on(tmp_path):
    store = tmp_path / "sweep"
    process = started("line", store, SWEEP_SECONDS="0.05")
    try:
        while process.poll() is None:
            if (store / "zarr.json").exists() and len(list((store / "done" / "c").glob("*"))) > 4:
                break
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert_only_the_missing_are_worked_through(store)


@pytest.mark.exhaustive
def test_a_pool_of_processes_works_it_through(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    context = multiprocessing.get_context("spawn")
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        is_complete(nc.sweep(line, store=tmp_path / "sweep", executor=pool, **LINES))
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


@pytest.mark.exhaustive
def test_a_pool_that_loses_a_process_is_followed_by_another(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    monkeypatch.setenv("LOST", str(tmp_path / "flag"))
    context = multiprocessing.get_context("spawn")
    nc.sweep(lost, {"x": [0.0], "y": [0.0]}, store=tmp_path / "other")  # (nobody dies without the flag)
    (tmp_path / "flag").touch()
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        with pytest.raises(RuntimeError, match="blocks are done: call nc.sweep again"):
            nc.sweep(lost, store=tmp_path / "sweep", executor=pool, **LINES)
    assert not nc.Sweep(tmp_path / "sweep").complete
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        is_complete(nc.sweep(lost, store=tmp_path / "sweep", executor=pool, **LINES))


@pytest.mark.exhaustive
def test_two_dask_workers_one_of_which_is_killed(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", ENV["PYTHONPATH"])
    monkeypatch.setenv("LOST", str(tmp_path / "flag"))
    (tmp_path / "flag").touch()
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1"}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        is_complete(nc.sweep(lost, store=tmp_path / "sweep", executor=client.get_executor(), **LINES))
    assert not (tmp_path / "flag").exists()


@pytest.mark.exhaustive
def test_lanes_go_to_all_devices(tmp_path):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    process = started("devices", tmp_path / "two", XLA_FLAGS=flags)
    words, _ = process.communicate()
    assert process.returncode == 0 and words.startswith("2 12 of 12 rows are done")
    one = nc.sweep(angle, store=tmp_path / "one", **SWEEP)
    np.testing.assert_allclose(nc.Sweep(tmp_path / "two")["angle"], one["angle"], rtol=1e-12)


@pytest.mark.slow
def test_two_processes_of_a_job_share_it(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [started("share", tmp_path / "sweep", k, port) for k in range(2)]
    try:
        words = [process.communicate(timeout=120)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [x.split()[-1] for x in words] == ["2", "2"]
    is_complete(nc.Sweep(tmp_path / "sweep"))


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
    piece = nc.simulate(SYSTEM, STATE, dt=0.01, steps=7)
    some = nc.simulate(SYSTEM, STATE, dt=0.01, steps=nc.Steps(7, 64))
    np.testing.assert_allclose(some.q[:8], piece.q, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(some.q[8:], np.broadcast_to(some.q[7], (57, 4, 3)))
    assert int(some.result) == 0 and int(some.steps_taken) == 7
    many = nc.simulate(SYSTEM, STATE, dt=0.01, steps=nc.Steps(65, 64), throw=False)
    assert nc.Result(int(many.result)) is nc.Result.MAX_SUBSTEPS
    with pytest.raises(ValueError, match="every state saved"):
        nc.simulate(SYSTEM, STATE, dt=0.01, steps=nc.Steps(10, 20), save_every=5)
