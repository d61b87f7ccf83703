"""Elimination of nodes that see their neighbour only, leaves to root, one node after the other.

Node i has unknowns z_i and follows one other node, its neighbour p:

    r_i = own_i z_i + above_i z_p + sum over followers c of below_c z_c

It is the case of `linsolve.tree` in which nothing is carried: a block tridiagonal matrix for a chain.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.linsolve.tree import passed_down, transposed
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.maths.vectors import applied, product
from natcoord_jax.xla.rows import add_at, row


class NeighbourBlocks(eqx.Module):
    """A matrix of nodes in the order of elimination.

    Attributes:
        own: equations of each node by its own unknowns.
        above: the same by the unknowns of its neighbour.
        below: equations of its neighbour by its own unknowns.
        neighbour: of each node, of lower number; the number of nodes if it has none.
    """

    own: Float[Array, "nodes n n"]
    above: Float[Array, "nodes n n"]
    below: Float[Array, "nodes n n"]
    neighbour: Int[np.ndarray, " nodes"] = eqx.field(**INDICES)

    def multiply(self, z: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Product with a vector."""
        padded = jnp.concatenate([z, jnp.zeros_like(z[:1])])
        found = applied(self.own, z[:, None]) + applied(self.above, padded[self.neighbour][:, None])
        return found + _sums(applied(self.below, z[:, None]), self.neighbour)


class NeighbourFactors(eqx.Module):
    """Factors of a `NeighbourBlocks`.

    Attributes:
        inverse: of the own block of each node, its followers eliminated.
        lift: what the neighbour's right-hand side loses by a unit of the node's.
        drop: what the node's unknowns lose by a unit of the neighbour's.
        neighbour: of each node.
    """

    inverse: Float[Array, "nodes n n"]
    lift: Float[Array, "nodes n n"]
    drop: Float[Array, "nodes n n"]
    neighbour: Int[np.ndarray, " nodes"] = eqx.field(**INDICES)

    def solve(self, right: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Solution for a right-hand side: one loop up, one loop down."""

        def up(left: Array, node: tuple) -> tuple[Array, None]:
            lift, index, neighbour = node
            return add_at(left, neighbour, -applied(lift, row(left, index)[None])), None

        start = jnp.concatenate([right, jnp.zeros_like(right[:1])])
        nodes = self.lift, jnp.arange(right.shape[0]), np.asarray(self.neighbour)
        left = jax.lax.scan(up, start, nodes, reverse=True)[0][:-1]
        alone = applied(self.inverse, left[:, None])
        return passed_down(-self.drop, alone, self.neighbour)[:-1]

    def transpose(self) -> "NeighbourFactors":
        """Factors of the transposed matrix: the loops change places."""
        inverse, lift, drop = (transposed(x) for x in (self.inverse, self.drop, self.lift))
        return NeighbourFactors(inverse, lift, drop, self.neighbour)


def factor(blocks: NeighbourBlocks) -> tuple[NeighbourFactors, Float[Array, "nodes n"]]:
    """Eliminate all nodes, followers first; also the diagonal of the matrix, by node."""
    nodes = blocks.own.shape[0]

    def eliminate(own: Array, node: tuple) -> tuple[Array, tuple]:
        above, below, index, neighbour = node
        inverse = definite_inverse(row(own, index))
        lift, drop = product(below, inverse), product(inverse, above)
        return add_at(own, neighbour, -product(lift, above)), (inverse, lift, drop)

    start = jnp.concatenate([blocks.own, jnp.zeros_like(blocks.own[:1])])
    rows = blocks.above, blocks.below, jnp.arange(nodes), np.asarray(blocks.neighbour)
    inverse, lift, drop = jax.lax.scan(eliminate, start, rows, reverse=True)[1]
    return NeighbourFactors(inverse, lift, drop, blocks.neighbour), jnp.diagonal(blocks.own, axis1=1, axis2=2)


def _sums(values: Float[Array, "nodes n"], neighbour: Int[np.ndarray, " nodes"]) -> Float[Array, "nodes n"]:
    """Of each node, the sum of what its followers have."""

    def body(sums: Array, node: tuple) -> tuple[Array, None]:
        return add_at(sums, node[1], node[0]), None

    start = jnp.zeros((values.shape[0] + 1, values.shape[1]), values.dtype)
    return jax.lax.scan(body, start, (values, np.asarray(neighbour)))[0][:-1]
