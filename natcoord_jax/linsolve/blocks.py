"""Block-sparse matrices, scattered from element matrices.

Unknowns belong to nodes; elements touch any of them and bring dense matrices. The entries are kept in dense
tiles: the rows of a node by the columns that they see. A product is one gather, one batched product and one
scatter of vectors, whichever way round.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.maths.indices import INDICES


@dataclass(frozen=True)
class Entries:
    """The structural entries of a matrix, on the host.

    Attributes:
        nodes: node of each unknown (n,), from 0 on.
        rows: of the entries, ascending.
        columns: of the entries, ascending within a row.
        places: of the entries in the flattened tiles.
    """

    nodes: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    places: np.ndarray

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.nodes.shape[0]

    def values(self, tiles: Any) -> np.ndarray:
        """Numbers of the entries."""
        return np.asarray(tiles).reshape(-1)[self.places]


class BlockPattern(eqx.Module):
    """Where the entries of a block-sparse matrix are; all of it is static.

    Attributes:
        rows: of the tiles; n beyond their last one.
        columns: of the tiles; n beyond their last one.
        slots: places of the entries of the element matrices among those of the tiles, by kind of element;
            what lies beyond is dropped.
        diagonal: places of the diagonal entries.
        size: number of unknowns n.
    """

    rows: Int[np.ndarray, "tiles r"] = eqx.field(**INDICES)
    columns: Int[np.ndarray, "tiles c"] = eqx.field(**INDICES)
    slots: tuple[Int[np.ndarray, "_ _ _"], ...] = eqx.field(**INDICES)
    diagonal: Int[np.ndarray, " n"] = eqx.field(**INDICES)
    size: int = eqx.field(static=True)

    def assemble(self, *locals_: Float[Array, "_ _ _"]) -> "BlockMatrix":
        """The matrix with these element matrices, one array for each kind of element."""
        shape = (*self.rows.shape, self.columns.shape[1])
        dtype = jnp.result_type(*locals_)
        flat = jnp.zeros(shape[0] * shape[1] * shape[2], dtype)
        for slots, local in zip(self.slots, locals_, strict=True):
            flat = flat.at[slots].add(local, mode="drop")
        return BlockMatrix(self, flat.reshape(shape))


class BlockMatrix(eqx.Module):
    """A block-sparse matrix.

    Attributes:
        pattern: where the entries are.
        tiles: the entries; zero where there are none.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, numpy as np
        >>> springs = np.array([[0, 1], [1, 2]])
        >>> pattern, entries = block_pattern(np.arange(3), [springs])
        >>> matrix = pattern.assemble(jnp.tile(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), (2, 1, 1)))
        >>> matrix.multiply(jnp.array([0.0, 1.0, 3.0])).tolist()
        [-1.0, -1.0, 2.0]
    """

    pattern: BlockPattern
    tiles: Float[Array, "tiles r c"]

    def multiply(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Product with a vector."""
        return self._product("trc,tc->tr", x, self.pattern.columns, self.pattern.rows)

    def multiply_transposed(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Product of the transposed matrix with a vector."""
        return self._product("trc,tr->tc", x, self.pattern.rows, self.pattern.columns)

    def _product(self, how: str, x: Array, seen: np.ndarray, given: np.ndarray) -> Array:
        extended = jnp.concatenate([x, jnp.zeros_like(x[:1])])
        parts = jnp.einsum(how, self.tiles, extended[seen])
        return jnp.zeros_like(extended, parts.dtype).at[given].add(parts)[:-1]

    def diagonal(self) -> Float[Array, " n"]:
        """Entries of the diagonal; zero where there is none."""
        return self.tiles.reshape(-1).at[self.pattern.diagonal].get(mode="fill", fill_value=0.0)

    def with_diagonal(self, added: Float[Array, " n"]) -> "BlockMatrix":
        """The matrix with numbers added to the entries of its diagonal."""
        flat = self.tiles.reshape(-1).at[self.pattern.diagonal].add(added, mode="drop")
        return BlockMatrix(self.pattern, flat.reshape(self.tiles.shape))

    def to_dense(self) -> Float[Array, "n n"]:
        """The matrix as a dense array."""
        n = self.pattern.size
        dense = jnp.zeros((n + 1, n + 1), self.tiles.dtype)
        places = self.pattern.rows[:, :, None], self.pattern.columns[:, None, :]
        return dense.at[places].add(self.tiles)[:n, :n]


def block_pattern(nodes: np.ndarray, elements: list[np.ndarray]) -> tuple[BlockPattern, Entries]:
    """Pattern of the matrices that elements scatter into; on the host, once.

    Args:
        nodes: node of each unknown (n,), numbered from 0.
        elements: unknowns of the elements, an array (count, width) for each kind; n stands for what is fixed,
            as the ground, and is dropped.

    Returns:
        The pattern, and its entries for the analysis of the structure.

    Raises:
        ValueError: for an unknown that no element touches: its row would be zero.
    """
    nodes = np.asarray(nodes)
    n = nodes.shape[0]
    keys = [u[:, :, None] * (n + 1) + u[:, None, :] for u in (np.asarray(u, np.int64) for u in elements)]
    # What is fixed, in row or column, is left out.
    unique = np.unique(np.concatenate([np.zeros(0, np.int64), *(k.ravel() for k in keys)]))
    unique = unique[(unique // (n + 1) < n) & (unique % (n + 1) < n)]
    rows, columns = unique // (n + 1), unique % (n + 1)
    idle = np.setdiff1d(np.arange(n), rows)
    if idle.size:
        raise ValueError(f"unknowns {idle[:8].tolist()} are in no element; give each unknown an element")
    tiles_rows, tiles_columns, places = _tiles(nodes, rows, columns)
    total = tiles_rows.size * tiles_columns.shape[1]
    slots = []
    for key in keys:
        found = np.minimum(np.searchsorted(unique, key), max(len(unique) - 1, 0))
        slots.append(np.where(unique[found] == key, places[found], total).astype(np.int32))
    diagonal = np.full(n, total)
    diagonal[rows[rows == columns]] = places[rows == columns]
    pattern = BlockPattern(
        tiles_rows.astype(np.int32),
        tiles_columns.astype(np.int32),
        tuple(slots),
        diagonal.astype(np.int32),
        n,
    )
    return pattern, Entries(nodes, rows, columns, places)


def _tiles(
    nodes: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the tiles, and the places of the entries in them."""
    n, count = nodes.shape[0], int(nodes.max(initial=-1)) + 1
    # Rank of each unknown in its node, and of each column among those that the node sees.
    order = np.argsort(nodes, kind="stable")
    heights = np.bincount(nodes, minlength=count)
    row_rank = np.empty(n, np.int64)
    row_rank[order] = np.arange(n) - np.repeat(np.cumsum(heights) - heights, heights)
    pairs, of_entry = np.unique(nodes[rows] * n + columns, return_inverse=True)
    widths = np.bincount(pairs // n, minlength=count)
    column_rank = np.arange(len(pairs)) - np.repeat(np.cumsum(widths) - widths, widths)
    r, c = _tile_shape(heights, widths)
    high, wide = -(-heights // r), -(-widths // c)
    first = np.cumsum(high * wide) - high * wide
    tile_rows = np.full((int((high * wide).sum()), r), n)
    tile_columns = np.full((len(tile_rows), c), n)
    node, row, column = nodes[rows], row_rank[rows], column_rank[of_entry]
    tile = first[node] + (row // r) * wide[node] + column // c
    tile_rows[tile, row % r], tile_columns[tile, column % c] = rows, columns
    return tile_rows, tile_columns, (tile * r + row % r) * c + column % c


def _tile_shape(heights: np.ndarray, widths: np.ndarray) -> tuple[int, int]:
    """Rows and columns of a tile: least storage, small tiles paying for their indices."""
    choices = [np.unique(np.quantile(x, np.linspace(0, 1, 9), method="nearest")) for x in (heights, widths)]
    best = (np.inf, 1, 1)
    for r in map(int, choices[0]):
        for c in map(int, choices[1]):
            tiles = np.sum(-(-heights // r) * -(-widths // c))
            best = min(best, (float(tiles * (r * c + 4 * (r + c))), r, c))
    return best[1], best[2]
