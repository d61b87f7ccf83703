"""States of a long run in a file, written as they are made and read where they are used.

The file is HDF5 with room for all states from the start. Its arrays are contiguous and are written through
the memory map of the operating system: nothing of HDF5's own changes during the run, so that a process that
is killed leaves a sound file, and others may read meanwhile. Room that is not used takes no space on most
disks.
"""

import dataclasses
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.storage import archive, vtkhdf
from natcoord_jax.storage.described import Description

SIGNATURE = b"\x89HDF\r\n\x1a\n"
GROUP = "natcoord_jax"
"""Group of the file with all that is read again; what ParaView reads is beside it."""

TOTALS = np.dtype(
    [(name, np.int64) for name in "steps saved result failed_step failed_part taken rejected".split()]
    + [(name, np.int64) for name in ("iterations", "iterations_max")]
    + [(name, np.float64) for name in ("failed_time", "residual")]
)
"""Where a run stands: steps made, states saved, and what a trajectory says of its end."""


def hdf5() -> Any:
    """The library h5py.

    Raises:
        ImportError: with the line to install it.
    """
    try:
        import h5py
    except ImportError as error:
        line = 'python -m pip install "natcoord-jax[store]"'
        raise ImportError(f"states are stored by h5py; install it with: {line}") from error
    return h5py


@dataclasses.dataclass
class Rows:
    """States of a run, in memory or in a file.

    Attributes:
        states: with room for all that are saved.
        inputs: of the steps before each but the first.
        points: what ParaView shows at each, with its times; None: nothing.
        turns: where the run stood after the last two segments, and what it can go on from; None: in memory.
        complete: how many segments are whole, as an array of one.
    """

    states: State
    inputs: np.ndarray
    points: vtkhdf.Points | None = None
    turns: tuple[np.ndarray, np.ndarray] | None = None
    complete: np.ndarray | None = None

    def write(self, first: int, states: State, inputs: Any) -> None:
        """Put some states in their places, and the inputs before each."""
        count = len(states.t)
        jax.tree.map(lambda rows, x: rows.__setitem__(slice(first, first + count), x), self.states, states)
        self.inputs[first - 1 : first - 1 + count] = inputs
        self.show(first, states)

    def show(self, first: int, states: State) -> None:
        """What ParaView shows of some states."""
        if self.points is not None:
            self.points.write(first, np.asarray(states.t), np.asarray(states.q))

    def commit(self, totals: np.ndarray, numbers: bytes) -> None:
        """Say that a segment is whole: first the other of two places, then, in one word, which it is."""
        if self.turns is None or self.complete is None:
            return
        turn = (int(self.complete[0]) + 1) % 2
        self.turns[0][turn], self.turns[1][turn] = totals, np.frombuffer(numbers, np.uint8)
        self.complete[0] += 1

    @property
    def last(self) -> tuple[np.ndarray, bytes]:
        """Where the run stood after its last whole segment, and what it can go on from."""
        assert self.turns is not None and self.complete is not None
        turn = int(self.complete[0]) % 2
        return np.array(self.turns[0][turn]), self.turns[1][turn].tobytes()

    def trajectory(self, totals: np.ndarray, scheme: Any) -> Trajectory:
        """All that was saved."""
        saved = int(totals["saved"])
        names = "result", "failed_step", "failed_time", "failed_part", "residual"
        names += "taken", "rejected", "iterations", "iterations_max"
        values: Any = [np.array(totals[name]) for name in names]
        states = jax.tree.map(lambda rows: rows[: saved + 1], self.states)
        inputs: Any = self.inputs[:saved]
        return Trajectory(states, inputs, *values, scheme)  # pyright: ignore[reportCallIssue]


def in_memory(state: State, inputs: int, saved: int) -> Rows:
    """Room for states, the first of them in its place."""
    states = jax.tree.map(lambda x: np.zeros((saved + 1, *np.shape(x))), state)
    jax.tree.map(lambda rows, x: rows.__setitem__(0, x), states, state)
    return Rows(states, np.zeros((saved, inputs)))


