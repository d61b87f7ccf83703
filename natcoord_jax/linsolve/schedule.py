"""From fronts to index arrays: what goes where, bucket by bucket, level by level; on the host, once."""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.linsolve import cost
from natcoord_jax.linsolve.blocks import Entries
from natcoord_jax.linsolve.graph import Graph
from natcoord_jax.linsolve.symbolic import Front, Pivots, front_unknowns
from natcoord_jax.maths.indices import INDICES


class Bucket(eqx.Module):
    """Fronts of similar size on one level; places without meaning are padded.

    Attributes:
        rows: of the pivots, n beyond the last.
        columns: of the pivots, n beyond the last.
        boundary: unknowns that are left, n beyond the last.
        base: place of the parent's front in the work of its level; 0 at the roots.
        stride: width of the parent's front.
        row_place: rows of the boundary in the parent's front. Beyond the last: zero, where zeros are added.
        column_place: the same for columns, of the first of every `run` of them.
        first: place of the first front in the work of the level.
        run: columns that stay side by side in the parent's front.
    """

    rows: Int[np.ndarray, "fronts p"] = eqx.field(**INDICES)
    columns: Int[np.ndarray, "fronts p"] = eqx.field(**INDICES)
    boundary: Int[np.ndarray, "fronts b"] = eqx.field(**INDICES)
    base: Int[np.ndarray, " fronts"] = eqx.field(**INDICES)
    stride: Int[np.ndarray, " fronts"] = eqx.field(**INDICES)
    row_place: Int[np.ndarray, "fronts b"] = eqx.field(**INDICES)
    column_place: Int[np.ndarray, "fronts runs"] = eqx.field(**INDICES)
    first: int = eqx.field(static=True)
    run: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Fronts, pivots and boundary."""
        fronts, pivots = self.columns.shape
        return fronts, pivots, self.boundary.shape[1]

    def hand_up(self, work: Float[Array, " w"], schur: Float[Array, "fronts b b"]) -> Float[Array, " w"]:
        """Add what is left of the fronts to the fronts of their parents."""
        # Within programs, not written into them: they are as many as the numbers that are added.
        across = jnp.asarray(self.base)[:, None] + self.row_place * jnp.asarray(self.stride)[:, None]
        targets = across[:, :, None] + self.column_place[:, None, :]
        if self.run == 1:
            return work.at[targets].add(schur, mode="promise_in_bounds")
        windows = jax.lax.ScatterDimensionNumbers(
            update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
        )
        targets, runs = targets.reshape(-1, 1), schur.reshape(-1, self.run)
        return jax.lax.scatter_add(work, targets, runs, windows, mode="promise_in_bounds")


class Level(eqx.Module):
    """Fronts with equally many ancestors.

    Attributes:
        buckets: of the fronts.
        source: places of matrix entries in the tiles; the place after them holds a one.
        target: their places in the work of the level.
        work: numbers in all fronts of the level.
    """

    buckets: tuple[Bucket, ...]
    source: Int[np.ndarray, " entries"] = eqx.field(**INDICES)
    target: Int[np.ndarray, " entries"] = eqx.field(**INDICES)
    work: int = eqx.field(static=True)


@dataclass
class _Place:
    """Where one front lies: its level's work from `base` on, in rows of `stride`, boundary after `pivots`."""

    base: int
    stride: int
    pivots: int


def schedule(
    graph: Graph,
    fronts: list[Front],
    pivots: list[Pivots],
    buckets: list[list[list[int]]],
    entries: Entries,
    ones: int,
) -> tuple[Level, ...]:
    """Index arrays of all levels.

    Args:
        graph: of the matrix.
        fronts: children before parents.
        pivots: of the fronts.
        buckets: members of each bucket of each level, roots first.
        entries: of the matrix.
        ones: place of a one after all tiles.

    Returns:
        The levels, roots first.
    """
    n = entries.size
    boundaries = [front_unknowns(graph, f)[1] for f in fronts]
    places, works = _places(pivots, boundaries, buckets)
    owner, row_at, column_at = (np.empty(n, np.int64) for _ in range(3))
    for k, own in enumerate(pivots):
        owner[own.columns] = k
        row_at[own.rows] = column_at[own.columns] = np.arange(len(own.columns))
    # Entry (i, j) belongs to the front that eliminates the first of the two.
    home = np.minimum(owner[entries.rows], owner[entries.columns])
    order = np.argsort(home, kind="stable")
    pieces = np.split(order, np.searchsorted(home[order], np.arange(1, len(fronts))))
    maps = _Maps(n, pivots, boundaries, places, owner, row_at, column_at)
    levels = []
    for level, own in enumerate(buckets):
        source, target = _entries_of(level, own, pieces, entries, maps, ones)
        found = tuple(_bucket(members, fronts, maps, _run(graph, fronts, members)) for members in own)
        levels.append(Level(found, source.astype(np.int32), target.astype(np.int32), works[level]))
    return tuple(levels)


