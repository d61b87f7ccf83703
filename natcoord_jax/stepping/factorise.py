"""Which linear solver goes with which form of the equations."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.linsolve.dense import DenseSolver, Inverse, saddle_inverse


def _dense(equations: Any, matrix: Array) -> tuple[Inverse, Array]:
    """Inverse of a dense matrix, and the inertias of the unknowns (0 for multipliers)."""
    inertias = jnp.abs(jnp.diagonal(matrix)).at[equations.balances :].set(0.0)
    return Inverse(saddle_inverse(matrix, equations.balances)), inertias


def dense_differentiable(equations: Any, matrix: Array) -> DenseSolver:
    """Dense solver for derivatives."""
    return DenseSolver(matrix, saddle_inverse(matrix, equations.balances), equations.balances)


FACTORISATIONS: dict[str, Callable[[Any, Any], tuple[Any, Array]]] = {"reduced": _dense, "full": _dense}
"""Factorisations for Newton's iteration, by form of the equations."""

DIFFERENTIABLE: dict[str, Callable[[Any, Any], Any]] = {
    "reduced": dense_differentiable,
    "full": dense_differentiable,
}
"""Solvers whose solutions are differentiable in every mode, by form of the equations."""


def differentiable_solver(equations: Any, matrix: Any) -> Any:
    """The solver for the derivative of a step's solution."""
    return DIFFERENTIABLE[equations.system.structure.solver](equations, matrix)
