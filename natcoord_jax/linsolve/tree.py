"""Recursive elimination on a tree of blocks, leaves to root, in scans over rows of independent nodes.

Node i has its own unknowns z_i, the first `width` of which its children see. Equation i reads
D_i z_i + U_i x_p + sum over children c of L_c z_c = b_i, where x_p are the parent's visible unknowns and L_c
acts on the visible rows. Eliminating a node changes only its parent's visible block, so the cost is linear
in the number of nodes. Rows of the schedule hold nodes that do not depend on each other, narrow ones a few
levels deep and wide ones cut to a fixed width, so that padding stays small whatever the shape of the tree.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class TreeBlocks(eqx.Module):
    """A matrix with tree structure.

    Attributes:
        diagonal: D, own blocks.
        up: U, columns of the parent's visible unknowns; zero for roots.
        down: L, rows of the parent's visible equations; zero for roots.
        parent: parent of each node; the number of nodes for roots.
        schedule: nodes in order of elimination, leaves first; the number of nodes pads a row.
    """

    diagonal: Float[Array, "nodes n n"]
    up: Float[Array, "nodes n width"]
    down: Float[Array, "nodes width n"]
    parent: Int[Array, " nodes"]
    schedule: Int[Array, "rows lanes"]

    def multiply(self, x: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Product with a vector."""
        width = self.up.shape[-1]
        seen = jnp.concatenate([x[:, :width], jnp.zeros_like(x[:1, :width])])[self.parent]
        own = jnp.einsum("nij,nj->ni", self.diagonal, x) + jnp.einsum("nij,nj->ni", self.up, seen)
        lifted = jnp.einsum("nij,nj->ni", self.down, x)
        onto = jnp.zeros((x.shape[0] + 1, width), x.dtype).at[self.parent].add(lifted)
        return own.at[:, :width].add(onto[:-1])


class TreeFactors(eqx.Module):
    """Factors of a `TreeBlocks`, in order of the schedule.

    Attributes:
        inverse: inverses of the eliminated diagonal blocks.
        to_parent: L D^-1.
        from_parent: D^-1 U.
        parent: parents of the scheduled nodes.
        schedule: the schedule.
        nodes: number of nodes.
    """

    inverse: Float[Array, "rows lanes n n"]
    to_parent: Float[Array, "rows lanes width n"]
    from_parent: Float[Array, "rows lanes n width"]
    parent: Int[Array, "rows lanes"]
    schedule: Int[Array, "rows lanes"]
    nodes: int = eqx.field(static=True)

    def solve(self, right: Float[Array, "nodes n"]) -> Float[Array, "nodes n"]:
        """Solution for a right-hand side: one scan up, one scan down."""
        size, width = right.shape[1], self.from_parent.shape[-1]
        padded = jnp.concatenate([right, jnp.zeros((1, size), right.dtype)])

        def up(total, row):
            to_parent, nodes, parent = row
            b = total[nodes]
            passed = -jnp.sum(to_parent * b[:, None, :], axis=-1)
            filled = jnp.concatenate([passed, jnp.zeros((b.shape[0], size - width), b.dtype)], axis=1)
            return total.at[parent].add(filled), b

        _, loads = jax.lax.scan(up, padded, (self.to_parent, self.schedule, self.parent))

        def down(found, row):
            inverse, from_parent, b, nodes, parent = row
            x = jnp.sum(inverse * b[:, None, :], axis=-1)
            x = x - jnp.sum(from_parent * found[parent][:, None, :width], axis=-1)
            return found.at[nodes].set(jnp.where((nodes < self.nodes)[:, None], x, 0.0)), None

        rows = (self.inverse, self.from_parent, loads, self.schedule, self.parent)
        found, _ = jax.lax.scan(down, jnp.zeros_like(padded), rows, reverse=True)
        return found[:-1]

    def transpose(self) -> "TreeFactors":
        """Factors of the transposed matrix."""
        swap = lambda x: jnp.swapaxes(x, -1, -2)  # noqa: E731
        return TreeFactors(
            swap(self.inverse),
            swap(self.from_parent),
            swap(self.to_parent),
            self.parent,
            self.schedule,
            self.nodes,
        )


def factor(blocks: TreeBlocks) -> TreeFactors:
    """Eliminate all nodes, leaves to root."""
    nodes, size = blocks.diagonal.shape[:2]
    width = blocks.up.shape[-1]
    dtype = blocks.diagonal.dtype

    def pad(x: Array, last: Array) -> Array:
        return jnp.concatenate([x, last[None].astype(x.dtype)])[blocks.schedule]

    own = pad(blocks.diagonal, jnp.eye(size, dtype=dtype))
    up = pad(blocks.up, jnp.zeros((size, width), dtype))
    down = pad(blocks.down, jnp.zeros((width, size), dtype))
    parent = pad(blocks.parent, jnp.asarray(nodes))

    def eliminate(added, row):
        own, up, down, index, parent = row
        own = own.at[:, :width, :width].add(added[index])
        inverse = jnp.linalg.inv(own)
        to_parent, from_parent = down @ inverse, inverse @ up
        return added.at[parent].add(-to_parent @ up), (inverse, to_parent, from_parent)

    start = jnp.zeros((nodes + 1, width, width), dtype)
    rows = (own, up, down, blocks.schedule, parent)
    _, (inverse, to_parent, from_parent) = jax.lax.scan(eliminate, start, rows)
    return TreeFactors(inverse, to_parent, from_parent, parent, blocks.schedule, nodes)


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
