"""Names of parts: of single ones, and of thousands that were added together."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Names(Sequence):
    """Names in order. What was added as a set has the name of the set and a number, as "mesh[17]".

    Neither this nor its hash grows with the size of the sets.

    Attributes:
        runs: names of single parts, with None, and of sets, with ranges of the numbers in them.

    Example:
        >>> from natcoord_jax.core.names import Names
        >>> names = Names((("hub", None), ("mesh", (range(1000),))))
        >>> names[18], names.index("mesh[17]"), len(names)
        ('mesh[17]', 18, 1001)
    """

    runs: tuple["Run", ...]

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.cumsum([1 if ranges is None else sum(map(len, ranges)) for _, ranges in self.runs])

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: k for k, (name, _) in enumerate(self.runs)}

    def __len__(self) -> int:
        return int(self._ends[-1]) if self.runs else 0

    def __getitem__(self, index):  # pyright: ignore[reportIncompatibleMethodOverride]
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        if not -len(self) <= index < len(self):
            raise IndexError(f"there is no name {index}; there are {len(self)}")
        index = index % len(self)
        run = int(np.searchsorted(self._ends, index, side="right"))
        name, ranges = self.runs[run]
        if ranges is None or not name:
            return name
        rest = index - (int(self._ends[run - 1]) if run else 0)
        for numbers in ranges:
            if rest < len(numbers):
                return f"{name}[{numbers[rest]}]"
            rest -= len(numbers)
        raise AssertionError("unreachable")

    def __iter__(self) -> Iterator[str]:
        for name, ranges in self.runs:
            if ranges is None:
                yield name
            else:
                yield from (f"{name}[{k}]" if name else "" for numbers in ranges for k in numbers)

    def __contains__(self, name: object) -> bool:
        return self.place(name) is not None

    def place(self, name: object) -> int | None:
        """Number of a name; None for one that is not there."""
        if not isinstance(name, str):
            return None
        run, number = self._places.get(name), 0
        if run is None or self.runs[run][1] is not None:
            owner, _, rest = name.rstrip("]").rpartition("[")
            run = self._places.get(owner)
            if run is None or not rest.isdigit() or not name.endswith("]"):
                return None
            wanted, ranges, number = int(rest), self.runs[run][1] or (), 0
            for numbers in ranges:
                if wanted in numbers:
                    number += numbers.index(wanted)
                    break
                number += len(numbers)
            else:
                return None
        return (int(self._ends[run - 1]) if run else 0) + number

    def index(self, value: str, start: int = 0, stop: int | None = None) -> int:
        """Number of a name.

        Raises:
            ValueError: for one that is not there.
        """
        found = self.place(value)
        if found is None:
            raise ValueError(f"there is no {value!r}")
        return found


def clamped(names: Sequence[str], name: Any) -> str:
    """What is to be said of a node of a set that is none of the bodies; nothing of others."""
    owner, _, rest = str(name).rpartition("[")
    runs = names.runs if isinstance(names, Names) else ()
    if name in names or not rest[:-1].isdigit() or owner not in [set_ for set_, ranges in runs if ranges]:
        return ""
    return f"; {name!r} is clamped: it moves with what it is clamped to, so ask that, or nc.Point of it"


Run = tuple[str, tuple[range, ...] | None]
"""A name, and the numbers of a set."""


def names_of(runs: Sequence[Run]) -> Sequence[str]:
    """Names, as a tuple where all are of single parts."""
    if all(ranges is None for _, ranges in runs):
        return tuple(name for name, _ in runs)
    return Names(tuple(runs))


def ranges_of(numbers: np.ndarray) -> tuple[range, ...]:
    """Increasing numbers as ranges."""
    pieces = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return tuple(range(int(piece[0]), int(piece[-1]) + 1) for piece in pieces if len(piece))


def listed(names: Sequence[str]) -> list[str]:
    """Names for a message: of a set its first and last one."""
    if not isinstance(names, Names):
        return [name for name in names if name]
    runs = [run for run in names.runs if run[0]]
    return [name if not r else f"{name}[{r[0][0]}] ... {name}[{r[-1][-1]}]" for name, r in runs]


def compact(numbers: Sequence[int]) -> Sequence[int]:
    """Numbers as a range where they follow each other, else as a tuple: what is static must not grow."""
    first, count = (int(numbers[0]) if len(numbers) else 0), len(numbers)
    if count and int(numbers[-1]) == first + count - 1 and len(set(numbers)) == count:
        found = range(first, first + count)
        if all(a == b for a, b in zip(numbers, found)):
            return found
    return tuple(int(k) for k in numbers)
