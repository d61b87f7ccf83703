"""Static multifrontal elimination: sparse matrices by dense fronts, in levels of batched products.

A front gathers the entries of the matrix and what its children hand up, eliminates its pivots and hands up
what is left (the Schur complement). All that depends on the structure is decided on the host, so that a
factorisation is a fixed sequence of batched dense kernels: for a front with the blocks (A, B; C, D),

    P = A^-1,   L = C P,   W = P B,   S = D - L B.

A solution takes products and gathers only; the transposed matrix exchanges W and L.

Source: Duff, Reid: The multifrontal solution of indefinite sparse symmetric linear equations, 1983.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.linsolve.blocks import BlockMatrix, Entries
from natcoord_jax.linsolve.graph import Graph
from natcoord_jax.linsolve.inverse import inverses
from natcoord_jax.linsolve.ordering import dissection, rounds
from natcoord_jax.linsolve.schedule import Bucket, Level, schedule
from natcoord_jax.linsolve.symbolic import (
    Front,
    Sizes,
    amalgamated,
    analyse_pivots,
    estimate,
    fronts_of,
    natural,
    top_merged,
)

LEAVES = (1, 24, 48, 96)  # unknowns in a piece that is not dissected further: what is tried
ROUNDS_UP_TO = 1500  # nodes of a mesh whose fill is still followed node by node


class FrontFactors(eqx.Module):
    """Factors of the fronts of one bucket."""

    inverse: Float[Array, "fronts p p"]
    lower: Float[Array, "fronts b p"]
    upper: Float[Array, "fronts p b"]

    def transpose(self) -> "FrontFactors":
        """Factors of the transposed fronts."""
        swapped = (jnp.swapaxes(x, -1, -2) for x in (self.inverse, self.upper, self.lower))
        return FrontFactors(*swapped)


class Multifrontal(eqx.Module):
    """A plan of elimination; all of it is static.

    Attributes:
        levels: from the roots to the deepest.
        name: for reports.
    """

    levels: tuple[Level, ...]
    name: str = eqx.field(static=True, default="multifrontal")

    def factor(self, matrix: BlockMatrix) -> list[tuple[FrontFactors, ...]]:
        """Factors of a matrix, by level and bucket."""
        tiles = matrix.tiles.reshape(-1)
        pool = jnp.concatenate([tiles, jnp.ones_like(tiles[:1])])
        found: list[tuple[FrontFactors, ...]] = []
        handed: list[tuple[Bucket, Array]] = []
        for level in reversed(self.levels):
            work = jnp.zeros(level.work, tiles.dtype)
            given = pool.at[level.source].get(mode="promise_in_bounds")
            work = work.at[level.target].set(given, mode="promise_in_bounds", unique_indices=True)
            for child, schur in handed:
                work = child.hand_up(work, schur)
            handed, factors = [], []
            for bucket in level.buckets:
                count, p, b = bucket.shape
                m = p + b
                fronts = work[bucket.first : bucket.first + count * m * m].reshape(count, m, m)
                inverse = inverses(fronts[:, :p, :p])
                lower, upper = fronts[:, p:, :p] @ inverse, inverse @ fronts[:, :p, p:]
                factors.append(FrontFactors(inverse, lower, upper))
                if b:
                    schur = fronts[:, p:, p:] - lower @ fronts[:, :p, p:]
                    handed.append((bucket, schur))
            found.append(tuple(factors))
        return found[::-1]

    def solve(self, factors: list[tuple[FrontFactors, ...]], right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side."""
        return self._substituted(factors, right, transposed=False)

    def solve_transposed(
        self, factors: list[tuple[FrontFactors, ...]], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Solution of the transposed equations."""
        turned = [tuple(f.transpose() for f in level) for level in factors]
        return self._substituted(turned, right, transposed=True)

    def _substituted(self, factors: list, right: Array, *, transposed: bool) -> Array:
        left = jnp.concatenate([right, jnp.zeros_like(right[:1])])
        steps = [
            (bucket.columns, bucket.rows, bucket.boundary, own)
            if transposed
            else (bucket.rows, bucket.columns, bucket.boundary, own)
            for level, found in zip(self.levels, factors)
            for bucket, own in zip(level.buckets, found)
        ]
        parts = []
        for rows, _, boundary, own in reversed(steps):
            part = left[rows]
            parts.append(part)
            if boundary.shape[1]:
                left = left.at[boundary].add(-_times(own.lower, part))
        x = jnp.zeros_like(left)
        for (_, columns, boundary, own), part in zip(steps, reversed(parts)):
            alone = _times(own.inverse, part)
            if boundary.shape[1]:
                alone = alone - _times(own.upper, x[boundary])
            x = x.at[columns].set(alone)
        return x[:-1]


def _times(matrices: Array, vectors: Array) -> Array:
    return jnp.einsum("fij,fj->fi", matrices, vectors)


def plan(
    graph: Graph,
    entries: Entries,
    tiles: int,
    *,
    values: np.ndarray | None = None,
    coordinates: np.ndarray | None = None,
) -> Multifrontal:
    """The cheapest plan of elimination among several orders.

    Args:
        graph: of the matrix.
        entries: of the matrix.
        tiles: number of places in the tiles.
        values: of the entries, of each matrix (matrices, entries) of a rehearsal that settles the order of
            the pivots; default: natural.
        coordinates: positions of the nodes (N, dimensions).
    """
    fronts = cheapest(graph, coordinates)
    if values is None:
        pivots = natural(graph, fronts)
    else:
        fronts, pivots = analyse_pivots(graph, fronts, entries, values)
    _, buckets = estimate(fronts, Sizes(graph))
    return Multifrontal(schedule(graph, fronts, pivots, buckets, entries, tiles))


def cheapest(graph: Graph, coordinates: np.ndarray | None = None) -> list[Front]:
    """Fronts of the order of elimination that the model of costs likes best."""
    sizes = Sizes(graph)
    best, found = np.inf, []
    edges, nodes = sum(map(len, graph.neighbours)) / 2, len(graph.members)
    orders = [dissection(graph.neighbours, graph.weights, leaf, coordinates) for leaf in LEAVES]
    if nodes <= ROUNDS_UP_TO or edges < 1.5 * nodes:
        orders.append(rounds(graph.neighbours))
    for groups in orders:
        fronts = amalgamated(fronts_of(graph, groups), sizes)
        for levels in range(1, 6):
            candidate = top_merged(fronts, levels)
            time, _ = estimate(candidate, sizes)
            if time < best:
                best, found = time, candidate
    return found
