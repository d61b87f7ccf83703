"""Recursive elimination on a tree, leaves to root, one node after the other.

Node i has own unknowns z_i; it sees its parent p through a passed quantity x_p (in mechanics: a twist), and
its children through what they hand up, q_c (loads):

    x_i        = (X, Z)_i (x_p, z_i)                                passed down
    (q_i, r_i) = (T, S)_i (A_i x_i + sum of q_c) + N_i (x_p, z_i)   handed up, and the node's own equations

Nodes are numbered from the root, so that descending numbers go from the leaves to the root. An eliminated
subtree hands up a linear function of x_p, as the articulated bodies of rigid-body dynamics do: the cost is
linear in the number of nodes, whatever the shape of the tree, and the loops compile into one kernel.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.linsolve.dense import bordered_inverse
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.maths.vectors import applied, product
from natcoord_jax.xla.rows import add_at, row


def transposed(matrices: Float[Array, "*n r c"]) -> Float[Array, "*n c r"]:
    """Transposed matrices."""
    return jnp.swapaxes(matrices, -1, -2)


def passed_down(
    across: Float[Array, "nodes width width"],
    own: Float[Array, "nodes width"],
    parent: Int[np.ndarray, " nodes"],
) -> Float[Array, "nodes_and_rest width"]:
    """Sums x_i = across_i x_p + own_i, roots to leaves; last, the zero that roots see.

    The loop carries one array and puts out nothing else: an output read from what is carried would make the
    compiler copy all of it for every node.
    """

    def down(seen: Array, node: tuple) -> tuple[Array, None]:
        across, index, parent = node
        return add_at(seen, index, applied(across, row(seen, parent)[None])), None

    start = jnp.concatenate([own, jnp.zeros_like(own[:1])])
    return jax.lax.scan(down, start, (across, jnp.arange(own.shape[0]), np.asarray(parent)))[0]


def handed_up(
    lift: Float[Array, "nodes width width"],
    own: Float[Array, "nodes width"],
    parent: Int[np.ndarray, " nodes"],
) -> Float[Array, "nodes width"]:
    """Sums over children s_i = sum of (lift_c s_c + own_c), leaves to roots."""

    def up(sums: Array, node: tuple) -> tuple[Array, None]:
        lift, own, index, parent = node
        return add_at(sums, parent, applied(lift, row(sums, index)[None]) + own), None

    start = jnp.zeros((own.shape[0] + 1, own.shape[1]), own.dtype)
    every = (lift, own, jnp.arange(own.shape[0]), np.asarray(parent))
    return jax.lax.scan(up, start, every, reverse=True)[0][:-1]


class TreeBlocks(eqx.Module):
    """A matrix with tree structure, from the unknowns z to the equations r of all nodes.

    Attributes:
        own: A.
        spread: X and Z, side by side.
        gather: T and S, one below the other.
        rest: N.
        parent: parent of each node, of lower number; the number of nodes for roots, which see zero.
        definite: unknowns of a node that come first; the others are multipliers of constraints.
    """

    own: Float[Array, "nodes width width"]
    spread: Float[Array, "nodes width all"]
    gather: Float[Array, "nodes all width"]
    rest: Float[Array, "nodes all all"]
    parent: Int[np.ndarray, " nodes"] = eqx.field(**INDICES)
    definite: int = eqx.field(static=True)

    def multiply(self, z: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Product with a vector."""
        width = self.own.shape[1]
        across, own = self.spread[:, :, :width], self.spread[:, :, width:]
        seen = passed_down(across, jnp.einsum("nij,nj->ni", own, z), self.parent)
        both = jnp.concatenate([seen[self.parent], z], axis=1)
        further = jnp.einsum("nij,nj->ni", self.rest, both)
        loads = jnp.einsum("nij,nj->ni", self.own, seen[:-1])
        upward, inward = self.gather[:, :width], self.gather[:, width:]
        handed = jnp.einsum("nij,nj->ni", upward, loads) + further[:, :width]
        loads = loads + handed_up(upward, handed, self.parent)
        return jnp.einsum("nij,nj->ni", inward, loads) + further[:, width:]


