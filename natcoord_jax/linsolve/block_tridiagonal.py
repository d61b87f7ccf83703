"""Block elimination along a chain, one node after the other (the Thomas algorithm with blocks).

    P_i = (D_i - L_i P_(i-1) U_(i-1))^-1

The loop compiles into one kernel, whatever the length of the chain, and batches well. Pivots are chosen
within a node.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.linsolve.blocks import BlockMatrix, Entries
from natcoord_jax.linsolve.inverse import pivoted

SMALL = 24  # width of blocks whose products are written as sums: these stay in the kernel of the loop
LAPACK = 48  # width of blocks from which on LAPACK inverts them faster


class ChainFactors(eqx.Module):
    """Factors along a chain.

    Attributes:
        inverse: P.
        lower: L_i P_(i-1).
        upper: P_i U_i.
    """

    inverse: Float[Array, "nodes w w"]
    lower: Float[Array, "nodes w w"]
    upper: Float[Array, "nodes w w"]


class BlockTridiagonal(eqx.Module):
    """A plan of elimination along a chain; indices are leaves, all else is static.

    Attributes:
        unknowns: of the nodes, in their order along the chain; n beyond the last.
        diagonal: places of the nodes' own entries in the tiles; after them a zero and a one.
        lower: places of the entries in the rows of a node and the columns of the one before.
        upper: the same for the one after.
        name: for reports.
    """

    unknowns: Int[Array, "nodes w"]
    diagonal: Int[Array, "nodes w w"]
    lower: Int[Array, "nodes w w"]
    upper: Int[Array, "nodes w w"]
    name: str = eqx.field(static=True, default="block tridiagonal")

    def factor(self, matrix: BlockMatrix) -> ChainFactors:
        """Factors of a matrix."""
        tiles = matrix.tiles.reshape(-1)
        pool = jnp.concatenate([tiles, jnp.array([0.0, 1.0], tiles.dtype)])
        blocks = pool[self.diagonal], pool[self.lower], pool[self.upper]
        width = self.unknowns.shape[1]
        invert = pivoted if width < LAPACK else jnp.linalg.inv

        def step(before: tuple[Array, Array], node: tuple) -> tuple[tuple[Array, Array], tuple]:
            own, lower, upper = node
            across = _product(lower, before[0])
            inverse = invert(own - _product(across, before[1]))
            return (inverse, upper), (inverse, across, _product(inverse, upper))

        zero = jnp.zeros((width, width), tiles.dtype)
        return ChainFactors(*jax.lax.scan(step, (zero, zero), blocks)[1])

    def solve(self, factors: ChainFactors, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side."""
        extended = jnp.concatenate([right, jnp.zeros_like(right[:1])])
        downward = _swept(factors.lower, extended[self.unknowns])
        alone = jnp.einsum("nij,nj->ni", factors.inverse, downward)
        found = _swept(factors.upper, alone, reverse=True)
        return extended.at[self.unknowns].set(found)[:-1]

    def solve_transposed(self, factors: ChainFactors, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution of the transposed equations.

        The factors of a node's neighbours change places: (P_i U_i)^T stands in the rows of node i + 1.
        """
        inverse, lower, upper = (
            jnp.swapaxes(x, -1, -2) for x in (factors.inverse, factors.lower, factors.upper)
        )
        turned = ChainFactors(inverse, jnp.roll(upper, 1, 0), jnp.roll(lower, -1, 0))
        return self.solve(turned, right)


def _product(a: Array, b: Array) -> Array:
    if a.shape[-1] > SMALL:
        return a @ b
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _swept(factors: Array, right: Array, *, reverse: bool = False) -> Array:
    """Sums y_i = b_i - F_i y_(i-1), or from the last to the first."""

    def step(before: Array, node: tuple[Array, Array]) -> tuple[Array, Array]:
        factor, own = node
        own = own - jnp.sum(factor * before[None, :], axis=1)
        return own, own

    return jax.lax.scan(step, jnp.zeros_like(right[0]), (factors, right), reverse=reverse)[1]


def plan(path: list[int], entries: Entries, tiles: int) -> BlockTridiagonal:
    """Index arrays of a chain.

    Args:
        path: its nodes in order.
        entries: of the matrix.
        tiles: number of places in the tiles.
    """
    n, nodes = entries.size, len(path)
    position = np.empty(nodes, int)
    position[path] = np.arange(nodes)
    at = position[entries.nodes]
    order = np.argsort(at, kind="stable")
    heights = np.bincount(at, minlength=nodes)
    rank = np.empty(n, int)
    rank[order] = np.arange(n) - np.repeat(np.cumsum(heights) - heights, heights)
    width = int(heights.max(initial=1))
    unknowns = np.full((nodes, width), n)
    unknowns[at, rank] = np.arange(n)
    blocks = np.full((3, nodes, width, width), tiles)
    # Unused unknowns get a one on the diagonal.
    blocks[0][:, np.arange(width), np.arange(width)] = np.where(unknowns == n, tiles + 1, tiles)
    rows, columns = entries.rows, entries.columns
    step = at[columns] - at[rows]
    assert np.all(np.abs(step) <= 1), "the nodes are no chain: an entry reaches over a node"
    blocks[np.where(step < 0, 1, 2 * step), at[rows], rank[rows], rank[columns]] = entries.places
    diagonal, lower, upper = (jnp.asarray(x, jnp.int32) for x in blocks)
    return BlockTridiagonal(jnp.asarray(unknowns, jnp.int32), diagonal, lower, upper)
