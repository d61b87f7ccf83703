"""Graph of a sparse matrix: nodes, atoms and who sees whom; on the host, once.

An atom is a set of unknowns of one node that see the same others, as the rates of a body, or the multipliers
of its joint. Nodes are eliminated as a whole, so that multipliers never meet a zero pivot on their own; what
is left to others is counted by atoms, so that a body behind a joint sees the rates of the next one without
its multipliers.
"""

from dataclasses import dataclass

import numpy as np

from natcoord_jax.linsolve.blocks import Entries


@dataclass(frozen=True)
class Graph:
    """Nodes and atoms of a matrix.

    Attributes:
        atoms: unknowns of each atom, ascending.
        node: node of each atom.
        members: atoms of each node.
        adjacent: atoms that an atom shares an entry with, in row or column, itself left out.
        neighbours: the same for nodes.
    """

    atoms: list[np.ndarray]
    node: np.ndarray
    members: list[list[int]]
    adjacent: list[set[int]]
    neighbours: list[set[int]]

    @property
    def weights(self) -> np.ndarray:
        """Unknowns of each node."""
        return np.array([sum(len(self.atoms[a]) for a in atoms) for atoms in self.members], int)

    def path(self) -> list[int] | None:
        """Nodes in an order in which each sees only the one before and the one after; None: there is none."""
        degrees = np.array([len(seen) for seen in self.neighbours])
        if np.any(degrees > 2):
            return None
        order: list[int] = []
        known: set[int] = set()
        for end in np.nonzero(degrees < 2)[0]:
            at: int | None = int(end)
            while at is not None and at not in known:
                known.add(at)
                order.append(at)
                at = next(iter(self.neighbours[at] - known), None)
        return order if len(order) == len(self.members) else None


def graph_of(entries: Entries) -> Graph:
    """Graph of the entries of a matrix."""
    n = entries.size
    rows = np.concatenate([entries.rows, entries.columns, np.arange(n)])
    columns = np.concatenate([entries.columns, entries.rows, np.arange(n)])
    pairs = np.unique(rows * n + columns)
    rows, columns = pairs // n, pairs % n
    # Unknowns that see the same others have the same sum of their random names.
    name = np.random.default_rng(0).integers(1, 2**62, n, dtype=np.uint64)
    seen = np.zeros(n, np.uint64)
    np.add.at(seen, rows, name[columns])
    _, atom = np.unique(np.stack([entries.nodes.astype(np.uint64), seen]), axis=1, return_inverse=True)
    # Atoms in the order of their first unknowns: rates before multipliers, as the matrix has them.
    _, first = np.unique(atom, return_index=True)
    atom = np.argsort(np.argsort(first))[atom]
    count = len(first)
    sorted_unknowns = np.argsort(atom, kind="stable")
    atoms = np.split(sorted_unknowns, np.cumsum(np.bincount(atom, minlength=count))[:-1])
    node = np.zeros(count, int)
    node[atom] = entries.nodes
    nodes = int(entries.nodes.max(initial=-1)) + 1
    members: list[list[int]] = [[] for _ in range(nodes)]
    for a, v in enumerate(node):
        members[v].append(a)
    return Graph(
        atoms,
        node,
        members,
        _adjacent(atom[rows], atom[columns], count),
        _adjacent(entries.nodes[rows], entries.nodes[columns], nodes),
    )


def _adjacent(a: np.ndarray, b: np.ndarray, count: int) -> list[set[int]]:
    pairs = np.unique(a.astype(np.int64) * count + b)
    sets: list[set[int]] = [set() for _ in range(count)]
    for p in pairs:
        i, j = divmod(int(p), count)
        if i != j:
            sets[i].add(j)
    return sets
