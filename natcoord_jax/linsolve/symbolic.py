"""Symbolic analysis: what every front eliminates, what it leaves, and to whom; on the host, once."""

from dataclasses import dataclass

import numpy as np

from natcoord_jax.linsolve import cost
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