def _places(
    pivots: list[Pivots], boundaries: list[np.ndarray], buckets: list[list[list[int]]]
) -> tuple[list[_Place], list[int]]:
    places: list[_Place] = [_Place(0, 0, 0)] * len(pivots)
    works = []
    for level in buckets:
        base = 0
        for members in level:
            p = cost.padded(max(len(pivots[k].columns) for k in members))
            m = p + max(len(boundaries[k]) for k in members)
            for k in members:
                places[k] = _Place(base, m, p)
                base += m * m
        works.append(base)
    return places, works


@dataclass
class _Maps:
    """Places of unknowns in fronts."""

    size: int
    pivots: list[Pivots]
    boundaries: list[np.ndarray]
    places: list[_Place]
    owner: np.ndarray
    row_at: np.ndarray
    column_at: np.ndarray

    def within(self, k: int, unknowns: np.ndarray, *, rows: bool) -> np.ndarray:
        """Places of unknowns among the rows or columns of front k."""
        at = (self.row_at if rows else self.column_at)[unknowns]
        left = self.boundaries[k]
        if not len(left):
            return at
        order = np.argsort(left)
        found = order[np.minimum(np.searchsorted(left, unknowns, sorter=order), len(left) - 1)]
        return np.where(self.owner[unknowns] == k, at, self.places[k].pivots + found)


def _entries_of(
    level: int,
    buckets: list[list[int]],
    pieces: list[np.ndarray],
    entries: Entries,
    maps: _Maps,
    ones: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Places of the matrix entries and of padding ones, and where they go in the work of a level."""
    sources, targets = [np.zeros(0, int)], [np.zeros(0, int)]
    for members in buckets:
        for k in members:
            place, own = maps.places[k], pieces[k]
            i = maps.within(k, entries.rows[own], rows=True)
            j = maps.within(k, entries.columns[own], rows=False)
            idle = np.arange(len(maps.pivots[k].columns), place.pivots)
            sources += [entries.places[own], np.full(len(idle), ones)]
            targets += [place.base + i * place.stride + j, place.base + idle * (place.stride + 1)]
    return np.concatenate(sources), np.concatenate(targets)


def _run(graph: Graph, fronts: list[Front], members: list[int]) -> int:
    """Columns that stay side by side: what divides the sizes of all atoms in the boundaries."""
    return math.gcd(*(len(graph.atoms[a]) for k in members for a in fronts[k].boundary)) or 1


def _bucket(members: list[int], fronts: list[Front], maps: _Maps, run: int) -> Bucket:
    first = maps.places[members[0]]
    p, b, n = first.pivots, first.stride - first.pivots, maps.size
    table = {name: np.full((len(members), p), n) for name in ("rows", "columns")}
    table["boundary"] = np.full((len(members), b), n)
    zero = {name: np.zeros((len(members), b), int) for name in ("row_place", "column_place")}
    base, stride = np.zeros((2, len(members)), int)
    for i, k in enumerate(members):
        own, left, parent = maps.pivots[k], maps.boundaries[k], fronts[k].parent
        table["rows"][i, : len(own.rows)] = own.rows
        table["columns"][i, : len(own.columns)] = own.columns
        table["boundary"][i, : len(left)] = left
        if parent >= 0:
            base[i], stride[i] = maps.places[parent].base, maps.places[parent].stride
            zero["row_place"][i, : len(left)] = maps.within(parent, left, rows=True)
            zero["column_place"][i, : len(left)] = maps.within(parent, left, rows=False)
    zero["column_place"] = zero["column_place"][:, ::run]
    numbers = table | zero | {"base": base, "stride": stride}
    tables = {name: x.astype(np.int32) for name, x in numbers.items()}
    return Bucket(first=first.base, run=run, **tables)
