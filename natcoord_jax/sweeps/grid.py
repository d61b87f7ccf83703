"""The variants of a sweep: rows of a grid, in blocks that one program works through at once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from natcoord_jax.stepping.room import room_for


@dataclass(frozen=True)
class Block:
    """Rows that are worked through at once.

    Attributes:
        first: the first of them.
        count: how many there are.
        place: of the first one in the store, where every block has room for as many.
        rooms: steps that there is room for, by name of the axis.
    """

    first: int
    count: int
    place: int
    rooms: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Grid:
    """All combinations of values of some axes, the last one changing fastest.

    Attributes:
        axes: names and values of what changes together, for every axis.
        buckets: names of those that are numbers of steps; their axis comes first.
        size: rows of a block.
    """

    axes: tuple[tuple[tuple[str, ...], tuple[np.ndarray, ...]], ...]
    buckets: tuple[str, ...]
    size: int

    @classmethod
    def of(cls, axes: Mapping[Any, Any], buckets: Sequence[str], size: int) -> "Grid":
        """A grid of axes as a user gives them.

        Raises:
            ValueError: for an axis without values, or of different lengths, or a name that is there twice.
        """
        found = []
        for key, values in axes.items():
            together = isinstance(key, tuple)
            names = key if together else (key,)
            columns = tuple(np.asarray(x) for x in (values if together else (values,)))
            lengths = {x.shape[0] if x.ndim else 0 for x in columns}
            if len(columns) != len(names) or len(lengths) != 1 or 0 in lengths:
                raise ValueError(
                    f"axes: {key!r} needs a list of values, or as many lists of one length as names"
                )
            found.append((names, columns))
        names = [name for group, _ in found for name in group]
        if not names or len(set(names)) < len(names) or not all(isinstance(n, str) for n in names):
            raise ValueError(
                f"axes are called {names}; pass names in quotes, each once, for at least one axis"
            )
        missing = [name for name in buckets if name not in names]
        if missing:
            raise ValueError(f"buckets: there is no axis {missing}; there are {names}")
        first = [axis for axis in found if set(axis[0]) & set(buckets)]
        if len(first) > 1:
            raise ValueError("buckets: numbers of steps are of one axis; pass them together, under one key")
        rest = [axis for axis in found if not set(axis[0]) & set(buckets)]
        return cls((*first, *rest), tuple(buckets), size)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(columns[0]) for _, columns in self.axes)

    @property
    def names(self) -> list[str]:
        """All that changes."""
        return [name for names, _ in self.axes for name in names]

    @property
    def rows(self) -> int:
        """Number of variants."""
        return int(np.prod(self.shape, dtype=np.int64))

    def values(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Values of some rows, by name."""
        places = np.unravel_index(rows, self.shape)
        return {
            name: column[place]
            for (names, columns), place in zip(self.axes, places, strict=True)
            for name, column in zip(names, columns, strict=True)
        }

    @cached_property
    def runs(self) -> list[Block]:
        """Rows that follow each other and have room for as many steps."""
        if not self.buckets:
            return [Block(0, self.rows, 0, ())]
        names, columns = self.axes[0]
        each = self.rows // self.shape[0]
        rooms = [
            tuple((name, room_for(int(x[k]))) for name, x in zip(names, columns) if name in self.buckets)
            for k in range(self.shape[0])
        ]
        found: list[Block] = []
        for k, room in enumerate(rooms):
            if found and found[-1].rooms == room:
                last = found.pop()
                found.append(Block(last.first, last.count + each, last.place, room))
            else:
                place = found[-1].place + self._padded(found[-1].count) if found else 0
                found.append(Block(k * each, each, place, room))
        return found

    def _padded(self, rows: int) -> int:
        return -(-rows // self.size) * self.size

    @property
    def places(self) -> int:
        """Rows that the store has room for."""
        return self.runs[-1].place + self._padded(self.runs[-1].count)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.places // self.size

    def block(self, number: int) -> Block:
        """One of the blocks."""
        place = number * self.size
        run = next(run for run in reversed(self.runs) if run.place <= place)
        done = place - run.place
        return Block(run.first + done, min(self.size, run.count - done), place, run.rooms)
