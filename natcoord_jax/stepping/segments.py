"""A long run in segments, driven from the host: it shows how far it is, stops when asked to, and is stored.

One program makes segments of any number of steps, and each goes on with all that the one before ended with,
see `taken_up`: the states do not depend on where one segment ends and the next begins.
"""

import hashlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.room import cut, room_for, with_room
from natcoord_jax.stepping.saved_states import nothing_before, segment_length, simulated
from natcoord_jax.stepping.two_kernel_loop import TakenUp
from natcoord_jax.storage import stream
from natcoord_jax.storage.vtkhdf import geometry_of
from natcoord_jax.system import System

PATIENCE = 0.25
"""Time of a segment [s]: so long it takes until an interruption is heard."""

LARGEST = 2**25
"""Bytes of the states of a segment, at most."""


class Run(NamedTuple):
    """What is simulated: the numbers, what is static (see `saved_states.rollout`), and how many steps."""

    system: System
    state: State
    inputs: Any
    dt: Array
    tolerance: Tolerance | None
    newton_tol: float
    extra_substeps: int | None
    until: Any
    scheme: Any
    steps: int
    save_every: int
    checkpoint: bool

    @property
    def length(self) -> int:
        """Steps of a segment, at most."""
        if not self.connected:
            return segment_length(self.steps, self.save_every, self.checkpoint)
        room = min(room_for(self.steps), 1024)
        while room > 4 and room * sum(np.size(x) for x in jax.tree.leaves(self.state)) * 8 > LARGEST:
            room //= 4
        return room

    @property
    def connected(self) -> bool:
        """Whether segments take up what the ones before ended with, as in a run that saves every step."""
        return self.save_every == 1 and not self.checkpoint

    @property
    def extra(self) -> int:
        """Substeps beyond one a step, of a segment."""
        if self.extra_substeps is not None:
            return self.extra_substeps
        return 16 if self.tolerance is None else max(256, 8 * self.length)

    @property
    def about(self) -> dict[str, Any]:
        """What tells runs apart, in words."""
        controlled, structure = callable(self.inputs), self.system.structure
        names, groups = (structure.bodies, structure.joints), self.system.effects
        ends = [np.asarray(x) for x in (self.system.joint_bodies, *(group.bodies for group in groups))]
        numbers = {
            "system": (self.system, *map(list, names), ends),
            "state": self.state,
            "inputs": None if controlled else self.inputs,
            "dt": self.dt,
            "rtol and atol": self.tolerance,
        }
        return {name: _digest(x) for name, x in numbers.items()} | {
            "inputs by a function": controlled,
            "until": self.until is not None,
            "newton_tol": self.newton_tol,
            "extra_substeps": self.extra_substeps,
            "scheme": self.scheme,
            "steps": self.steps,
            "save_every": self.save_every,
            "checkpoint": self.checkpoint,
        }


def _digest(x: Any) -> str:
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(x):
        found.update(np.asarray(leaf).tobytes() if isinstance(leaf, jax.Array | np.ndarray) else b"")
        found.update(leaf.encode() if isinstance(leaf, str) else b"")
    return found.hexdigest()


def in_segments(run: Run, *, progress: bool, store: Path | None, resume: bool) -> Trajectory:
    """The trajectory of a run, made in segments."""
    static = run.newton_tol, run.extra, run.until, run.scheme
    inputs = _some(run, 0, min(run.length, run.steps))
    blank = nothing_before(run.system, run.state, inputs, run.dt, run.tolerance, (run.length, *static))
    totals = np.zeros((), stream.TOTALS)
    totals["failed_part"], totals["failed_time"] = -1, float(run.state.t)
    saved = run.steps // run.save_every
    channels = len(run.system.structure.inputs)
    if store is None:
        rows = stream.in_memory(run.state, channels, saved)
    else:
        geometry, about = geometry_of(run.system), run.about
        if resume and store.exists():
            rows = stream.opened(store, geometry, about)
            totals, numbers = rows.last
            blank = _read(numbers, blank)
        else:
            numbers = len(_written(blank))
            rows = stream.created(store, run.state, channels, saved, numbers, geometry, about)
            rows.commit(totals, _written(blank))
    if totals["result"] == Result.INTERRUPTED:
        totals["result"] = Result.SUCCESSFUL
    with progress_bar(run.steps, int(totals["steps"]), progress) as show, _interruptions() as interrupted:
        totals = _go_on(run, static, blank, rows, totals, show, interrupted)
    if store is not None:
        stream.close(store, int(totals["saved"]))
        return rows.trajectory(totals, run.scheme)
    if int(totals["result"]) != Result.INTERRUPTED:
        _repeat_last(run, rows, totals, saved)
    trajectory = rows.trajectory(totals, run.scheme)
    return jax.tree.map(as_array, trajectory)


