"""A rehearsal of the elimination with given numbers: the order of pivots in every front; on the host, once.

Pivots are taken in their natural order, balances before constraints, wherever that is accurate: it stays so
when bodies turn. Where it is not, rows are exchanged within the front; where that does not help either, the
front is merged into its parent, whose other pivots will.
"""

from typing import NamedTuple

import numpy as np

from natcoord_jax.linsolve.blocks import Entries
from natcoord_jax.linsolve.graph import Graph
from natcoord_jax.linsolve.symbolic import Front, merged

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
        values: of the entries.

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
        matrix = np.zeros((len(whole),) * 2)
        place = dict(zip(whole.tolist(), range(len(whole))))
        own = pieces[k]
        i = [place[r] for r in entries.rows[own].tolist()]
        j = [place[c] for c in entries.columns[own].tolist()]
        np.add.at(matrix, (i, j), values[own])
        for which, part in handed[k]:
            at = [place[u] for u in which.tolist()]
            matrix[np.ix_(at, at)] += part
        p = len(pivots)
        rows, inverse = pivot_order(matrix[:p, :p])
        order_of.append(Pivots(pivots, pivots[rows]))
        if f.parent >= 0 and inverse is None:
            into[k] = f.parent
            extra[f.parent].append(pivots)
            handed[f.parent].append((whole, matrix))
        elif f.parent >= 0 and inverse is not None:
            schur = matrix[p:, p:] - matrix[p:, :p] @ (inverse @ matrix[:p, p:])
            handed[f.parent].append((whole[p:], schur))
    kept = [k for k in range(len(fronts)) if into[k] == k]
    return merged(fronts, into), [order_of[k] for k in kept]


def front_unknowns(graph: Graph, front: Front) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns that a front eliminates, and those it leaves."""
    none = [np.zeros(0, int)]
    pivots = np.concatenate([*none, *(graph.atoms[a] for a in front.pivots)])
    return pivots, np.concatenate([*none, *(graph.atoms[a] for a in sorted(front.boundary))])


def pivot_order(block: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Order of the rows in which pivots on the diagonal invert a block, and the inverse; None: none does."""
    natural = np.arange(len(block))
    size = np.abs(block).max(axis=1, initial=0.0)
    scale = 1.0 / np.where(size > 0, size, 1.0)
    for rows, accepted in ((natural, NATURAL), (_exchanged(block * scale[:, None]), BAD)):
        inverse = _inverse(block[rows])
        error = np.abs((block[rows] @ inverse - np.eye(len(block))) * scale[rows][:, None] / scale[rows])
        if np.all(np.isfinite(inverse)) and error.max(initial=0.0) <= accepted:
            back = np.empty_like(inverse)
            back[:, rows] = inverse
            return rows, back
    return natural, None


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
