"""Long runs: in segments, shown, interrupted, stored, killed and gone on with."""

import os
import signal
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.stepping import segments

LAST_DIGITS = 1e-13
"""A run in one piece is another program, in which the compiler may round some sums otherwise, once a step."""


@cache
def swing():
    """A double pendulum with a motor: joints, coordinates, work, an input."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = {"mass": 1.0, "inertia": (0.1, 0.2, 0.1), "com": (0.5, 0.0, 0.0)}
    upper = scene.add(nc.RigidBody(**mass, name="upper"))
    lower = scene.add(nc.RigidBody(**mass, position=(1.0, 0.0, 0.0), name="lower"))
    hinge = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.Revolute(upper, lower, point=(1.0, 0.0, 0.0), axis=(0, 1, 0), name="elbow"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def run(steps=40, **options):
    system, state = swing()
    given = {"dt": 0.01, "inputs": np.linspace(0.0, 2.0, 40)[:steps, None]} | options
    return nc.simulate(system, state, steps=steps, **given)


def assert_same(one, other):
    """Equal to the bit."""
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def pace(monkeypatch, seconds):
    monkeypatch.setattr(segments, "PATIENCE", seconds)


OPTIONS = {
    "plain": {},
    "order four": {"scheme": nc.EnergyMomentum(order=4)},
    "error control": {"rtol": 1e-6},
    "every fifth": {"save_every": 5},
    "event": {"until": lambda state: state.coordinates[0] - 0.1},
    "controller": {"inputs": lambda t, state: np.array([1.0]) - state.coordinates[:1]},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIONS)
def test_states_do_not_depend_on_segments(name, monkeypatch):
    whole = run(**OPTIONS[name])
    pace(monkeypatch, 0.0)  # (of one step each, where every step is saved)
    short = run(progress=True, **OPTIONS[name])
    pace(monkeypatch, 1e9)
    long = run(progress=True, **OPTIONS[name])
    assert_same(short, long)
    assert int(short.result) == int(whole.result)
    for x, y in zip(jax.tree.leaves(short), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(x, y, rtol=LAST_DIGITS, atol=LAST_DIGITS)


def test_states_of_segments_are_those_of_one_piece(monkeypatch, programs):
    whole = run()
    pace(monkeypatch, 0.0)
    short = run(progress=True)
    np.testing.assert_allclose(short.q, whole.q, rtol=LAST_DIGITS, atol=LAST_DIGITS)
    np.testing.assert_allclose(short.v, whole.v, rtol=LAST_DIGITS, atol=LAST_DIGITS)
    counts = [[int(getattr(x, n)) for n in ("result", "failed_step", "steps_taken")] for x in (short, whole)]
    assert counts[0] == counts[1] == [0, 40, 40]
    assert not np.any(np.diff(short.t) <= 0) and not os.isatty(2)
    # Other lengths, and another number of steps that there is room for, compile nothing.
    pace(monkeypatch, 0.01)
    del programs[:]
    run(progress=True)
    run(30, progress=True)
    assert not programs


def test_an_interruption_returns_what_was_reached(monkeypatch):
    pace(monkeypatch, 0.05)
    run(progress=True)  # (compiles)
    before = signal.getsignal(signal.SIGINT)
    begun = time.monotonic()
    threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    system, _ = swing()
    reached = run(progress=True, dt=1e-5, steps=400_000, inputs=np.zeros(1))
    assert time.monotonic() - begun < 2.5
    assert signal.getsignal(signal.SIGINT) is before
    assert nc.Result(int(reached.result)) is nc.Result.INTERRUPTED
    count = int(reached.failed_step)
    assert 0 < count < 400_000 and len(reached) == count + 1
    assert float(reached.t[-1]) == pytest.approx(1e-5 * count) and np.isfinite(reached.q).all()
    assert "interrupted" in system.explain(reached) and "resume=True" in system.explain(reached)


def test_what_is_stored_is_what_ran(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    path = tmp_path / "run.h5"
    pace(monkeypatch, 0.0)
    there, shown = run(store=path), run(progress=True)
    assert_same(there, shown)
    assert_same(nc.load(path), shown)
    assert isinstance(there.q, np.memmap) and float(there[7].t) == float(shown[7].t)
    system, _ = swing()
    np.testing.assert_array_equal(system.energy(there[3:9]).total, system.energy(shown[3:9]).total)
    with pytest.raises(ValueError, match="is there already; pass resume=True"):
        run(store=path)
    assert_same(run(store=path, resume=True), shown)  # (nothing is left to do)
    with pytest.raises(ValueError, match="holds another run: dt differ"):
        run(store=path, resume=True, dt=0.02)
    other = swing()[0].set("upper", mass=2.0)
    with pytest.raises(ValueError, match="holds another run: system differ"):
        nc.simulate(
            other, swing()[1], dt=0.01, inputs=np.linspace(0, 2.0, 40)[:, None], store=path, resume=True
        )
    with pytest.raises(ValueError, match="pass its name as `store`"):
        run(resume=True)
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda dt: run(dt=dt, progress=True).q)(0.01)


KILLED = """
import jax, sys, threading, os, time
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1] + "/tests"]
import numpy as np
import test_segments
from natcoord_jax.stepping import segments
segments.PATIENCE = 0.0
class Slowly:
    def is_set(self):
        time.sleep(0.02)
        return False
