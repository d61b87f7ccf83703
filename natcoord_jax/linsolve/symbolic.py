"""Symbolic analysis: what every front eliminates, what it leaves, and to whom; on the host, once.

And a rehearsal of the elimination with given numbers: the order of pivots in every front.

Pivots are taken in their natural order, balances before constraints, wherever that is accurate: it stays so
when bodies turn. Where it is not, rows are exchanged within the front; where that does not help either, the
front is merged into its parent, whose other pivots will. The numbers may be those of several matrices, as
with contacts closed and open: an order is accurate if it is so for each of them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from natcoord_jax.linsolve import cost
from natcoord_jax.linsolve.blocks import Entries
from natcoord_jax.linsolve.graph import Graph
from natcoord_jax.linsolve.ordering import Groups

MOST_LEVELS = 64


@dataclass
class Front:
    """A set of unknowns that is eliminated at once.

    Attributes:
        pivots: atoms eliminated here, in this order.
        boundary: atoms that see them and are eliminated later.
        parent: the front that eliminates the first of the boundary; -1: none, a root.
    """

    pivots: list[int]
    boundary: set[int]
    parent: int


def fronts_of(graph: Graph, groups: Groups) -> list[Front]:
    """Fronts of an order of elimination, children before parents."""
    group_of = np.empty(len(graph.atoms), int)
    for k, group in enumerate(groups):
        for node in group:
            group_of[graph.members[node]] = k
    found: list[Front] = []
    children: list[list[int]] = [[] for _ in groups]
    for k, group in enumerate(groups):
        pivots = [a for node in group for a in graph.members[node]]
        boundary: set[int] = set().union(*(graph.adjacent[a] for a in pivots))
        boundary = {a for a in boundary if group_of[a] > k}
        for child in children[k]:
            boundary |= {a for a in found[child].boundary if group_of[a] > k}
        parent = min((int(group_of[a]) for a in boundary), default=-1)
        if parent >= 0:
            children[parent].append(k)
        found.append(Front(pivots, boundary, parent))
    return found


class Sizes:
    """Numbers of unknowns of fronts."""

    def __init__(self, graph: Graph):
        self.atom = [len(unknowns) for unknowns in graph.atoms]

    def of(self, front: Front) -> tuple[int, int]:
        """Pivots and boundary."""
        return sum(self.atom[a] for a in front.pivots), sum(self.atom[a] for a in front.boundary)


def amalgamated(fronts: list[Front], sizes: Sizes) -> list[Front]:
    """Fronts merged into their parents wherever one large elimination is cheaper than two."""
    shape = [sizes.of(f) for f in fronts]
    into = list(range(len(fronts)))
    for k, f in enumerate(fronts):
        if f.parent < 0:
            continue
        (p, b), (q, c) = shape[k], shape[f.parent]
        if cost.front(p + q, c) <= cost.front(p, b) + cost.front(q, c):
            into[k] = f.parent
            shape[f.parent] = p + q, c
    return merged(fronts, into)


def merged(fronts: list[Front], into: list[int]) -> list[Front]:
    """Fronts merged into the given ones, their parents or further ancestors, or into themselves."""
    last = list(into)
    for k in reversed(range(len(fronts))):
        last[k] = last[last[k]] if last[k] != k else k
    pivots: dict[int, list[int]] = {}
    for k, f in enumerate(fronts):
        pivots.setdefault(last[k], []).extend(f.pivots)
    kept = [k for k in range(len(fronts)) if last[k] == k]
    number = {k: i for i, k in enumerate(kept)}
    return [
        Front(
            pivots[k],
            fronts[k].boundary,
            number[last[fronts[k].parent]] if fronts[k].parent >= 0 else -1,
        )
        for k in kept
    ]


def depths(fronts: list[Front]) -> np.ndarray:
    """Number of ancestors of each front."""
    depth = np.zeros(len(fronts), int)
    for k in reversed(range(len(fronts))):
        if fronts[k].parent >= 0:
            depth[k] = depth[fronts[k].parent] + 1
    assert depth.max(initial=0) < MOST_LEVELS, (
        f"the order of elimination has {depth.max() + 1} levels, at most {MOST_LEVELS} are compiled in time; "
        "choose an order with more independent nodes in a round"
    )
    return depth


def top_merged(fronts: list[Front], levels: int) -> list[Front]:
    """The first levels of every tree of fronts merged into its root."""
    depth = depths(fronts)
    into = [f.parent if 0 < d < levels else k for k, (f, d) in enumerate(zip(fronts, depth))]
    return merged(fronts, into)


def estimate(fronts: list[Front], sizes: Sizes) -> tuple[float, list[list[list[int]]]]:
    """Time of elimination [us], and the buckets of each level, from the roots to the deepest."""
    depth = depths(fronts)
    shape = [sizes.of(f) for f in fronts]
    # Where the work is much, a bucket more costs little time, but still its time of compiling.
    overhead = max(cost.BUCKET, 0.05 * sum(float(cost.front(*s)) for s in shape))
    total, levels = 0.0, []
    for level in range(int(depth.max(initial=0)) + 1):
        own = np.nonzero(depth == level)[0]
        cuts = cost.cut([shape[k][0] for k in own], [shape[k][1] for k in own], overhead)
        levels.append([[int(own[i]) for i in bucket] for bucket in cuts])
        for bucket in levels[-1]:
            p = max(cost.padded(shape[k][0]) for k in bucket)
            b = max(shape[k][1] for k in bucket)
            total += overhead + len(bucket) * float(cost.front(p, b))
    return total, levels


NATURAL = 1e-9  # error of an inverse that leaves the natural order in place
BAD = 1e-6  # error of an inverse that no exchange of rows brings down: the front is merged


class Pivots(NamedTuple):
    """Unknowns that a front eliminates, and the rows that it does so with, in the same order."""

    columns: np.ndarray
    rows: np.ndarray


def natural(graph: Graph, fronts: list[Front]) -> list[Pivots]:
    """Pivots on the diagonal of the matrix."""
    return [Pivots(*[front_unknowns(graph, f)[0]] * 2) for f in fronts]


def analyse_pivots(
    graph: Graph, fronts: list[Front], entries: Entries, values: np.ndarray
) -> tuple[list[Front], list[Pivots]]:
    """Eliminate front by front.

    Args:
        graph: of the matrix.
        fronts: children before parents.
        entries: of the matrix.
        values: of the entries, for each matrix that the order is to serve (matrices, entries).

    Returns:
        The fronts, bad ones merged, and the pivots of each.
    """
    unknowns = [front_unknowns(graph, f) for f in fronts]
    owner = np.empty(entries.size, int)
    for k, (pivots, _) in enumerate(unknowns):
        owner[pivots] = k
    home = np.minimum(owner[entries.rows], owner[entries.columns])
    order = np.argsort(home, kind="stable")
    pieces = np.split(order, np.searchsorted(home[order], np.arange(1, len(fronts))))
    handed: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in fronts]
    into, order_of = list(range(len(fronts))), []
    extra: list[list[np.ndarray]] = [[] for _ in fronts]
    for k, f in enumerate(fronts):
        pivots = np.concatenate([*extra[k], unknowns[k][0]]).astype(int)
        whole = np.concatenate([pivots, unknowns[k][1]])
        matrix = np.zeros((len(values), len(whole), len(whole)))
        place = dict(zip(whole.tolist(), range(len(whole))))
        own = pieces[k]
        i = [place[r] for r in entries.rows[own].tolist()]
        j = [place[c] for c in entries.columns[own].tolist()]
        for each, numbers in zip(matrix, values[:, own]):
            np.add.at(each, (i, j), numbers)
        for which, part in handed[k]:
            at = [place[u] for u in which.tolist()]
            matrix[:, *np.ix_(at, at)] += part
        p = len(pivots)
        rows, inverse = pivot_order(matrix[:, :p, :p])
        order_of.append(Pivots(pivots, pivots[rows]))
        if f.parent >= 0 and inverse is None:
            into[k] = f.parent
            extra[f.parent].append(pivots)
            handed[f.parent].append((whole, matrix))
        elif f.parent >= 0 and inverse is not None:
            schur = matrix[:, p:, p:] - matrix[:, p:, :p] @ (inverse @ matrix[:, :p, p:])
            handed[f.parent].append((whole[p:], schur))
    kept = [k for k in range(len(fronts)) if into[k] == k]
    return merged(fronts, into), [order_of[k] for k in kept]


def front_unknowns(graph: Graph, front: Front) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns that a front eliminates, and those it leaves."""
    none = [np.zeros(0, int)]
    pivots = np.concatenate([*none, *(graph.atoms[a] for a in front.pivots)])
    return pivots, np.concatenate([*none, *(graph.atoms[a] for a in sorted(front.boundary))])


