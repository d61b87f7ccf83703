"""Which linear solver goes with which form of the equations."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.linsolve.dense import DenseSolver, Inverse, saddle_inverse
from natcoord_jax.linsolve.tree import TreeBlocks, TreeSolver, factor


def _dense(equations: Any, matrix: Array) -> tuple[Inverse, Array]:
    """Inverse of a dense matrix, and the inertias of the unknowns (0 for multipliers)."""
    inertias = jnp.abs(jnp.diagonal(matrix)).at[equations.balances :].set(0.0)
    return Inverse(saddle_inverse(matrix, equations.balances)), inertias


def dense_differentiable(equations: Any, matrix: Array) -> DenseSolver:
    """Dense solver for derivatives."""
    return DenseSolver(matrix, saddle_inverse(matrix, equations.balances), equations.balances)


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


class _TreeLayout(eqx.Module):
    """The part of the equations that knows where unknowns sit; numbers of the step are left out."""

    slots: Array
    places: Array
    width: int = eqx.field(static=True)

    def nodes(self, y: Array) -> Array:
        """Flat vector by node."""
        bodies = self.slots.shape[0]
        twists = y[: bodies * self.width].reshape(bodies, self.width)
        padded = jnp.concatenate([y[bodies * self.width :], jnp.zeros(1, y.dtype)])
        return jnp.concatenate([twists, padded[self.slots]], axis=1)

    def flat(self, nodes: Array) -> Array:
        """The inverse of `nodes`."""
        multipliers = nodes[:, self.width :].reshape(-1)[self.places]
        return jnp.concatenate([nodes[:, : self.width].reshape(-1), multipliers])


def _tree_layout(equations: Any) -> _TreeLayout:
    elimination = equations.system.elimination
    return _TreeLayout(elimination.slots, elimination.places, 6 * equations.tableau.stages)


def _tree_blocks(equations: Any, blocks: tuple) -> TreeBlocks:
    system = equations.system
    diagonal, up, down = blocks
    return TreeBlocks(diagonal, up, down, system.tree.parent)


def _recursive(equations: Any, blocks: tuple) -> tuple[_ByNode, Array]:
    """Factors along the tree, and the inertias of the unknowns (0 for multipliers)."""
    layout = _tree_layout(equations)
    inertias = jnp.abs(jnp.diagonal(blocks[0], axis1=1, axis2=2))
    flat = layout.flat(inertias).at[equations.balances :].set(0.0)
    return _ByNode(layout, factor(_tree_blocks(equations, blocks))), flat


def _recursive_differentiable(equations: Any, blocks: tuple) -> _ByNode:
    matrix = _tree_blocks(equations, blocks)
    return _ByNode(_tree_layout(equations), TreeSolver(matrix, factor(matrix)))


FACTORISATIONS: dict[str, Callable[[Any, Any], tuple[Any, Array]]] = {
    "reduced": _dense,
    "full": _dense,
    "recursive": _recursive,
}
"""Factorisations for Newton's iteration, by form of the equations."""

DIFFERENTIABLE: dict[str, Callable[[Any, Any], Any]] = {
    "reduced": dense_differentiable,
    "full": dense_differentiable,
    "recursive": _recursive_differentiable,
}
"""Solvers whose solutions are differentiable in every mode, by form of the equations."""


def differentiable_solver(equations: Any, matrix: Any) -> Any:
    """The solver for the derivative of a step's solution."""
    return DIFFERENTIABLE[equations.system.structure.solver](equations, matrix)