segments._interruptions = __import__("contextlib").contextmanager(lambda: iter([Slowly()]))
test_segments.run(store=sys.argv[2])
"""


def test_a_killed_run_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    """A process is killed in the middle; another one goes on."""
    pytest.importorskip("h5py")
    path = tmp_path / "run.h5"
    root = Path(__file__).resolve().parents[1]
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(root), str(path)], cwd=tmp_path)
    try:
        while process.poll() is None:
            if path.exists() and int(nc.load(path).failed_step) >= 5:
                break
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    reached = nc.load(path)
    assert process.returncode == -signal.SIGKILL and 5 <= len(reached) - 1 < 40
    pace(monkeypatch, 1e9)
    assert_same(run(store=path, resume=True), run(progress=True))


def test_a_run_that_fails_is_stored_to_its_end(tmp_path):
    pytest.importorskip("h5py")
    path = tmp_path / "run.h5"

    def inputs(t, state):
        return jnp.where(t > 0.165, jnp.nan, 0.0)[None]

    with pytest.raises(nc.SimulationError, match="step 17.*'motor'") as caught:
        run(store=path, inputs=inputs)
    whole, stored = run(inputs=inputs, throw=False), nc.load(path)
    assert len(stored) < len(whole) == 41 and len(caught.value.trajectory) == len(stored)
    shown = run(inputs=inputs, throw=False, progress=True)
    assert_same(shown.q[: len(stored)], stored.q)
    np.testing.assert_allclose(shown.q, whole.q, rtol=LAST_DIGITS, atol=LAST_DIGITS)
    np.testing.assert_array_equal(shown.inputs, whole.inputs)


@pytest.mark.slow
def test_vtk_reads_elements_and_bodies(tmp_path):
    pytest.importorskip("h5py")
    io = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    for name, kinds in (("flying_plate", {1, 9}), ("tumbling_block", {1, 12}), ("rope", {1, 3})):
        example = gallery.load(name)
        path = tmp_path / f"{name}.h5"
        trajectory = nc.simulate(example.system, example.state, dt=example.dt, steps=2, store=path)
        reader = io.vtkHDFReader()
        reader.SetFileName(str(path))
        reader.SetStep(2)
        reader.Update()
        grid = reader.GetOutput()
        points = vtk_to_numpy(grid.GetPoints().GetData())
        cells = {grid.GetCellType(k) for k in range(grid.GetNumberOfCells())}
        assert cells == kinds and reader.GetNumberOfSteps() == 3
        np.testing.assert_array_equal(points[: len(trajectory.q[-1]) // 4], trajectory.q[-1][::4])
        groups = [g for g in example.system.effects if g.weights is not None]
        elements = sum(g.count for g in groups if g.effect.faces or np.ndim(g.weights) == 4)
        assert grid.GetNumberOfCells() == len(example.system.structure.bodies) + elements
