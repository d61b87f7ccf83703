"""Equations of a step on an open tree: those of `FullStep`, with the Jacobian kept as blocks along the tree.

A node is a body together with the multipliers of its own joint (and of drives and couplings on it); nodes
of multipliers alone would have a zero pivot. Every effect couples a body with its parent at most.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.full import FullStep
from natcoord_jax.assembly.local import jacobians
from natcoord_jax.assembly.system import Elimination, Group


class RecursiveStep(FullStep):
    """One step on an open tree of bodies."""

    @property
    def elimination(self) -> Elimination:
        """Order of elimination; a system that is solved recursively has one."""
        assert self.system.elimination is not None
        return self.system.elimination

    def jacobian(self, y: Float[Array, " unknowns"]) -> tuple[Array, Array, Array]:
        """Blocks of the exact Jacobian: diagonal, up, down (see `linsolve.tree.TreeBlocks`)."""
        twists, multipliers = self.split(y)
        own = self.body_jacobians(twists)
        up, down = jnp.zeros_like(own), jnp.zeros_like(own)
        every = self._with_ground(twists)
        # Of each multiplier: its forces on the node and on the parent, and the rates of its constraint.
        borders = []
        for group, where, lam, seats in zip(
            self.groups, self.situations, multipliers, self.elimination.seats
        ):
            (by_twist, by_lam), (g_by_twist, _) = jacobians(
                group, where, self.tableau, self.start[group.bodies], every[group.bodies], lam
            )
            at_node, at_parent = self._places(group)
            blocks = self._by_place(by_twist, at_node, at_parent)
            own = own - seats.nodes.collect(blocks[0]) - seats.parents.collect(blocks[3])
            up, down = up - seats.nodes.collect(blocks[1]), down - seats.nodes.collect(blocks[2])
            if group.multipliers:
                borders.append(self._borders(by_lam, g_by_twist, at_node, at_parent))
        return self._bordered(own, up, down, borders)

    def _places(self, group: Group) -> tuple[Array, Array]:
        """Which bodies of each instance are its node, the deeper one, and which the node's parent."""
        touched = jnp.asarray(group.bodies)
        real = touched < self.bodies
        # Bodies are numbered from the root.
        node = jnp.max(jnp.where(real, touched, -1), axis=1, keepdims=True)
        at_node = real & (touched == node)
        return at_node, real & ~at_node

    def _by_place(self, by_twist: Array, at_node: Array, at_parent: Array) -> list[Array]:
        """Blocks (node, node), (node, parent), (parent, node), (parent, parent) of each instance."""
        count, k = at_node.shape
        width = 6 * self.tableau.stages
        local = by_twist.reshape(count, k, width, k, width)
        places = (at_node, at_node), (at_node, at_parent), (at_parent, at_node), (at_parent, at_parent)
        return [
            jnp.sum(jnp.where((a[:, :, None] & b[:, None, :])[:, :, None, :, None], local, 0.0), axis=(1, 3))
            for a, b in places
        ]

    def _borders(self, by_lam: Array, g_by_twist: Array, at_node: Array, at_parent: Array) -> Array:
        """Columns on node and parent and rows on node and parent of the multipliers (n m, 4, width)."""
        count, k = at_node.shape
        width = 6 * self.tableau.stages
        columns = jnp.swapaxes(-by_lam.reshape(count, k, width, -1), 2, 3)
        rows = jnp.swapaxes(g_by_twist.reshape(count, -1, k, width), 1, 2)
        parts = [
            jnp.sum(jnp.where(at[:, :, None, None], x, 0.0), axis=1)
            for x, at in ((columns, at_node), (columns, at_parent), (rows, at_node), (rows, at_parent))
        ]
        return jnp.stack(parts, axis=2).reshape(-1, 4, width)

    def _bordered(
        self, own: Array, up: Array, down: Array, borders: list[Array]
    ) -> tuple[Array, Array, Array]:
        """Blocks with the multipliers of each node; a slot without one keeps its unknown at zero."""
        slots, width = self.elimination.slots, own.shape[-1]
        empty = jnp.zeros((1, 4, width), own.dtype)
        columns, lifted, rows, hung = jnp.moveaxis(jnp.concatenate([*borders, empty])[slots], 2, 0)
        unused = slots == self.unknowns - self.balances
        corner = unused[:, :, None] * jnp.eye(slots.shape[1])
        upper = jnp.concatenate([own, jnp.swapaxes(columns, 1, 2)], axis=2)
        lower = jnp.concatenate([rows, corner], axis=2)
        return (
            jnp.concatenate([upper, lower], axis=1),
            jnp.concatenate([up, hung], axis=1),
            jnp.concatenate([down, jnp.swapaxes(lifted, 1, 2)], axis=2),
        )
