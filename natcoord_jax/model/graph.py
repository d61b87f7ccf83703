"""Spanning tree of the joints: which joint carries which body, and in which order bodies are numbered."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from natcoord_jax.core.names import compact
from natcoord_jax.model.tree import SLOTS, Level, Tree


@dataclass(frozen=True)
class Edge:
    """A joint as seen by the graph: body numbers (the number of bodies is the ground) and free motions.

    `own_axes`: rotations are about axes of the child, as those of a director.
    """

    parent: int
    child: int
    rotations: tuple[int, ...]
    translations: tuple[int, ...]
    child_rotation: bool
    free: bool
    own_axes: bool = False

    @property
    def slots(self) -> tuple[int, ...]:
        """Slots of the free motion."""
        last = (6,) if self.child_rotation else ()
        return (*self.rotations, *(3 + k for k in self.translations), *last)

    @property
    def carries(self) -> bool:
        """Whether the tree knows these motions, and the same ones with parent and child exchanged."""
        turning, sliding = set(self.rotations), set(self.translations)
        whole = sliding in (set(), {0, 1, 2})
        if self.child_rotation:
            return turning == {2} and whole
        if len(turning) == 1:
            across = {0, 1, 2} - turning
            return sliding & across in (set(), across)
        return not turning or (len(turning) == 3 and whole)


@dataclass(frozen=True)
class Spanning:
    """Outcome of the search.

    Attributes:
        order: bodies in their new numbering: parents and neighbours before those that follow them.
        carrier: joint of each body in `order`; -1 for a free body.
        reverse: joints used from child to parent.
        parent: body that the joint of each body hangs on, in the new numbering; the number of bodies is the
            ground, on which free bodies hang.
        neighbour: body that each body follows: its parent, or the one an effect couples a free body to.
    """

    order: list[int]
    carrier: list[int]
    reverse: list[bool]
    parent: list[int]
    neighbour: list[int]


def spanning_tree(
    bodies: int, edges: list[Edge], couplings: Sequence[tuple[int, int]] = (), sets: int = 0
) -> Spanning:
    """Tree from the ground along joints, then along couplings, then from bodies not yet reached.

    A joint goes into the tree only if it describes its free motion; what it is used for in reverse is
    told, so that its frames can be exchanged. A coupling, an effect between two bodies that no joint
    connects to the tree otherwise, makes neighbours of them: the second moves freely, but follows the first
    in the order of elimination, as nodes do along a beam. Free bodies that are nobody's child become roots
    first; the first of them, `sets`, which no joint carries, come before all others.
    """
    usable: list[list[tuple[int, int, bool]]] = [[] for _ in range(bodies + 1)]
    for number, edge in enumerate(edges):
        if edge.free:
            usable[edge.parent].append((number, edge.child, False))
            usable[edge.child].append((number, edge.parent, True))
    coupled: list[list[int]] = [[] for _ in range(bodies + 1)]
    for one, other in couplings:
        coupled[one].append(other)
        coupled[other].append(one)
    children = {edge.child for edge in edges if edge.free}
    roots = [b for b in range(bodies) if b not in children] + [b for b in range(bodies) if b in children]
    found: dict[int, tuple[int, bool, int, int]] = {}
    waiting: deque[int] = deque()

    def grow(front: list[int], level: int) -> None:
        waiting.extend(front)
        while front:
            following = []
            for body in front:
                for joint, other, backward in usable[body]:
                    if other not in found and other != bodies:
                        found[other] = (joint, backward, level, body)
                        following.append(other)
            front, level = following, level + 1
            waiting.extend(front)

    def along_couplings() -> None:
        while waiting:
            body = waiting.popleft()
            level = found[body][2] + 1
            for other in coupled[body]:
                if other not in found and other != bodies:
                    found[other] = (-1, False, level, body)
                    grow([other], level + 1)

    grow([bodies], 0)
    waiting.remove(bodies)
    along_couplings()
    for root in roots:
        if root not in found:
            found[root] = (-1, False, 0, bodies)
            grow([root], 1)
            along_couplings()
    order = sorted(found, key=lambda b: (b >= sets, found[b][2]))
    number = {body: i for i, body in enumerate(order)} | {bodies: bodies}
    entries = [found[b] for b in order]
    neighbour = [number[e[3]] for e in entries]
    return Spanning(
        order,
        [e[0] for e in entries],
        [e[1] for e in entries],
        [n if e[0] >= 0 else bodies for n, e in zip(neighbour, entries)],
        neighbour,
    )


def make_tree(spanning: Spanning, motions: list[Edge]) -> Tree:
    """Arrays of the tree from the free motions of the bodies in their new order."""
    bodies = len(spanning.order)
    present = np.array([[slot in m.slots for slot in range(SLOTS)] for m in motions], bool)
    slots = np.flatnonzero(present).astype(np.int32)
    slot_index = np.full((bodies, SLOTS), len(slots), np.int32)
    slot_index[present.reshape(bodies, SLOTS)] = np.arange(len(slots))
    parent = np.array(spanning.parent, np.int32)
    depth, local = np.zeros(bodies, int), np.zeros(bodies, np.int32)
    for body, above in enumerate(spanning.parent):
        depth[body] = 0 if above == bodies else depth[above] + 1
    free = np.array(spanning.carrier, int) < 0
    levels: list[Level] = []
    for number in range(depth.max() + 1 if bodies else 0):
        here = np.flatnonzero(depth == number)
        levels.append(_level(here, motions, number == 0))
        if number > 0:
            local[here] = np.searchsorted(levels[-2].members, parent[here])
    side = np.tile(np.array([0, 1], np.int32), (bodies, 1))
    order = np.tile(np.arange(4, dtype=np.int32), (bodies, 1))
    for body, (motion, backward) in enumerate(zip(motions, spanning.reverse)):
        if backward:
            side[body] = (1, 0)
            if motion.child_rotation:
                order[body] = (0, 3, 2, 1)  # the child's axis becomes the parent's
    directed = np.array([m.own_axes for m in motions], bool)
    ball = np.array([len(m.rotations) == 3 for m in motions], bool) | directed
    return Tree(
        parent,
        np.array(spanning.neighbour, np.int32),
        local,
        slot_index,
        slots,
        side,
        order,
        ball,
        tuple(levels),
        _level(np.flatnonzero(free), motions, True),
        _level(np.flatnonzero(~free), motions, len(levels) == 1),
        any(spanning.reverse),
        directed=directed if directed.any() else None,
    )


def _level(members: np.ndarray, motions: list[Edge], grounded: bool) -> Level:
    """Bodies that are handled together."""
    these = [motions[b] for b in members]
    return Level(
        compact(members.tolist()),
        tuple(sorted({k for m in these for k in m.rotations})),
        tuple(sorted({k for m in these for k in m.translations})),
        any(m.child_rotation for m in these),
        grounded,
        any(len(m.rotations) == 3 or m.own_axes for m in these),
    )
