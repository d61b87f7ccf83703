"""Where the unknowns of a step sit in the nodes of the tree."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.maths.indices import INDICES
from natcoord_jax.model.tree import SLOTS, Tree


def unknowns_of_slots(tree: Tree, by_slot: Float[Array, "s bodies k"]) -> Float[Array, "s unknowns"]:
    """Numbers of the unknowns from those of all slots in use."""
    position = np.zeros(SLOTS, np.int32)
    position[list(tree.slots)] = np.arange(len(tree.slots))
    place = tree.slot_of // SLOTS * len(tree.slots) + position[tree.slot_of % SLOTS]
    return by_slot.reshape(by_slot.shape[0], -1)[:, place]


class NodeLayout(eqx.Module):
    """Order of the unknowns: rates and multipliers one after the other, or node by node.

    A node holds the rates of its joint, by stage and slot, and multipliers, each with its stages; what it
    does not have is zero.

    Attributes:
        tree: the spanning tree.
        slots: multipliers of each node, padded with their total number.
        places: of each multiplier, in the flattened slots.
        groups: number of instances and of multipliers of one instance, for each group.
        stages: of the collocation method.
    """

    tree: Tree
    slots: Int[np.ndarray, "bodies m"] = eqx.field(**INDICES)
    places: Int[np.ndarray, " multipliers"] = eqx.field(**INDICES)
    groups: tuple[tuple[int, int], ...] = eqx.field(static=True)
    stages: int = eqx.field(static=True)

    @property
    def rates(self) -> int:
        """Rates of a node."""
        return self.stages * len(self.tree.slots)

    def by_multiplier(self, parts: Sequence[Array]) -> Array:
        """What belongs to the multipliers of all groups (n, m, ...), in one array."""
        return jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in parts])

    def by_node(self, of_multipliers: Float[Array, "multipliers *rest"]) -> Float[Array, "bodies m *rest"]:
        """What belongs to the multipliers of each node."""
        padding = jnp.zeros((1, *of_multipliers.shape[1:]), of_multipliers.dtype)
        return jnp.concatenate([of_multipliers, padding])[self.slots]

    def nodes(self, y: Float[Array, " unknowns"]) -> Float[Array, "bodies n"]:
        """Flat vector by node."""
        s, count, bodies = self.stages, self.tree.slot_of.shape[0], self.slots.shape[0]
        padded = jnp.concatenate([y[: s * count].reshape(s, count), jnp.zeros((s, 1), y.dtype)], axis=1)
        index = self.tree.slot_index[:, np.array(self.tree.slots, int)]
        rates = jnp.moveaxis(padded[:, index], 0, 1).reshape(bodies, self.rates)
        if not self.slots.shape[1]:
            return rates
        parts, position = [], s * count
        for n, m in self.groups:
            parts.append(jnp.swapaxes(y[position : position + n * s * m].reshape(n, s, m), 1, 2))
            position += n * s * m
        multipliers = self.by_node(self.by_multiplier(parts))
        return jnp.concatenate([rates, multipliers.reshape(bodies, -1)], axis=1)

    def flat(self, nodes: Float[Array, "bodies n"]) -> Float[Array, " unknowns"]:
        """The inverse of `nodes`."""
        s, bodies = self.stages, self.slots.shape[0]
        by_slot = jnp.moveaxis(nodes[:, : self.rates].reshape(bodies, s, -1), 1, 0)
        parts = [unknowns_of_slots(self.tree, by_slot).reshape(-1)]
        if self.slots.shape[1]:
            multipliers = nodes[:, self.rates :].reshape(-1, s)[self.places]
            position = 0
            for n, m in self.groups:
                own = multipliers[position : position + n * m].reshape(n, m, s)
                parts.append(jnp.swapaxes(own, 1, 2).reshape(-1))
                position += n * m
        return jnp.concatenate(parts)


class ByNode(eqx.Module):
    """A solver on nodes of a tree, for flat vectors."""

    layout: NodeLayout
    solver: Any

    def solve(self, right: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        """Solution for a flat right-hand side."""
        return self.layout.flat(self.solver.solve(self.layout.nodes(right)))

    def transpose(self) -> "ByNode":
        """Solver of the transposed matrix."""
        return ByNode(self.layout, self.solver.transpose())
