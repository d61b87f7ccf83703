"""Equations of a step in the local null space with a sparse Jacobian: for large loops, frames and meshes.

The same equations as `FullStep`; their Jacobian stays in pieces, one matrix for each body and each instance
of an effect or joint, which a sparse solver puts together. The multipliers of a constraint belong to the node
of the deepest of its bodies. With more than one stage the Jacobian is a dense matrix, as that of `FullStep`.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.linsolve.blocks import BlockMatrix
from natcoord_jax.linsolve.sparse import SparseSolver, factorised, inertias_of, regularised
from natcoord_jax.mechanics.element_matrices import spreads, touches
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.model.model import Model


class SparseStep(FullStep):
    """One step with multipliers for every joint and a sparse Jacobian."""

    by_formulas = True

    @property
    def exact_by_formulas(self) -> bool:
        """Not with effects on many bodies, of which small parts are left out."""
        return not spreads(self.system)

    def factorised(self, matrix: Any) -> tuple[Any, Float[Array, " unknowns"]]:
        """Factors of a sparse matrix, of a dense one with several stages, and inertias of the unknowns."""
        if self.tableau.stages > 1:
            return super().factorised(matrix)
        matrix, products = matrix if spreads(self.system) else (matrix, ())
        whole = self._assembled(matrix)
        inertias = inertias_of(whole, self.balances)
        found: Any = factorised(self.system.sparsity.plan, regularised(whole, inertias))
        for product in products:
            found = product.around(found)
        return found, inertias

    def differentiable(self, matrix: Any) -> Any:
        """The same, refined and differentiable."""
        if self.tableau.stages > 1:
            return super().differentiable(matrix)
        # An approximate inverse: derivatives are those of the equation that the solution obeys.
        factors = jax.lax.stop_gradient(self.factorised(matrix)[0])
        return SparseSolver(self._assembled(matrix), factors, rounds=2)

    def _assembled(self, matrix: tuple[Array, ...]) -> BlockMatrix:
        """The sparse matrix of element matrices."""
        sparsity: Any = self.system.sparsity
        return sparsity.pattern.assemble(*matrix)

    def like_tangent(self, y: Float[Array, " unknowns"]) -> Any:
        """Shapes of the elements' matrices."""
        return super().like_tangent(y) if self.tableau.stages > 1 else jax.eval_shape(self.tangent, y)

    def jacobian(self, y: Float[Array, " unknowns"], *, exact: bool = True) -> Any:
        """Jacobian: matrices of the elements as `elements` lists them, and products, if there are any.

        With several stages, dense.
        """
        if self.tableau.stages > 1:
            return super().jacobian(y, exact=exact)
        matrices, products = tuple(self.matrices(y, exact)), self.products(y)
        return (matrices, products) if products else matrices


def nodes_of(system: Model) -> np.ndarray:
    """Node of each unknown, for one stage: of multipliers the deepest of their bodies; on the host."""
    bodies, nodes = len(system.structure.bodies), [system.local_rates.nodes()]
    for group in (*system.effects, *system.joints):
        if touches(group):
            # Bodies are numbered from the root: the deepest has the largest number.
            table = np.asarray(group.bodies)
            nodes.append(np.repeat(np.where(table < bodies, table, 0).max(axis=1), group.multipliers))
    return np.concatenate(nodes)
