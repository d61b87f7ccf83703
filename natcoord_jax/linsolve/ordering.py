"""Orders of elimination: groups of nodes, each eliminated as one.

Chains, trees and frames are eliminated in rounds of independent nodes with few neighbours: every other node
of a chain (cyclic reduction), the leaves and the thin branches of a tree (rake and compress). Meshes are
dissected: a small set of nodes separates two halves, each of which is dissected in turn.
"""

from collections.abc import Callable

import numpy as np

Groups = list[list[int]]


def rounds(neighbours: list[set[int]]) -> Groups:
    """Rounds of independent nodes of low degree; a group is a single node."""
    seen = [set(s) for s in neighbours]
    left = set(range(len(seen)))
    order: list[int] = []
    while left:
        degree = {v: len(seen[v]) for v in left}
        limit = max(2, int(1.5 * min(degree.values())))
        blocked: set[int] = set()
        chosen = []
        for v in sorted((v for v in left if degree[v] <= limit), key=lambda v: (degree[v], v)):
            if v not in blocked:
                chosen.append(v)
                blocked |= seen[v]
        for v in chosen:
            for a in seen[v]:
                seen[a] |= seen[v]
                seen[a] -= {a, v}
        left.difference_update(chosen)
        order += chosen
    return [[v] for v in order]


def dissection(
    neighbours: list[set[int]], weights: np.ndarray, leaf: int, coordinates: np.ndarray | None = None
) -> Groups:
    """Nested dissection down to pieces of at most `leaf` unknowns.

    Args:
        neighbours: of each node.
        weights: unknowns of each node.
        leaf: unknowns of a piece that is not cut further.
        coordinates: positions of the nodes; the cut goes across the longest extent. Default: across the
            longest path in the graph.

    Returns:
        Groups in order of elimination: pieces and separators, children before their parents.
    """
    groups: Groups = []
    # The groups are found from the last to the first: separators come after what they separate.
    stack = [sorted(piece) for piece in _components(neighbours, set(range(len(neighbours))))]
    while stack:
        piece = stack.pop()
        if not piece:
            continue
        if weights[piece].sum() <= leaf or len(piece) < 3:
            groups.append(piece)
            continue
        left, right, separator = _cut(neighbours, weights, piece, coordinates)
        if not left or not right:
            groups.append(piece)
            continue
        if separator:
            groups.append(separator)
        stack += [left, right]
    return groups[::-1]


def _cut(
    neighbours: list[set[int]], weights: np.ndarray, piece: list[int], coordinates: np.ndarray | None
) -> tuple[list[int], list[int], list[int]]:
    """Two halves that do not see each other, and what separates them."""
    keys: list[Callable[[], np.ndarray]] = [lambda: _distances(neighbours, piece)]
    if coordinates is not None:
        own = coordinates[piece]
        axis = int(np.argmax(np.ptp(own, axis=0)))
        keys.insert(0, lambda: own[:, axis])
    for key in keys:
        place = key()
        low = place < _median(place, weights[piece])
        if not np.any(low):
            continue
        left, right = ([v for v, on in zip(piece, low == side) if on] for side in (True, False))
        near_left = [v for v in left if neighbours[v] & set(right)]
        near_right = [v for v in right if neighbours[v] & set(left)]
        if weights[near_left].sum() < weights[near_right].sum():
            return [v for v in left if v not in set(near_left)], right, near_left
        return left, [v for v in right if v not in set(near_right)], near_right
    return piece, [], []


def _median(place: np.ndarray, weights: np.ndarray) -> float:
    """A place that halves the weights, not the lowest one if there is another."""
    values, inverse = np.unique(place, return_inverse=True)
    below = np.cumsum(np.bincount(inverse, weights))
    at = int(np.searchsorted(below, below[-1] / 2))
    return float(values[min(max(at, 1), len(values) - 1)])


def _distances(neighbours: list[set[int]], piece: list[int]) -> np.ndarray:
    """Distance of each node from an end of the piece, in edges; unreachable ones last."""
    inside = set(piece)
    start = piece[0]
    found: dict[int, int] = {}
    for _ in range(3):
        found = {start: 0}
        front = [start]
        while front:
            following = []
            for v in front:
                for w in neighbours[v]:
                    if w in inside and w not in found:
                        found[w] = found[v] + 1
                        following.append(w)
            front = following
        start = max(found, key=lambda v: found[v])
    return np.array([found.get(v, len(piece)) for v in piece], float)


def _components(neighbours: list[set[int]], nodes: set[int]) -> Groups:
    parts: Groups = []
    left = set(nodes)
    while left:
        front = {min(left)}
        part: set[int] = set()
        while front:
            part |= front
            front = set().union(*(neighbours[v] for v in front)) - part
        left -= part
        parts.append(sorted(part))
    return parts