def _go_on(
    run: Run, static: tuple, taken_up: TakenUp, rows: stream.Rows, totals: np.ndarray, show: Any, stop: Any
) -> np.ndarray:
    """Segments until the end, an event, a failure or an interruption; returns where the run stands."""
    count, length = 1 if run.connected else run.length, run.length
    static = length, run.save_every, False, *static
    while totals["steps"] < run.steps and totals["result"] == Result.SUCCESSFUL:
        if stop.is_set():
            totals = totals.copy()
            totals["result"] = Result.INTERRUPTED
            totals["failed_step"], totals["failed_time"] = totals["steps"], rows.states.t[totals["saved"]]
            rows.commit(totals, _written(taken_up))
            break
        begun = time.monotonic()
        first = int(totals["steps"])
        count = min(count, run.steps - first)
        last = _at(rows.states, int(totals["saved"]), as_array)
        made = as_array(count, int) if run.connected else None
        arguments = run.system, last, _some(run, first, count), run.dt, run.tolerance, made, taken_up
        found, carried = simulated(*arguments, static)
        found = cut(found, count // run.save_every)
        # Of a run that ends here, one more state: with it are the inputs of the step that failed.
        kept = int(np.sum(np.diff(np.asarray(found.t)) > 0)) + (int(found.result) != Result.SUCCESSFUL)
        kept = min(kept, count // run.save_every)
        states = _at(found.states, slice(1, kept + 1), np.asarray)
        rows.write(int(totals["saved"]) + 1, states, np.asarray(found.inputs)[:kept])
        totals = _added(totals, found, kept)
        taken_up = TakenUp(as_array(not run.connected), carried)
        rows.commit(totals, _written(taken_up))
        show(int(totals["steps"]) - first)
        taken = max(time.monotonic() - begun, 1e-6)
        if run.connected:
            count = int(min(length, 4 * count, max(1, count * PATIENCE / taken)))
    return totals


def _at(states: State, place: int | slice, kind: Any) -> State:
    """Some of the states, as arrays of a kind."""
    return jax.tree.map(lambda x: kind(np.asarray(x)[place]), states)


def _added(totals: np.ndarray, found: Trajectory, kept: int) -> np.ndarray:
    """Where the run stands after another segment."""
    totals = totals.copy()
    totals["failed_step"] = totals["steps"] + int(found.failed_step)
    totals["steps"] += int(found.failed_step)
    totals["saved"] += kept
    totals["result"], totals["failed_part"] = int(found.result), int(found.failed_part)
    totals["failed_time"] = float(found.failed_time)
    totals["residual"] = max(float(totals["residual"]), float(found.residual))
    totals["iterations_max"] = max(int(totals["iterations_max"]), int(found.iterations_max))
    totals["iterations"] += int(found.iterations)
    totals["taken"] += int(found.steps_taken)
    totals["rejected"] += int(found.steps_rejected)
    return totals


def _some(run: Run, first: int, count: int) -> Any:
    """The inputs of some steps, with room for as many as a segment has."""
    if callable(run.inputs):
        return run.inputs
    some = np.asarray(run.inputs)[first : first + count]
    return with_room(some, count, run.length) if run.connected else as_array(some)


def _repeat_last(run: Run, rows: stream.Rows, totals: np.ndarray, saved: int) -> None:
    """After a run that ended early, the last state is repeated, as in one piece."""
    last = int(totals["saved"])
    if last < saved:
        jax.tree.map(lambda x: x.__setitem__(slice(last + 1, None), x[last]), rows.states)
        given = None if callable(run.inputs) else np.asarray(run.inputs)
        if given is not None and given.ndim == 2:
            rows.inputs[last:] = given[min(int(totals["failed_step"]), run.steps - 1)]
        else:
            rows.inputs[last:] = rows.inputs[last - 1]
        totals["saved"] = saved


def _written(taken_up: TakenUp) -> bytes:
    return b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(taken_up))


def _read(numbers: bytes, like: TakenUp) -> TakenUp:
    leaves, structure = jax.tree.flatten(like)
    found, place = [], 0
    for leaf in leaves:
        size = leaf.size * leaf.dtype.itemsize
        found.append(as_array(np.frombuffer(numbers[place : place + size], leaf.dtype).reshape(leaf.shape)))
        place += size
    return jax.tree.unflatten(structure, found)


@contextmanager
def _interruptions() -> Iterator[threading.Event]:
    """An interruption from the keyboard is noted; the second one is as always.

    Signals are heard in the main thread only; elsewhere nothing is noted.
    """
    heard = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield heard
        return
    before = signal.getsignal(signal.SIGINT)

    def note(*_: Any) -> None:
        heard.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress_bar(total: int, begun: int, progress: bool, unit: str = "step") -> Iterator[Any]:
    """A bar on the terminal, or in a notebook; nothing where nobody sees it."""
    seen = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
    if not (progress and seen):
        yield lambda steps: None
        return
    try:
        from tqdm import tqdm
    except ImportError as error:
        line = 'python -m pip install "natcoord-jax[store]"'
        raise ImportError(f"the bar is drawn by tqdm; install it with: {line}") from error
    with tqdm(total=total, initial=begun, unit=unit, unit_scale=True) as bar:
        yield bar.update
