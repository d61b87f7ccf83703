"""Solvers of sparse linear equations, chosen by static structure, differentiable in every mode."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.linsolve import multifrontal
from natcoord_jax.linsolve.blocks import BlockMatrix, BlockPattern, Entries
from natcoord_jax.linsolve.graph import graph_of
from natcoord_jax.linsolve.multifrontal import Multifrontal
from natcoord_jax.linsolve.refinement import RefinedSolver
from natcoord_jax.maths.elimination import pivoted_inverse
from natcoord_jax.maths.indices import INDICES

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
    """A plan of elimination along a chain; all of it is static.

    Attributes:
        unknowns: of the nodes, in their order along the chain; n beyond the last.
        diagonal: places of the nodes' own entries in the tiles; after them a zero and a one.
        lower: places of the entries in the rows of a node and the columns of the one before.
        upper: the same for the one after.
        name: for reports.
    """

    unknowns: Int[np.ndarray, "nodes w"] = eqx.field(**INDICES)
    diagonal: Int[np.ndarray, "nodes w w"] = eqx.field(**INDICES)
    lower: Int[np.ndarray, "nodes w w"] = eqx.field(**INDICES)
    upper: Int[np.ndarray, "nodes w w"] = eqx.field(**INDICES)
    name: str = eqx.field(static=True, default="block tridiagonal")

    def factor(self, matrix: BlockMatrix) -> ChainFactors:
        """Factors of a matrix."""
        tiles = matrix.tiles.reshape(-1)
        pool = jnp.concatenate([tiles, jnp.array([0.0, 1.0], tiles.dtype)])
        blocks = pool[self.diagonal], pool[self.lower], pool[self.upper]
        width = self.unknowns.shape[1]
        invert = pivoted_inverse if width < LAPACK else jnp.linalg.inv

        def step(before: tuple[Array, Array], node: tuple) -> tuple[tuple[Array, Array], tuple]:
            own, lower, upper = node
            across = _sums(lower, before[0])
            inverse = invert(own - _sums(across, before[1]))
            return (inverse, upper), (inverse, across, _sums(inverse, upper))

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


def _sums(a: Array, b: Array) -> Array:
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


def chained(path: list[int], entries: Entries, tiles: int) -> BlockTridiagonal:
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
    diagonal, lower, upper = blocks.astype(np.int32)
    return BlockTridiagonal(unknowns.astype(np.int32), diagonal, lower, upper)


DENSE_UP_TO = 70  # unknowns up to which nothing is faster than a dense inverse
UNEVEN = 2.0  # storage of a chain over that of its blocks, from which on padding costs more than it saves
SINGULAR = 1e-6  # residual after refinement, relative to the right-hand side, that no regular matrix leaves


class Dense(eqx.Module):
    """The plan of a small matrix: a dense inverse."""

    name: str = eqx.field(static=True, default="dense")

    def factor(self, matrix: BlockMatrix) -> Float[Array, "n n"]:
        """The inverse."""
        return jnp.linalg.inv(matrix.to_dense())

    def solve(self, factors: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side."""
        return factors @ right

    def solve_transposed(self, factors: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution of the transposed equations."""
        return right @ factors


Plan = Dense | BlockTridiagonal | Multifrontal


def choose(
    pattern: BlockPattern,
    entries: Entries,
    *,
    matrices: Sequence[BlockMatrix] = (),
    coordinates: np.ndarray | None = None,
    name: str | None = None,
) -> Plan:
    """The solver that suits a structure: dense for few unknowns, along the chain for chains, else by fronts.

    Args:
        pattern: of the matrices.
        entries: of the pattern.
        matrices: typical ones, for a rehearsal that settles the order of the pivots in the fronts. Without
            any, pivots are on the diagonal, balances before the constraints of the same node.
        coordinates: positions of the nodes (N, dimensions), by which meshes are dissected.
        name: of the solver: "dense", "block tridiagonal" or "multifrontal"; default: chosen.

    Raises:
        ValueError: for the solver of chains where the nodes are none, and for a name that there is not.
    """
    if name not in (None, "dense", "block tridiagonal", "multifrontal"):
        raise ValueError(f'no solver {name!r}; pass "dense", "block tridiagonal", "multifrontal" or None')
    if name == "dense" or (name is None and entries.size <= DENSE_UP_TO):
        return Dense()
    graph = graph_of(entries)
    tiles = pattern.rows.size * pattern.columns.shape[1]
    path = graph.path()
    weights = graph.weights
    even = len(weights) * weights.max() ** 2 <= UNEVEN * np.sum(weights**2)
    if name == "block tridiagonal" and path is None:
        raise ValueError('the nodes are no chain: some node sees more than two; pass "multifrontal"')
    # Nodes that see no other are a chain, too, but need not wait for each other.
    linked = any(graph.neighbours)
    if path is not None and (name == "block tridiagonal" or (name is None and even and linked)):
        return chained(path, entries, tiles)
    values = np.array([entries.values(matrix.tiles) for matrix in matrices]) if matrices else None
    return multifrontal.plan(graph, entries, tiles, values=values, coordinates=coordinates)


class Factorised(eqx.Module):
    """Factors of a matrix, to be applied in an iteration."""

    plan: Plan
    factors: Any
    transposed: bool = eqx.field(static=True, default=False)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side, unrefined."""
        apply = self.plan.solve_transposed if self.transposed else self.plan.solve
        return apply(self.factors, right)

    def transpose(self) -> "Factorised":
        """Factors of the transposed matrix."""
        return Factorised(self.plan, self.factors, not self.transposed)


def factorised(plan: Plan, matrix: BlockMatrix) -> Factorised:
    """Factors of a matrix by a plan."""
    return Factorised(plan, plan.factor(matrix))


class SparseSolver(RefinedSolver):
    """A sparse matrix with its factors.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, numpy as np
        >>> from natcoord_jax.linsolve.blocks import block_pattern
        >>> pattern, entries = block_pattern(np.arange(100), [np.arange(100)[:, None]])
        >>> plan = choose(pattern, entries)
        >>> def first(stiffness):
        ...     matrix = pattern.assemble(jnp.full((100, 1, 1), stiffness))
        ...     return SparseSolver.of(plan, matrix).solve(jnp.ones(100))[0]
        >>> float(first(4.0)), float(jax.grad(first)(4.0))
        (0.25, -0.0625)
    """

    @classmethod
    def of(cls, plan: Plan, matrix: BlockMatrix) -> "SparseSolver":
        """Factorise a matrix."""
        # Its derivatives would be worked out in vain: see `refined_solve`.
        return cls(matrix, factorised(plan, jax.lax.stop_gradient(matrix)))

    def singular(self, x: Float[Array, " n"], right: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether x leaves a residual that no solution of regular equations does, or is not finite."""
        residual = jnp.max(jnp.abs(right - self.matrix.multiply(x)))
        return ~(residual <= SINGULAR * jnp.max(jnp.abs(right)))


SHIFT = 1e-10  # diagonal of the constraint rows in units of the matrix, one for all of them


def inertias_of(matrix: BlockMatrix, balances: int) -> Float[Array, " n"]:
    """Inertias of the unknowns, 0 for multipliers."""
    return jnp.abs(matrix.diagonal()).at[balances:].set(0.0)


def regularised(matrix: BlockMatrix, inertias: Float[Array, " n"]) -> BlockMatrix:
    """The matrix with a small diagonal in the rows of the constraints, so that dependent ones do no harm.

    Args:
        matrix: with balances first.
        inertias: of the unknowns, 0 for multipliers.
    """
    pattern = matrix.pattern
    extended = jnp.append(inertias, 0.0)
    balance, row = extended[pattern.columns] > 0, extended[pattern.rows] > 0
    inverse = jnp.where(balance, 1.0 / jnp.where(balance, extended[pattern.columns], 1.0), 0.0)
    size = jnp.where(row[:, :, None], 0.0, matrix.tiles**2 * inverse[:, None, :])
    shift = SHIFT * jnp.maximum(jnp.max(size), jnp.finfo(inertias.dtype).tiny)
    return matrix.with_diagonal(jnp.where(inertias > 0, 0.0, shift))
