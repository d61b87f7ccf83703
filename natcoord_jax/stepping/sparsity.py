"""What a sparse solver needs to know of a system, found once when it is compiled."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.blocks import BlockMatrix, BlockPattern, block_pattern
from natcoord_jax.linsolve.saddle import inertias_of, regularised
from natcoord_jax.linsolve.sparse import Plan, choose
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.element_matrices import elements
from natcoord_jax.mechanics.sparse import SparseStep, nodes_of
from natcoord_jax.mechanics.start_cache import NOTHING, StartCache
from natcoord_jax.system import System

FAR = 1e30  # [N s] a pull that no contact bears, whatever its gap


class Sparsity(eqx.Module):
    """Pattern of the Jacobian and plan of its elimination."""

    pattern: BlockPattern
    plan: Plan


def with_sparsity(system: System, state: State) -> System:
    """The system with the plan for its sparse Jacobian, rehearsed at its initial state."""
    pattern, entries = block_pattern(nodes_of(system), [np.asarray(x) for x in elements(system)])
    matrices = _resting(system, state, pattern) if is_concrete(system, state) else []
    return replace_fields(system, sparsity=Sparsity(pattern, choose(pattern, entries, matrices=matrices)))


@briefly
def _resting(system: System, state: State, pattern: BlockPattern) -> list[BlockMatrix]:
    """Of a vanishing step, its inertias and constraints: with inequalities held, and with none held."""
    zero = jnp.zeros((), state.q.dtype)
    inputs = jnp.zeros(len(system.structure.inputs), state.q.dtype)
    start_cache: StartCache = NOTHING
    equations = SparseStep.prepare(system, state, inputs, zero, gauss(1), start_cache)
    held = equations.guess()
    _, multipliers = equations.split(jnp.arange(held.size, dtype=held.dtype))
    open_ = [x[:, 0, 0].astype(int) for g, x in zip(equations.groups, multipliers) if g.effect.unilateral]
    guesses = [held, *([held.at[jnp.concatenate(open_)].set(-FAR)] if open_ else [])]
    found = [pattern.assemble(*equations.matrices(y, exact=True)) for y in guesses]
    return [regularised(matrix, inertias_of(matrix, equations.balances)) for matrix in found]