class TreeFactors(eqx.Module):
    """Factors of a `TreeBlocks`.

    Attributes:
        inverse: of the own equations of each node, its subtree eliminated.
        to_parent: what is handed up by a unit of the own right-hand sides.
        from_parent: what the own unknowns lose by a unit of what is seen of the parent.
        lift: what is handed up by a unit of what the children hand up.
        drop: what is passed down by a unit of what is seen of the parent.
        gather: S.
        spread: Z.
        parent: parent of each node.
    """

    inverse: Float[Array, "nodes n n"]
    to_parent: Float[Array, "nodes width n"]
    from_parent: Float[Array, "nodes n width"]
    lift: Float[Array, "nodes width width"]
    drop: Float[Array, "nodes width width"]
    gather: Float[Array, "nodes n width"]
    spread: Float[Array, "nodes width n"]
    parent: Int[np.ndarray, " nodes"] = eqx.field(**INDICES)

    def solve(self, right: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Solution for a right-hand side: one loop up, one loop down."""
        handed = applied(self.to_parent, right[:, None, :])
        left = right - applied(self.gather, handed_up(self.lift, handed, self.parent)[:, None, :])
        alone = applied(self.inverse, left[:, None, :])
        moved = applied(self.spread, alone[:, None, :])
        seen = passed_down(self.drop, moved, self.parent)
        return alone - applied(self.from_parent, seen[self.parent][:, None, :])

    def transpose(self) -> "TreeFactors":
        """Factors of the transposed matrix: what is passed down and what is handed up change places."""
        return TreeFactors(
            transposed(self.inverse),
            transposed(self.from_parent),
            transposed(self.to_parent),
            transposed(self.drop),
            transposed(self.lift),
            transposed(self.spread),
            transposed(self.gather),
            self.parent,
        )


def factor(blocks: TreeBlocks) -> tuple[TreeFactors, Float[Array, "nodes n"]]:
    """Eliminate all nodes, leaves to root; also the diagonal of the matrix, by node."""
    nodes, width = blocks.own.shape[:2]

    def eliminate(inertia: Array, node: tuple) -> tuple[Array, tuple]:
        spread, gather, rest, index, parent = node
        # The subtree as it is after elimination, and as if its unknowns were fixed: for the diagonal.
        both = product(gather[None], product(row(inertia, index), spread[None])) + rest
        free, fixed = both[0], both[1]
        inverse = bordered_inverse(free[width:, width:], blocks.definite)
        to_parent = product(free[:width, width:], inverse)
        from_parent = product(inverse, free[width:, :width])
        eliminated = free[:width, :width] - product(to_parent, free[width:, :width])
        lift = gather[:width] - product(to_parent, gather[width:])
        drop = spread[:, :width] - product(spread[:, width:], from_parent)
        handed = jnp.stack([eliminated, fixed[:width, :width]])
        found = inverse, to_parent, from_parent, lift, drop, jnp.diagonal(fixed)[width:]
        return add_at(inertia, parent, handed), found

    start = jnp.concatenate([blocks.own, jnp.zeros((1, width, width), blocks.own.dtype)])
    start = jnp.broadcast_to(start[:, None], (nodes + 1, 2, width, width))
    rows = (blocks.spread, blocks.gather, blocks.rest, jnp.arange(nodes), np.asarray(blocks.parent))
    found = jax.lax.scan(eliminate, start, rows, reverse=True)[1]
    inverse, to_parent, from_parent, lift, drop, diagonal = found
    rims = blocks.gather[:, width:], blocks.spread[:, :, width:]
    return TreeFactors(inverse, to_parent, from_parent, lift, drop, *rims, blocks.parent), diagonal
