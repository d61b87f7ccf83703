"""What a sparse solver needs to know of a system, found once when it is compiled."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.outset import Outset
from natcoord_jax.assembly.reduced import NOTHING
from natcoord_jax.assembly.sparse import SparseStep, elements
from natcoord_jax.assembly.system import System
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.blocks import BlockMatrix, BlockPattern, block_pattern
from natcoord_jax.linsolve.sparse import Plan, choose
from natcoord_jax.maths.collocation import gauss

SHIFT = 1e-10  # diagonal of the constraint rows in units of the matrix, as in `dense.saddle_inverse`


class Sparsity(eqx.Module):
    """Pattern of the Jacobian and plan of its elimination."""

    pattern: BlockPattern
    plan: Plan


def with_sparsity(system: System, state: State) -> System:
    """The system with the plan for its sparse Jacobian, rehearsed at its initial state."""
    nodes, found = elements(system)
    pattern, entries = block_pattern(nodes, found)
    matrix = None
    if is_concrete(system, state):
        matrix = _resting(system, state, pattern)
    return replace_fields(system, sparsity=Sparsity(pattern, choose(pattern, entries, matrix=matrix)))


@jax.jit
def _resting(system: System, state: State, pattern: BlockPattern) -> BlockMatrix:
    """The matrix for a vanishing step: inertias and constraints."""
    zero = jnp.zeros((), state.q.dtype)
    inputs = jnp.zeros(len(system.structure.inputs), state.q.dtype)
    outset: Outset = NOTHING
    equations = SparseStep.prepare(system, state, inputs, zero, gauss(1), outset)
    matrix = pattern.assemble(*equations.jacobian(equations.guess()))
    return regularised(matrix, inertias_of(matrix, equations.balances))


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


def assembled(equations: Any, locals_: tuple[Array, ...]) -> BlockMatrix:
    """The sparse matrix of element matrices."""
    return equations.system.sparsity.pattern.assemble(*locals_)
