"""Equations of a step on an open tree: those of `FullStep`, with the Jacobian kept as blocks along the tree.

A node is a body together with the multipliers of its own joint (and of drives and couplings on it); nodes
of multipliers alone would have a zero pivot. Every effect couples a body with its parent at most.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.full import FullStep
from natcoord_jax.assembly.local import over_instances
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
        width, bodies = 6 * self.tableau.stages, self.bodies
        slots = jnp.asarray(self.elimination.slots)
        size = width + slots.shape[1]
        diagonal = jnp.zeros((bodies + 1, size, size), y.dtype)
        diagonal = diagonal.at[:-1, :width, :width].set(self.body_jacobians(twists))
        unused = (slots == self.unknowns - self.balances)[:, :, None] * jnp.eye(slots.shape[1])
        diagonal = diagonal.at[:-1, width:, width:].add(unused)
        up = jnp.zeros((bodies + 1, size, width), y.dtype)
        blocks = diagonal, up, jnp.swapaxes(up, 1, 2)
        every = self._with_ground(twists)
        offsets = self.elimination.offsets
        for group, where, lam, offset in zip(self.groups, self.situations, multipliers, offsets):
            _, jacobians = over_instances(group, where, self.tableau)
            (by_twist, by_lam), (g_by_twist, _) = jacobians(
                self.start[group.bodies], every[group.bodies], lam
            )
            blocks = self._add_couplings(blocks, group, by_twist)
            if group.multipliers:
                blocks = self._add_multipliers(blocks, group, by_lam, g_by_twist, offset)
        diagonal, up, down = blocks
        return diagonal[:-1], up[:-1], down[:-1]

    def _node(self, touched: Array | np.ndarray) -> Array:
        """The deeper body of each instance; bodies are numbered from the root."""
        return jnp.max(jnp.where(touched < self.bodies, touched, -1), axis=1)

    def _add_couplings(self, blocks: tuple, group: Group, by_twist: Array) -> tuple:
        """Blocks between the bodies of each instance; what falls on the ground goes to a spare block."""
        diagonal, up, down = blocks
        touched, bodies, width = group.bodies, self.bodies, 6 * self.tableau.stages
        count, k = touched.shape
        local = -by_twist.reshape(count, k, width, k, width)
        node = self._node(touched)
        for a in range(k):
            for b in range(k):
                same, deep = touched[:, a] == touched[:, b], touched[:, b] == node
                real = (touched[:, a] < bodies) & (touched[:, b] < bodies)
                block = local[:, a, :, b]
                diagonal = diagonal.at[jnp.where(real & same, touched[:, a], bodies), :width, :width].add(
                    block
                )
                up = up.at[jnp.where(real & ~same & ~deep, node, bodies), :width].add(block)
                down = down.at[jnp.where(real & ~same & deep, node, bodies), :, :width].add(block)
        return diagonal, up, down

    def _add_multipliers(
        self, blocks: tuple, group: Group, by_lam: Array, g_by_twist: Array, offset: Array | np.ndarray
    ) -> tuple:
        """Columns of the multipliers of each instance and rows of its constraints."""
        diagonal, up, down = blocks
        touched, bodies, width = group.bodies, self.bodies, 6 * self.tableau.stages
        count, k = touched.shape
        m = self.tableau.stages * group.multipliers
        by_lam, g_by_twist = -by_lam.reshape(count, k, width, m), g_by_twist.reshape(count, m, k, width)
        node = self._node(touched)
        inside = jnp.arange(width)
        columns = width + offset[:, None] + jnp.arange(m)
        wide, tall = (
            (inside[None, :, None], columns[:, None, :]),
            (columns[:, :, None], inside[None, None, :]),
        )
        for a in range(k):
            mine, real = touched[:, a] == node, touched[:, a] < bodies
            at = jnp.where(mine, node, bodies)[:, None, None]
            diagonal = diagonal.at[at, *wide].add(by_lam[:, a]).at[at, *tall].add(g_by_twist[:, :, a])
            at = jnp.where(~mine & real, node, bodies)[:, None, None]
            down = down.at[at, *wide].add(by_lam[:, a])
            up = up.at[at, *tall].add(g_by_twist[:, :, a])
        return diagonal, up, down
