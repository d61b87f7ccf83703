"""Solvers of sparse linear equations, chosen by static structure, differentiable in every mode."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.linsolve import block_tridiagonal, multifrontal
from natcoord_jax.linsolve.block_tridiagonal import BlockTridiagonal
from natcoord_jax.linsolve.blocks import BlockMatrix, BlockPattern, Entries
from natcoord_jax.linsolve.graph import graph_of
from natcoord_jax.linsolve.multifrontal import Multifrontal
from natcoord_jax.linsolve.refinement import RefinedSolver

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
        return block_tridiagonal.plan(path, entries, tiles)
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
