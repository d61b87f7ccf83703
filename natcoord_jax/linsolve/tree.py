"""Recursive elimination on a tree of blocks, leaves to root, one node after the other.

Node i has its own unknowns z_i, the first `width` of which its children see. Equation i reads
D_i z_i + U_i x_p + sum over children c of L_c z_c = b_i, where x_p are the parent's visible unknowns and L_c
acts on the visible rows. Nodes are numbered from the root, so that descending numbers go from the leaves to
the root. Eliminating a node changes only its parent's visible block: the cost is linear in the number of
nodes, whatever the shape of the tree, and the loops compile into one kernel.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.linsolve.dense import bordered_inverse


def _add_at(x: Array, index: Array, change: Array) -> Array:
    """Rows of x with one of them changed; unlike a scatter, this compiles in place."""
    row = jax.lax.dynamic_index_in_dim(x, index, keepdims=False)
    return jax.lax.dynamic_update_index_in_dim(x, row + change, index, 0)


def _apply(matrix: Array, vector: Array) -> Array:
    return jnp.sum(matrix * vector, axis=-1)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


class TreeBlocks(eqx.Module):
    """A matrix with tree structure.

    Attributes:
        diagonal: D, own blocks; below the visible rows they are zero or one on their own diagonal.
        up: U, columns of the parent's visible unknowns; zero for roots.
        down: L, rows of the parent's visible equations; zero for roots.
        parent: parent of each node, of lower number; the number of nodes for roots.
    """

    diagonal: Float[Array, "nodes n n"]
    up: Float[Array, "nodes n width"]
    down: Float[Array, "nodes width n"]
    parent: Int[Array, " nodes"]

    def multiply(self, x: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Product with a vector."""
        width = self.up.shape[-1]
        seen = jnp.concatenate([x[:, :width], jnp.zeros_like(x[:1, :width])])[self.parent]
        own = jnp.einsum("nij,nj->ni", self.diagonal, x) + jnp.einsum("nij,nj->ni", self.up, seen)
        lifted = jnp.einsum("nij,nj->ni", self.down, x)
        onto = jnp.zeros((x.shape[0] + 1, width), x.dtype).at[self.parent].add(lifted)
        return own.at[:, :width].add(onto[:-1])


class TreeFactors(eqx.Module):
    """Factors of a `TreeBlocks`.

    Attributes:
        inverse: inverses of the eliminated diagonal blocks.
        to_parent: L D^-1.
        from_parent: D^-1 U.
        parent: parent of each node.
    """

    inverse: Float[Array, "nodes n n"]
    to_parent: Float[Array, "nodes width n"]
    from_parent: Float[Array, "nodes n width"]
    parent: Int[Array, " nodes"]

    def solve(self, right: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Solution for a right-hand side: one loop up, one loop down."""
        nodes, width = right.shape[0], self.from_parent.shape[-1]
        spare = jnp.zeros((1, width), right.dtype)

        def up(added: Array, node: tuple) -> tuple[Array, Array]:
            to_parent, own, index, parent = node
            b = jnp.concatenate([own[:width] + added[index], own[width:]])
            return _add_at(added, parent, -_apply(to_parent, b)), b

        added = jnp.zeros((nodes + 1, width), right.dtype)
        _, loads = jax.lax.scan(
            up, added, (self.to_parent, right, jnp.arange(nodes), self.parent), reverse=True
        )

        def down(seen: Array, node: tuple) -> tuple[Array, Array]:
            inverse, from_parent, b, index, parent = node
            x = _apply(inverse, b) - _apply(from_parent, seen[parent])
            return jax.lax.dynamic_update_index_in_dim(seen, x[:width], index, 0), x

        seen = jnp.concatenate([jnp.zeros((nodes, width), right.dtype), spare])
        rows = (self.inverse, self.from_parent, loads, jnp.arange(nodes), self.parent)
        return jax.lax.scan(down, seen, rows)[1]

    def transpose(self) -> "TreeFactors":
        """Factors of the transposed matrix."""
        swap = lambda x: jnp.swapaxes(x, -1, -2)  # noqa: E731
        return TreeFactors(swap(self.inverse), swap(self.from_parent), swap(self.to_parent), self.parent)


def factor(blocks: TreeBlocks) -> TreeFactors:
    """Eliminate all nodes, leaves to root."""
    nodes, width = blocks.diagonal.shape[0], blocks.up.shape[-1]

    def eliminate(added: Array, node: tuple) -> tuple[Array, tuple]:
        own, up, down, index, parent = node
        visible = own[:width, :width] + added[index]
        own = jnp.concatenate([jnp.concatenate([visible, own[:width, width:]], axis=1), own[width:]])
        inverse = bordered_inverse(own, width)
        to_parent, from_parent = _product(down, inverse), _product(inverse, up)
        return _add_at(added, parent, -_product(to_parent, up)), (inverse, to_parent, from_parent)

    start = jnp.zeros((nodes + 1, width, width), blocks.diagonal.dtype)
    rows = (blocks.diagonal, blocks.up, blocks.down, jnp.arange(nodes), blocks.parent)
    _, (inverse, to_parent, from_parent) = jax.lax.scan(eliminate, start, rows, reverse=True)
    return TreeFactors(inverse, to_parent, from_parent, blocks.parent)


class TreeSolver(eqx.Module):
    """Tree blocks with their factors: solves are refined once and differentiable in every mode."""

    blocks: TreeBlocks
    factors: TreeFactors

    def solve(self, right: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Solution of blocks x = right."""
        factors = jax.lax.stop_gradient(self.factors)

        def refined(given: TreeFactors, multiply, b: Array) -> Array:
            x = given.solve(b)
            return x + given.solve(b - multiply(x))

        return jax.lax.custom_linear_solve(
            self.blocks.multiply,
            right,
            solve=lambda multiply, b: refined(factors, multiply, b),
            transpose_solve=lambda multiply, b: refined(factors.transpose(), multiply, b),
        )