def pivot_order(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Order of the rows in which pivots on the diagonal invert each of some blocks, and the inverses.

    None for the inverses where no order is found that does.
    """
    natural = np.arange(blocks.shape[-1])
    inverses = _inverses(blocks, natural, NATURAL)
    if inverses is not None:
        return natural, inverses
    for block in blocks:
        size = np.abs(block).max(axis=1, initial=0.0)
        rows = _exchanged(block / np.where(size > 0, size, 1.0)[:, None])
        inverses = _inverses(blocks, rows, BAD)
        if inverses is not None:
            return rows, inverses
    return natural, None


def _inverses(blocks: np.ndarray, rows: np.ndarray, accepted: float) -> np.ndarray | None:
    """Inverses with pivots on the diagonal of these rows; None if one is not accurate."""
    found = []
    for block in blocks:
        size = np.abs(block).max(axis=1, initial=0.0)
        scale = 1.0 / np.where(size > 0, size, 1.0)
        inverse = _inverse(block[rows])
        error = np.abs((block[rows] @ inverse - np.eye(len(block))) * scale[rows][:, None] / scale[rows])
        if not (np.all(np.isfinite(inverse)) and error.max(initial=0.0) <= accepted):
            return None
        found.append(np.empty_like(inverse))
        found[-1][:, rows] = inverse
    return np.stack(found)


def _inverse(block: np.ndarray) -> np.ndarray:
    """Gauss-Jordan inverse with the pivots on the diagonal, as it is done at run time."""
    found = block.copy()
    with np.errstate(all="ignore"):
        for k in range(len(found)):
            pivot = 1.0 / found[k, k]
            row, column = found[k] * pivot, found[:, k].copy()
            row[k], column[k] = pivot, 0.0
            found[:, k] = 0.0
            found[k] = 0.0
            found -= np.outer(column, row)
            found[k] = row
    return found


def _exchanged(block: np.ndarray) -> np.ndarray:
    """Order of the rows by elimination with partial pivoting, the diagonal preferred."""
    left, order = block.copy(), np.arange(len(block))
    with np.errstate(all="ignore"):
        for k in range(len(left)):
            column = np.abs(left[k:, k])
            best = k if column[0] >= 0.1 * column.max() else k + int(np.argmax(column))
            left[[k, best]], order[[k, best]] = left[[best, k]], order[[best, k]]
            left[k + 1 :] -= np.outer(left[k + 1 :, k] / left[k, k], left[k])
    return order
