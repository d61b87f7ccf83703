"""Equations of a step on an open tree: those of `FullStep`, with the Jacobian kept as blocks along the tree.

A node is a body together with the multipliers of its own joint (and of drives and couplings on it); nodes
of multipliers alone would have a zero pivot. Every effect couples a body with its parent at most.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.full import FullStep
from natcoord_jax.assembly.local import over_instances


class RecursiveStep(FullStep):
    """One step on an open tree of bodies."""

    def _slots(self) -> Array:
        """Multipliers of each node, counted after the twists; their number pads."""
        return self.system.elimination.slots

    def jacobian(self, y: Float[Array, " unknowns"]) -> tuple[Array, Array, Array]:
        """Blocks of the exact Jacobian: diagonal, up, down (see `linsolve.tree.TreeBlocks`)."""
        twists, multipliers = self.split(y)
        s, bodies = self.tableau.stages, self.bodies
        width = 6 * s
        slots = self._slots()
        size = width + slots.shape[1]
        count = self.unknowns - self.balances
        own = self.body_jacobians(twists)
        diagonal = jnp.zeros((bodies + 1, size, size), y.dtype).at[:-1, :width, :width].set(own)
        unused = (slots == count)[:, :, None] * jnp.eye(slots.shape[1])
        diagonal = diagonal.at[:-1, width:, width:].add(unused)
        up = jnp.zeros((bodies + 1, size, width), y.dtype)
        down = jnp.zeros((bodies + 1, width, size), y.dtype)
        every = self._with_ground(twists)
        offsets = self.system.elimination.offsets
        for group, where, lam, offset in zip(self.groups, self.situations, multipliers, offsets):
            _, jacobians = over_instances(group, where, self.tableau)
            touched = group.bodies
            (by_twist, by_lam), (g_by_twist, _) = jacobians(self.start[touched], every[touched], lam)
            n, k = touched.shape
            m = s * group.multipliers
            by_twist = -by_twist.reshape(n, k, width, k, width)
            node = jnp.max(jnp.where(touched < bodies, touched, -1), axis=1)
            for a in range(k):
                for b in range(k):
                    same, deep = touched[:, a] == touched[:, b], touched[:, b] == node
                    real = (touched[:, a] < bodies) & (touched[:, b] < bodies)
                    at = jnp.where(real & same, touched[:, a], bodies)
                    diagonal = diagonal.at[at, :width, :width].add(by_twist[:, a, :, b])
                    at = jnp.where(real & ~same & ~deep, node, bodies)
                    up = up.at[at, :width].add(by_twist[:, a, :, b])
                    at = jnp.where(real & ~same & deep, node, bodies)
                    down = down.at[at, :, :width].add(by_twist[:, a, :, b])
            if m:
                by_lam = -by_lam.reshape(n, k, width, m)
                g_by_twist = g_by_twist.reshape(n, m, k, width)
                columns = width + offset[:, None] + jnp.arange(m)
                inside = jnp.arange(width)
                for a in range(k):
                    mine, real = touched[:, a] == node, touched[:, a] < bodies
                    at = jnp.where(mine, node, bodies)[:, None, None]
                    diagonal = diagonal.at[at, inside[None, :, None], columns[:, None, :]].add(by_lam[:, a])
                    diagonal = diagonal.at[at, columns[:, :, None], inside[None, None, :]].add(g_by_twist[:, :, a])
                    at = jnp.where(~mine & real, node, bodies)[:, None, None]
                    down = down.at[at, inside[None, :, None], columns[:, None, :]].add(by_lam[:, a])
                    up = up.at[at, columns[:, :, None], inside[None, None, :]].add(g_by_twist[:, :, a])
        return diagonal[:-1], up[:-1], down[:-1]

