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

LAST_DIGITS = 1e-13
"""A run in one piece is another program, in which the compiler may round some sums otherwise, once a step."""
STEPS = 40
PACE = {"seconds": 0.0, "dies": np.inf}
"""What a step of the motor below takes in addition, so that segments are of few steps, and when it dies."""


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


def run(steps=STEPS, **options):
    system, state = swing()
    options = {"dt": 0.01, "inputs": np.linspace(0.0, 2.0, STEPS)[:steps, None]} | options
    return nc.simulate(system, state, steps=steps, **options)


def _paced(t):
    time.sleep(PACE["seconds"])
    if np.any(t > PACE["dies"]):
        raise KeyError("the motor dies")
    return np.zeros(np.shape(t))


class Motor:
    """Torques that take their time, and are no numbers from a time on: one program for all of these."""

    def __init__(self, end=np.inf):
        self.end = end

    def __call__(self, t, state):
        late = jax.pure_callback(_paced, jax.ShapeDtypeStruct((), float), t, vmap_method="broadcast_all")
        return jnp.where(t > self.end, jnp.nan, 2.0 * jnp.sin(20.0 * t) + late)[None]


def assert_same(one, other):
    """Equal to the bit."""
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


OPTIONS = {
    "plain": {},
    "error control": {"rtol": 1e-6},
    "order four": {"scheme": nc.EnergyMomentum(order=4)},
    "every fifth": {"save_every": 5},
    "event": {"until": lambda state: state.coordinates[0] - 0.1},
    "controller": {"inputs": lambda t, state: np.array([1.0]) - state.coordinates[:1]},
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "plain" else pytest.mark.exhaustive) for name in OPTIONS],
)
def test_states_of_segments_are_those_of_one_piece(name, programs):
    """Segments grow from one step on: of 1, 4, 16 and 19 steps."""
    options = OPTIONS[name]
    piece, shown = run(**options), run(progress=True, **options)
    for x, y in zip(jax.tree.leaves(shown), jax.tree.leaves(piece), strict=True):
        np.testing.assert_allclose(x, y, rtol=LAST_DIGITS, atol=LAST_DIGITS)
    codes = [[int(getattr(x, n)) for n in ("result", "failed_step")] for x in (shown, piece)]
    assert codes[0] == codes[1] and (name == "event" or codes[0] == [0, STEPS])
    if name == "plain":
        assert not np.any(np.diff(shown.t) <= 0) and not os.isatty(2)
        # Segments of other lengths, and another number of steps that there is room for, compile nothing.
        del programs[:]
        run(30, progress=True)
        assert not programs


def test_an_interruption_returns_what_was_reached_and_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    path, options = tmp_path / "run.h5", {"inputs": Motor()}
    system, _ = swing()
    straight = run(progress=True, **options)
    monkeypatch.setitem(PACE, "seconds", 0.1)
    before = signal.getsignal(signal.SIGINT)
    threading.Timer(0.7, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    begun = time.monotonic()
    reached = run(store=path, **options)
    assert time.monotonic() - begun < 0.1 * STEPS, "it was not interrupted"
    assert signal.getsignal(signal.SIGINT) is before
    assert nc.Result(int(reached.result)) is nc.Result.INTERRUPTED
    count = int(reached.failed_step)
    assert 0 < count < STEPS and len(reached) == count + 1
    assert float(reached.t[-1]) == pytest.approx(0.01 * count) and np.isfinite(reached.q).all()
    assert "interrupted" in system.explain(reached) and "resume=True" in system.explain(reached)
    monkeypatch.setitem(PACE, "seconds", 0.0)
    assert_same(run(store=path, resume=True, **options), straight)


def test_what_a_killed_run_leaves_is_no_success(tmp_path, monkeypatch):
    """Not to its end, where it says so: here a controller raises in the middle."""
    pytest.importorskip("h5py")
    path, options = tmp_path / "run.h5", {"inputs": Motor()}
    monkeypatch.setitem(PACE, "dies", 0.105)
    with pytest.raises(Exception, match="the motor dies"):
        run(store=path, **options)
    reached, (system, _) = nc.load(path), swing()
    count = len(reached) - 1
    assert nc.Result(int(reached.result)) is nc.Result.INTERRUPTED and 0 < count < 11
    assert int(reached.failed_step) == count and float(reached.failed_time) == float(reached.t[-1])
    assert "before its end" in system.explain(reached) and "resume=True" in system.explain(reached)
    monkeypatch.setitem(PACE, "dies", np.inf)
    again = run(store=path, resume=True, **options)
    assert len(again) == STEPS + 1 and nc.Result(int(nc.load(path).result)) is nc.Result.SUCCESSFUL


def test_a_run_that_fails_is_stored_to_its_end(tmp_path):
    pytest.importorskip("h5py")
    path, motor = tmp_path / "run.h5", Motor(end=0.165)
    with pytest.raises(nc.SimulationError, match="step 17.*'motor'") as caught:
        run(store=path, inputs=motor)
    stored, shown = nc.load(path), run(inputs=motor, throw=False, progress=True)
    assert len(stored) < len(shown) == STEPS + 1 and len(caught.value.trajectory) == len(stored)
    assert_same(shown.q[: len(stored)], stored.q)
    assert np.all(np.asarray(shown.q[len(stored) :]) == np.asarray(stored.q[-1]))


def test_what_is_stored_is_what_ran(tmp_path):
    pytest.importorskip("h5py")
    path = tmp_path / "run.h5"
    stored, shown = run(store=path), run(progress=True)
    assert_same(stored, shown)
    assert_same(nc.load(path), shown)
    assert isinstance(stored.q, np.memmap) and float(stored[7].t) == float(shown[7].t)
    system, _ = swing()
    np.testing.assert_array_equal(system.energy(stored[3:9]).total, system.energy(shown[3:9]).total)
    with pytest.raises(ValueError, match="is there already; pass resume=True"):
        run(store=path)
    assert_same(run(store=path, resume=True), shown)  # (nothing is left to do)
    with pytest.raises(ValueError, match="holds another run: dt differ"):
        run(store=path, resume=True, dt=0.02)
    other, inputs = system.set("upper", mass=2.0), np.linspace(0.0, 2.0, STEPS)[:, None]
    with pytest.raises(ValueError, match="holds another run: system differ"):
        nc.simulate(other, swing()[1], dt=0.01, inputs=inputs, store=path, resume=True)
    with pytest.raises(ValueError, match="pass its name as `store`"):
        run(resume=True)
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda dt: run(dt=dt, progress=True).q)(0.01)


KILLED = """
import jax, sys
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1] + "/tests"]
import test_segments as tests
tests.PACE["seconds"] = 0.1
tests.run(store=sys.argv[2], inputs=tests.Motor())
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bits(tmp_path):
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
    assert process.returncode == -signal.SIGKILL and 5 <= len(reached) - 1 < STEPS
    options = {"inputs": Motor()}
    assert_same(run(store=path, resume=True, **options), run(progress=True, **options))


@pytest.mark.exhaustive
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
