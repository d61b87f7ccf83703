"""Which contacts an impact at one of them reaches: those of the bodies that hang together."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Array, Shaped

from natcoord_jax.model.groups import Group

Islands = tuple[tuple[int, ...], ...]
"""Numbers of contacts, island by island."""


def contact_islands(groups: Sequence[Group], joints: Sequence[Group], bodies: int, coupled: bool) -> Islands:
    """Contacts whose bodies are joined, or touched by another contact of the island; never by the ground.

    Args:
        groups: effects.
        joints: of the tree and of loops.
        bodies: their number, which stands for the ground.
        coupled: whether there is mass between bodies.
    """
    contacts = [pair for group in groups if group.effect.unilateral for pair in np.asarray(group.bodies)]
    # What couples joint coordinates, and rotors, reach farther than the bodies that they are on.
    if coupled or any(not g.effect.unilateral and (g.multipliers or g.rotors.size) for g in groups):
        return (tuple(range(len(contacts))),) if contacts else ()
    joined = [pair for group in joints for pair in np.asarray(group.bodies)]
    root = list(range(bodies + 1))

    def found(body: int) -> int:
        while root[body] != body:
            root[body] = root[root[body]]
            body = root[body]
        return body

    for pair in (*joined, *contacts):
        own = [found(int(body)) for body in pair if body < bodies]
        for body in own:
            root[body] = min(own)
    parts: dict[int, list[int]] = {}
    for number, pair in enumerate(contacts):
        parts.setdefault(found(int(min(pair))), []).append(number)
    return tuple(map(tuple, parts.values()))


class IslandOrder:
    """The order in which numbers of contacts are looked at, island by island.

    Attributes:
        index: numbers of contacts (islands, most); their count where an island has fewer.
    """

    def __init__(self, islands: Islands, some: Iterable[int]) -> None:
        """Of some of the contacts, which are numbered anew."""
        number = {contact: k for k, contact in enumerate(some)}
        kept = [[number[k] for k in island if k in number] for island in islands]
        kept = [island for island in kept if island]
        self.index = np.full((len(kept), max(map(len, kept))), len(number))
        for row, island in zip(self.index, kept):
            row[: len(island)] = island
        self._place = np.argsort(self.index.reshape(-1), kind="stable")[: len(number)]

    def split(self, x: Shaped[Array, "c *m"]) -> Shaped[Array, "islands most *m"]:
        """By island, with zeros where one has fewer."""
        if len(self.index) == 1:
            return x[self.index]
        return x.at[self.index].get(mode="fill", fill_value=0)

    def joined(self, x: Shaped[Array, "islands most *m"]) -> Shaped[Array, "c *m"]:
        """In the order of the contacts."""
        return x.reshape(-1, *x.shape[2:])[self._place]
