"""What a system is given before it runs: an admissible start, its rank, and the pattern of its matrices."""

import dataclasses
import warnings

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.model.choice import dense_solver
from natcoord_jax.stepping.admissibility import (
    admitted,
    check_gaps,
    check_inertia,
    find_redundancy,
    project_velocities,
)
from natcoord_jax.stepping.sparsity import with_sparsity
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
        return _with_pattern(system, state), state
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
    notes = size_notes(system)
    for note in notes:
        warnings.warn(note, stacklevel=4)
    structure = dataclasses.replace(
        structure,
        dofs=structure.unknowns - rank,
        redundant=redundant,
        notes=notes,
        rank=rank if redundant else None,
    )
    system = replace_fields(system, structure=structure)
    return _with_pattern(system, state), state


def _with_pattern(system: System, state: State) -> System:
    return with_sparsity(system, state) if system.structure.solver == "sparse" else system


def size_notes(system: System) -> tuple[str, ...]:
    """Warnings about the cost of a system."""
    structure = system.structure
    unknowns = 6 * len(structure.bodies) + sum(g.count * g.multipliers for g in system.joints)
    if structure.solver == "full" and unknowns > DENSE_LIMIT:
        return (
            f"{unknowns} unknowns in loops or couplings across the tree are solved densely: time per step "
            "grows with the third power of their number",
        )
    return ()
