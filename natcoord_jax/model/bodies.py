"""All bodies of a scene as arrays: sets of nodes, then single ones.

A node that is clamped to a body is none: what is fixed to it is fixed to that body, which has its mass.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.bodies import TRIAD, Body, NodeKind
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import stacked
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.names import Run, names_of, ranges_of
from natcoord_jax.xla.tracing import at_top_level


class Bodies:
    """Bodies in the order of the scene, sets of nodes first.

    Attributes:
        names: of all.
        sets: number of nodes in sets.
        kinds: what each carries and how it turns.
        shapes: what to draw.
        clamps: which of the nodes are clamped to which bodies.
    """

    def __init__(self, singles: dict[str, Body], sets: dict[str, Any], clamps: Sequence[Any] = ()):
        self._singles, self._sets, self.clamps = singles, sets, clamps
        self._kept = {name: np.arange(len(nodes.position)) for name, nodes in sets.items()}
        self.owners: dict[str, Handle] = {}
        for clamp in clamps:
            name = clamp.nodes.name
            self._kept[name] = np.setdiff1d(self._kept[name], clamp.nodes.numbers)
            self.owners |= {handle.name: clamp.body for handle in clamp.nodes}
        self.sets = sum(map(len, self._kept.values()))
        kept = [(name, ranges_of(numbers)) for name, numbers in self._kept.items()]
        self.runs: list[Run] = [*kept, *((name, None) for name in singles)]
        self.names = names_of(self.runs)
        self.kinds = [sets[name].node for name, numbers in self._kept.items() for _ in numbers]
        self.kinds += [body.node for body in singles.values()]
        self.shapes = [None] * self.sets + [body.shape for body in singles.values()]

    def __len__(self) -> int:
        return len(self.kinds)

    def every(self, field: str) -> Array:
        """A field of all bodies, leading axis their number."""
        block = "mass_blocks" if field == "mass_block" else field
        parts = [picked(getattr(self._sets[name], block), numbers) for name, numbers in self._kept.items()]
        if self._singles:
            parts.append(stacked([getattr(body, field) for body in self._singles.values()]))
        return parts[0] if len(parts) == 1 else joined(*parts)

    def kind_of(self, handle: Handle) -> NodeKind:
        """What a body, or a node of a set, carries and how it turns."""
        if handle.name in self._singles:
            return self._singles[handle.name].node
        nodes = self._sets.get(handle.name.rpartition("[")[0])
        return TRIAD if nodes is None else nodes.node

    def pose(self, name: str) -> tuple[Array, Array]:
        """Place and directors of a node of a set, clamped or not."""
        owner, _, number = name.rstrip("]").rpartition("[")
        nodes = self._sets[owner]
        return nodes.position[int(number)], nodes.rotation[int(number)]

    def places(self, name: str) -> np.ndarray:
        """Numbers in the scene of all nodes of a set; -1 of those that are clamped."""
        found = np.full(len(self._sets[name].position), -1)
        kept = self._kept[name]
        before = sum(len(self._kept[other]) for other in list(self._kept)[: list(self._kept).index(name)])
        found[kept] = before + np.arange(len(kept))
        return found

    @property
    def held(self) -> tuple[tuple[str, str, int, int], ...]:
        """Names of a set and of what nodes of it are clamped to, how many these are, and of how many."""
        counts: dict[tuple[str, str], int] = {}
        for clamp in self.clamps:
            pair = clamp.nodes.name, clamp.body.name
            counts[pair] = counts.get(pair, 0) + len(clamp.nodes)
        return tuple((*pair, n, len(self._sets[pair[0]].position)) for pair, n in counts.items())

    def node_masses(self, name: str, numbers: np.ndarray) -> Array:
        """Mass blocks of some nodes of a set."""
        return picked(self._sets[name].mass_blocks, numbers)


def picked(values: Array, numbers: np.ndarray) -> Array:
    """Some entries, without a program where nothing is being traced."""
    if at_top_level(values):
        return as_array(np.asarray(values)[numbers])
    return values[numbers]


def joined(*parts: Array) -> Array:
    """`jnp.concatenate`, without a program where nothing is being traced."""
    if at_top_level(*parts):
        return as_array(np.concatenate([np.asarray(x) for x in parts]))
    return jnp.concatenate(parts)
