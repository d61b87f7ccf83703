"""What a system is given before it runs: an admissible start, its rank, and the pattern of its matrices."""

import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.blocks import BlockMatrix, BlockPattern, block_pattern
from natcoord_jax.linsolve.sparse import Plan, choose, inertias_of, regularised
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.element_matrices import elements
from natcoord_jax.mechanics.sparse import SparseStep, nodes_of
from natcoord_jax.mechanics.start_cache import NOTHING, StartCache
from natcoord_jax.model.choice import dense_solver
from natcoord_jax.stepping.admissibility import (
    admitted,
    check_gaps,
    check_inertia,
    find_redundancy,
    project_velocities,
)
from natcoord_jax.system import System

DENSE_LIMIT = 300
"""Unknowns beyond which a dense solution is worth a warning."""


def prepared(system: System, state: State, *, assembled: bool, chosen: str | None) -> tuple[System, State]:
    """A system that was built and its initial state, checked, with its rank and pattern.

    Args:
        system: as it was built.
        state: initial state.
        assembled: whether it was projected onto the constraints; otherwise a gap is refused, and velocities
            that do not obey them are projected.
        chosen: form of the equations that is asked for.

    Raises:
        ValueError: for a gap in a joint, or a body without inertia along a free motion.
    """
    if not is_concrete(system, state):
        state = state if assembled else admitted(system, state)
        structure = system.structure
        if structure.held and structure.solver != "sparse":
            # Which constraints depend on others is decided as it runs.
            structure = dataclasses.replace(structure, rank=structure.held)
        system = replace_fields(system, structure=structure)
        return with_sparsity(system, state), state
    check_inertia(system, state)
    if not assembled:
        check_gaps(system, state)
        state = project_velocities(system, state)
    rank, redundant = find_redundancy(system, state)
    structure = system.structure
    if redundant and chosen in (None, "sparse"):
        # Dependent constraints are projected out of a dense matrix, the smallest one if there is a choice.
        solver = dense_solver(system.effects, system.mass_between is not None)
        structure = dataclasses.replace(structure, solver=solver)
        system = replace_fields(system, structure=structure)
    notes, unknowns = (), 6 * len(structure.bodies) + sum(g.count * g.multipliers for g in system.joints)
    if structure.solver == "full" and unknowns > DENSE_LIMIT:
        notes = (
            f"{unknowns} unknowns in loops or couplings across the tree are solved densely: time per step "
            "grows with the third power of their number",
        )
        warnings.warn(notes[0], stacklevel=4)
    structure = dataclasses.replace(
        structure,
        dofs=structure.unknowns - rank,
        redundant=redundant,
        notes=notes,
        rank=rank if redundant else None,
    )
    system = replace_fields(system, structure=structure)
    return with_sparsity(system, state), state


FAR = 1e30  # [N s] a pull that no contact bears, whatever its gap


class Sparsity(eqx.Module):
    """Pattern of the Jacobian and plan of its elimination."""

    pattern: BlockPattern
    plan: Plan


def with_sparsity(system: System, state: State) -> System:
    """The system with the plan for its Jacobian, if that is sparse, rehearsed at its initial state."""
    if system.structure.solver != "sparse":
        return system
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
