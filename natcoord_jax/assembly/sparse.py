"""Equations of a step in the local null space with a sparse Jacobian: for large loops, frames and meshes.

The same equations as `FullStep`; their Jacobian stays in pieces, one matrix for each body and each instance
of an effect or joint, which a sparse solver puts together. The multipliers of a constraint belong to the node
of the deepest of its bodies. With more than one stage the Jacobian is a dense matrix, as that of `FullStep`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.full import FullStep
from natcoord_jax.assembly.local import jacobians
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.linsolve.blocks import BlockMatrix
from natcoord_jax.linsolve.saddle import inertias_of, regularised
from natcoord_jax.linsolve.sparse import SparseSolver, factorised

RATES = 6  # of a body


class SparseStep(FullStep):
    """One step with multipliers for every joint and a sparse Jacobian."""

    by_formulas = True

    def factorised(self, matrix: Any) -> tuple[Any, Float[Array, " unknowns"]]:
        """Factors of a sparse matrix, of a dense one with several stages, and inertias of the unknowns."""
        if self.tableau.stages > 1:
            return super().factorised(matrix)
        whole = self._assembled(matrix)
        inertias = inertias_of(whole, self.balances)
        return factorised(self.system.sparsity.plan, regularised(whole, inertias)), inertias

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

    def tangent(self, y: Float[Array, " unknowns"], loads: Any = None) -> Array | tuple[Array, ...]:
        """The Jacobian nearly, from linearised effects: what Newton's iteration needs."""
        return self.jacobian(y, exact=False)

    def jacobian(self, y: Float[Array, " unknowns"], *, exact: bool = True) -> Array | tuple[Array, ...]:
        """Jacobian: matrices of the elements as `elements` lists them; with several stages, dense."""
        if self.tableau.stages > 1:
            return super().jacobian(y, exact=exact)
        twists, multipliers = self.split(y)
        every = self._with_ground(twists)
        found = [self.body_jacobians(twists)]
        for group, where, lam in zip(self.groups, self.situations, multipliers):
            if not _touches(group):
                continue
            (by_twist, by_lam), (g_by_twist, _) = jacobians(
                group, where, self.tableau, self.start[group.bodies], every[group.bodies], lam, exact=exact
            )
            count, m = group.count, group.multipliers
            width = RATES * group.bodies.shape[1]
            above = [-by_twist.reshape(count, width, width), -by_lam.reshape(count, width, m)]
            below = [g_by_twist.reshape(count, m, width), jnp.zeros((count, m, m), y.dtype)]
            found.append(
                jnp.concatenate([jnp.concatenate(above, axis=2), jnp.concatenate(below, axis=2)], axis=1)
            )
        return tuple(found)


def _touches(group: Group) -> bool:
    return group.count > 0 and group.bodies.shape[1] > 0


def elements(system: System) -> tuple[np.ndarray, list[np.ndarray]]:
    """Node of each unknown, and the unknowns that each element touches, for one stage; on the host.

    Args:
        system: compiled system.

    Returns:
        Nodes (n,), and an array (count, width) of unknowns for the bodies and for each group with bodies, in
        the order of `SparseStep.jacobian`; n stands for the ground.
    """
    groups = (*system.effects, *system.joints)
    bodies = len(system.structure.bodies)
    first = RATES * bodies
    size = first + sum(g.count * g.multipliers for g in groups)
    number = np.arange(first).reshape(bodies, RATES)
    rates = np.concatenate([number, np.full((1, RATES), size)])
    nodes, found = [np.repeat(np.arange(bodies), RATES)], [number]
    for group in groups:
        count, m = group.count, group.multipliers
        if not _touches(group):
            continue
        table = np.asarray(group.bodies)
        lams = first + np.arange(count * m).reshape(count, m)
        first += count * m
        # Bodies are numbered from the root: the deepest has the largest number.
        deepest = np.where(table < bodies, table, 0).max(axis=1)
        nodes.append(np.repeat(deepest, m))
        found.append(np.concatenate([rates[table].reshape(count, -1), lams], axis=1))
    return np.concatenate(nodes), found