def created(
    path: Path,
    state: State,
    inputs: int,
    saved: int,
    numbers: int,
    geometry: vtkhdf.Geometry,
    about: Mapping[str, Any],
) -> Rows:
    """A new file with room for states, the first of them in its place.

    Args:
        path: of the file.
        state: the first.
        inputs: number of input channels.
        saved: number of states that follow.
        numbers: bytes of what a run goes on from.
        geometry: what ParaView shows.
        about: the run: its scheme, and what it was made of, as `opened` compares it.
    """
    h5py = hdf5()
    description = Description()
    what = description.of(dict(about))
    head = {"format": archive.FORMAT, "natcoord_jax": version(GROUP), "fields": description.fields}
    part = path.with_name(path.name + ".part")
    with h5py.File(part, "w", libver="latest") as file:
        group = file.create_group(GROUP)
        group.attrs["head"] = json.dumps(head | {"what": what})
        for field in dataclasses.fields(state):
            x = getattr(state, field.name)
            if x is not None:
                room(group, f"states/{field.name}", (saved + 1, *np.shape(x)), np.float64)
        room(group, "inputs", (saved, inputs), np.float64)
        room(group, "totals", (2,), TOTALS)
        room(group, "numbers", (2, numbers), np.uint8)
        room(group, "complete", (1,), np.int64)
        vtkhdf.create(file, geometry, saved + 1, room)
    rows = _rows(part, "r+", geometry)
    jax.tree.map(lambda places, x: places.__setitem__(0, x), rows.states, state)
    rows.show(0, jax.tree.map(lambda x: np.asarray(x)[None], state))
    part.replace(path)
    return rows


def room(group: Any, name: str, shape: tuple[int, ...], dtype: Any) -> None:
    """An array of a file whose place is fixed from the start, and which is not filled with anything."""
    h5py = hdf5()
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_layout(h5py.h5d.CONTIGUOUS)
    plist.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plist.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    owner, _, last = name.rpartition("/")
    owner = group.require_group(owner) if owner else group
    kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    h5py.h5d.create(owner.id, last.encode(), kind, h5py.h5s.create_simple(shape), plist)


def mapped(path: Path, dataset: Any, mode: Any) -> np.ndarray:
    """An array of a file, read and written in its place."""
    place = dataset.id.get_offset()
    if place is None or dataset.size == 0:
        return np.zeros(dataset.shape, dataset.dtype)
    return np.memmap(path, dataset.dtype, mode, place, dataset.shape)


def _rows(path: Path, mode: str, geometry: vtkhdf.Geometry | None) -> Rows:
    with hdf5().File(path, "r") as file:
        group = file[GROUP]
        names = [field.name for field in dataclasses.fields(State)]
        states = {
            n: mapped(path, group[f"states/{n}"], mode) if n in group["states"] else None for n in names
        }
        points = None
        if geometry is not None:
            points = vtkhdf.Points(geometry, *(mapped(path, file[x], mode) for x in vtkhdf.MOVING))
        turns = tuple(mapped(path, group[name], mode) for name in ("totals", "numbers"))
        return Rows(
            State(**states),  # pyright: ignore[reportArgumentType]
            mapped(path, group["inputs"], mode),
            points,
            turns,  # pyright: ignore[reportArgumentType]
            mapped(path, group["complete"], mode),
        )


def _about(path: Path) -> dict[str, Any]:
    with hdf5().File(path, "r") as file:
        if GROUP not in file:
            raise ValueError(f"{path} is no file of nc.simulate(..., store=...): it has no group {GROUP}")
        return archive.understood(json.loads(file[GROUP].attrs["head"]), [], path)


def opened(path: Path, geometry: vtkhdf.Geometry, about: Mapping[str, Any]) -> Rows:
    """The file of a run that is to go on.

    Raises:
        ValueError: if it is of another run, saying what is different.
    """
    found = _about(path)
    different = [name for name in about if found.get(name) != about[name]]
    if different:
        raise ValueError(
            f"{path} holds another run: {', '.join(different)} differ; pass what it was begun with, or "
            "another file as `store`"
        )
    return _rows(path, "r+", geometry)


def stored(path: Path) -> Trajectory:
    """The trajectory in a file, as far as it has come; interrupted where that is not to its end."""
    about = _about(path)
    rows = _rows(path, "r", None)
    totals = rows.last[0].copy()
    if totals["result"] == Result.SUCCESSFUL and totals["steps"] < about["steps"]:
        totals["result"], totals["failed_step"] = Result.INTERRUPTED, totals["steps"]
        totals["failed_time"] = rows.states.t[totals["saved"]]
    return rows.trajectory(totals, about["scheme"])


def close(path: Path, saved: int) -> None:
    """Say in the file how many states there are to be shown."""
    with hdf5().File(path, "r+") as file:
        vtkhdf.shorten(file, saved + 1)
