"""Which linear solver goes with which form of the equations."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.linsolve import neighbours, tree
from natcoord_jax.linsolve.dense import DenseSolver, Inverse, saddle_inverse
from natcoord_jax.linsolve.sparse import SparseSolver, factorised
from natcoord_jax.stepping.sparsity import assembled, inertias_of, regularised


def _dense(equations: Any, matrix: Array) -> tuple[Inverse, Array]:
    """Inverse of a dense matrix, and the inertias of the unknowns (0 for multipliers)."""
    inertias = equations.inertias(matrix)
    every = jnp.zeros(matrix.shape[0], matrix.dtype).at[: inertias.shape[0]].set(inertias)
    return Inverse(saddle_inverse(matrix, inertias)), every


def dense_differentiable(equations: Any, matrix: Array) -> DenseSolver:
    """Dense solver for derivatives."""
    inverse = saddle_inverse(matrix, equations.inertias(matrix))
    return DenseSolver(matrix, inverse, equations.balances)


class _ByNode(eqx.Module):
    """A solver on nodes of a tree, for flat vectors."""

    layout: Any
    solver: Any

    def solve(self, right: Array) -> Array:
        """Solution for a flat right-hand side."""
        return self.layout.flat(self.solver.solve(self.layout.nodes(right)))

    def transpose(self) -> "_ByNode":
        """Solver of the transposed matrix."""
        return _ByNode(self.layout, self.solver.transpose())


def _by_node(equations: Any, blocks: tuple) -> tuple[Any, Any]:
    """A matrix in blocks, by what couples its nodes, and its factorisation."""
    following = equations.system.tree.neighbour
    if len(blocks) == 3:
        own, above, below = blocks
        return neighbours.NeighbourBlocks(own, above, below, following), neighbours.factor
    own, spread, gather, rest = blocks
    return tree.TreeBlocks(own, spread, gather, rest, following, equations.layout.rates), tree.factor


def _recursive(equations: Any, blocks: tuple) -> tuple[_ByNode, Array]:
    """Factors along the tree, and the inertias of the unknowns (0 for multipliers)."""
    layout = equations.layout
    matrix, factor = _by_node(equations, blocks)
    factors, diagonal = factor(matrix)
    inertias = layout.flat(jnp.abs(diagonal)).at[equations.balances :].set(0.0)
    return _ByNode(layout, factors), inertias


def _recursive_differentiable(equations: Any, blocks: tuple) -> _ByNode:
    matrix, factor = _by_node(equations, blocks)
    return _ByNode(equations.layout, tree.RefinedSolver(matrix, factor(matrix)[0]))


def _sparse(equations: Any, matrix: Any) -> tuple[Any, Array]:
    """Factors of a sparse matrix, and the inertias of the unknowns; of a dense one with several stages."""
    if equations.tableau.stages > 1:
        return _dense(equations, matrix)
    whole = assembled(equations, matrix)
    inertias = inertias_of(whole, equations.balances)
    return factorised(equations.system.sparsity.plan, regularised(whole, inertias)), inertias


def _sparse_differentiable(equations: Any, matrix: Any) -> Any:
    if equations.tableau.stages > 1:
        return dense_differentiable(equations, matrix)
    whole = assembled(equations, matrix)
    return SparseSolver(whole, jax.lax.stop_gradient(_sparse(equations, matrix)[0]), rounds=2)


FACTORISATIONS: dict[str, Callable[[Any, Any], tuple[Any, Array]]] = {
    "reduced": _dense,
    "full": _dense,
    "recursive": _recursive,
    "sparse": _sparse,
}
"""Factorisations for Newton's iteration, by form of the equations."""

DIFFERENTIABLE: dict[str, Callable[[Any, Any], Any]] = {
    "reduced": dense_differentiable,
    "full": dense_differentiable,
    "recursive": _recursive_differentiable,
    "sparse": _sparse_differentiable,
}
"""Solvers whose solutions are differentiable in every mode, by form of the equations."""


def differentiable_solver(equations: Any, matrix: Any) -> Any:
    """The solver for the derivative of a step's solution."""
    return DIFFERENTIABLE[equations.system.structure.solver](equations, matrix)
