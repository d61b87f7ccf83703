"""The store of a sweep: a group of Zarr arrays, with a row for every variant."""

import json
import math
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from natcoord_jax.core.results import REASONS, Result
from natcoord_jax.sweeps.grid import Block, Grid

FORMAT = 1
WAIT = 60.0
"""Time [s] that another process waits for the one that makes the store."""


def zarr() -> Any:
    """The library Zarr.

    Raises:
        ImportError: with the line to install it.
    """
    try:
        import zarr
    except ImportError as error:
        line = 'python -m pip install "natcoord-jax[store]"'
        raise ImportError(f"sweeps are stored by zarr; install it with: {line}") from error
    return zarr


class Sweep:
    """What a sweep has found so far; read from its store where it is used.

    `sweep["height"]` is an array with one axis for every axis of the sweep, and those of the value after
    them. Rows that are not done are NaN, or 0 for whole numbers; `done` tells which.

    Attributes:
        grid: the variants.
        names: of the values.

    Args:
        store: folder of the sweep, or the group of Zarr itself.

    Raises:
        ValueError: for a folder without a sweep of this format.
        ImportError: without `zarr`.

    Example:
        >>> import jax, jax.numpy as jnp; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> found = nc.sweep(lambda mass, speed: {"energy": 0.5 * mass * speed**2},
        ...                  {"mass": [1.0, 2.0], "speed": [1.0, 2.0, 3.0]})
        >>> found.names, found["energy"].tolist()
        (['energy'], [[0.5, 2.0, 4.5], [1.0, 4.0, 9.0]])
        >>> found.row(5)["mass"], found.complete
        (2.0, True)
    """

    def __init__(self, store: Any):
        path = isinstance(store, str | os.PathLike)
        try:
            self.group = zarr().open_group(str(store), mode="r+") if path else store
        except FileNotFoundError as error:
            raise ValueError(f"there is no sweep in {store}") from error
        about = self.group.attrs.asdict()
        if about.get("format") != FORMAT:
            raise ValueError(f"{store} has no sweep of format {FORMAT}: it says {about.get('format')}")
        axes = tuple(
            (tuple(names), tuple(self.group[f"axes/{name}"][...] for name in names))
            for names in about["axes"]
        )
        self.grid = Grid(axes, tuple(about["buckets"]), int(about["block"]))
        self.names: list[str] = list(about["names"])
        self.about = about

    def __repr__(self) -> str:
        done, rows = int(self.done.sum()), math.prod(self.shape)
        return f"<sweep: {done} of {rows} rows done, axes of {self.shape}; {', '.join(self.names)}>"

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis; that of the numbers of steps comes first."""
        return self.grid.shape

    @property
    def done_blocks(self) -> np.ndarray:
        """Which blocks are done."""
        return np.asarray(self.group["done"][...]) > 0

    @property
    def complete(self) -> bool:
        """Whether all rows are done."""
        return bool(self.done_blocks.all())

    @property
    def done(self) -> np.ndarray:
        """Which rows are done, in the shape of the grid."""
        return self._in_rows(np.repeat(self.done_blocks, self.grid.size))

    def __getitem__(self, name: str) -> np.ndarray:
        """A value of all rows, in the shape of the grid.

        Raises:
            KeyError: for a name that is none of a value.
        """
        if name not in self.names:
            raise KeyError(f"the sweep has no value {name!r}; it has {self.names}")
        return self._in_rows(self.group[f"values/{name}"][...])

    def _in_rows(self, places: np.ndarray) -> np.ndarray:
        rows = np.concatenate([places[run.place : run.place + run.count] for run in self.grid.runs])
        return rows.reshape(*self.shape, *rows.shape[1:])

    def row(self, number: int) -> dict[str, Any]:
        """Values of the axes in a row, counted as `sweep[name].reshape(-1)` is."""
        return {name: x[0].tolist() for name, x in self.grid.values(np.array([number])).items()}

    def explain(self) -> str:
        """How many rows are done, and how many ended how, by the codes that are called "result"."""
        done, total = int(self.done.sum()), self.grid.rows
        lines = [f"{done} of {total} rows are done"]
        if "result" in self.names:
            codes = Counter(self["result"][self.done].reshape(-1).tolist())
            lines += [f"{count}: {REASONS[Result(code)]}" for code, count in codes.most_common()]
        return "\n".join(lines)

    def write(self, number: int, block: Block, values: Any) -> None:
        """Put what a block has found in its place, and then say that it is done."""
        place = slice(block.place, block.place + block.count)
        for name, x in named(values).items():
            self.group[f"values/{name}"][place] = np.asarray(x)[: block.count]
        self.group["done"][number] = 1


def named(values: Any) -> dict[str, Any]:
    """Leaves of a result by name."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(values)
    return {jax.tree_util.keystr(path, simple=True, separator=".") or "value": x for path, x in leaves}


def create(store: Any, grid: Grid, shapes: Any, function: str) -> Sweep:
    """A new store for values of these shapes (of one row)."""
    group = zarr().open_group(store, mode="w", zarr_format=3)
    for names, columns in grid.axes:
        for name, column in zip(names, columns):
            group.create_array(f"axes/{name}", data=column)
    for name, x in named(shapes).items():
        fill = np.nan if np.issubdtype(x.dtype, np.inexact) else 0
        group.create_array(
            f"values/{name}",
            shape=(grid.places, *x.shape),
            chunks=(grid.size, *(max(n, 1) for n in x.shape)),
            dtype=x.dtype,
            fill_value=fill,
        )
    group.create_array("done", shape=(grid.blocks,), chunks=(1,), dtype="uint8", fill_value=0)
    about = {"axes": [list(names) for names, _ in grid.axes], "buckets": list(grid.buckets)}
    about |= {"block": grid.size, "names": list(named(shapes)), "function": function}
    # The format last: who waits for the store to be made looks at it.
    group.attrs.update(about | {"format": FORMAT})
    return Sweep(group)


def made_elsewhere(path: Path) -> Sweep:
    """The store that another process makes.

    Raises:
        TimeoutError: if it does not.
    """
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        try:
            head = json.loads((path / "zarr.json").read_text("utf-8"))
            if head.get("attributes", {}).get("format") == FORMAT:
                return Sweep(path)
        except (OSError, json.JSONDecodeError):
            pass
        time.sleep(0.1)
    raise TimeoutError(f"no process has made the store {path} in {WAIT:.0f} s")


def check_same(found: Sweep, grid: Grid, function: str, path: Any) -> None:
    """Look whether a store is of this sweep.

    Raises:
        ValueError: saying what is different.
    """
    different: Sequence[str] = [
        name
        for name, one, other in (
            ("the names of the axes", found.grid.names, grid.names),
            ("block", found.grid.size, grid.size),
            ("buckets", found.grid.buckets, grid.buckets),
            ("function", found.about["function"], function),
        )
        if one != other
    ] or [
        f"the values of {name!r}"
        for (names, ours), (_, theirs) in zip(found.grid.axes, grid.axes)
        for name, x, y in zip(names, ours, theirs)
        if not np.array_equal(x, y)
    ]
    if different:
        raise ValueError(f"{path} holds another sweep: {', '.join(different)} differ; pass another store")
