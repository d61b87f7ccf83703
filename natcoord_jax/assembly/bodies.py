"""All bodies of a scene as arrays: sets of nodes, then single ones."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.bodies import Body
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.host import stacked
from natcoord_jax.core.names import names_of
from natcoord_jax.xla.tracing import at_top_level


class Bodies:
    """Bodies in the order of the scene, sets of nodes first.

    Attributes:
        names: of all.
        sets: number of nodes in sets.
        rotations: own axes about which each turns, see `Body`.
        shapes: what to draw.
    """

    def __init__(self, singles: dict[str, Body], sets: dict[str, Any]):
        self._singles, self._sets = list(singles.values()), list(sets.values())
        sizes = [len(nodes.position) for nodes in self._sets]
        self.sets = sum(sizes)
        self.names = names_of([*zip(sets, sizes), *((name, None) for name in singles)])
        self.runs = [*zip(sets, sizes), *((name, None) for name in singles)]
        self.rotations = [n.rotations for n, size in zip(self._sets, sizes) for _ in range(size)]
        self.rotations += [body.rotations for body in self._singles]
        self.shapes = [None] * self.sets + [body.shape for body in self._singles]

    def __len__(self) -> int:
        return len(self.rotations)

    def every(self, field: str) -> Array:
        """A field of all bodies, leading axis their number."""
        block = "mass_blocks" if field == "mass_block" else field
        parts = [getattr(nodes, block) for nodes in self._sets]
        if self._singles:
            parts.append(stacked([getattr(body, field) for body in self._singles]))
        return parts[0] if len(parts) == 1 else joined(*parts)


def joined(*parts: Array) -> Array:
    """`jnp.concatenate`, without a program where nothing is being traced."""
    if at_top_level(*parts):
        return as_array(np.concatenate([np.asarray(x) for x in parts]))
    return jnp.concatenate(parts)
