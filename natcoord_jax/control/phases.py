"""Phases with systems of their own: joints close and open between them, as `nc.transfer` has it.

All systems have the same bodies, inputs and rotors, so that a node is a vector of one size in all phases; the
order of bodies, which that of joints decides, is that of the phase which ends there, and coordinates of
joints and unknowns of steps are filled up to the most that a phase has. A joint that closes takes its
bodies as they are: increments keep them together from then on, so that where they are now says where they
met.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.control.mesh import Phases
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.admissible_velocities import tangent
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.reading.transfer import (
    common_joints,
    held,
    in_layout,
    new_joints,
    rotor_names,
    with_coordinates_of,
)
from natcoord_jax.system import System

Systems = tuple[System, ...]
"""Systems of all phases; one: of all of them."""


def check_systems(systems: Systems, phases: Phases) -> None:
    """Refuse systems that are not those of one motion.

    Raises:
        ValueError: naming what is not the same in all of them.
    """
    if len(systems) not in (1, len(phases)):
        raise ValueError(
            f"there are {len(systems)} systems and {len(phases)} phases; pass one system, or one for each "
            "phase, with the steps of each as steps=(20, 20)"
        )
    first = systems[0]
    for number, other in enumerate(systems[1:], 2):
        for what, one, two in (
            ("bodies", sorted(first.structure.bodies), sorted(other.structure.bodies)),
            ("rotors", sorted(rotor_names(first)), sorted(rotor_names(other))),
            ("input channels, in their order,", list(first.structure.inputs), list(other.structure.inputs)),
        ):
            if one != two:
                raise ValueError(
                    f"the system of phase {number} has the {what} {two}, that of the first one {one}; give "
                    "all phases the same"
                )


def closed(systems: Systems, phase: int) -> Bool[np.ndarray, " joints"]:
    """Which joints of a phase a phase before it lacks: where they are, the motion says."""
    names = systems[phase].structure.joints
    before = [set(system.structure.joints) for system in systems[:phase]]
    return np.array([not all(name in known for known in before) for name in names], bool)


def kinds(systems: Systems) -> list[tuple[int, ...]]:
    """Phases whose systems differ in numbers only, together."""
    found: dict[Any, list[int]] = {}
    for phase, system in enumerate(systems):
        leaves, structure = jax.tree.flatten(system)
        found.setdefault((structure, tuple(map(np.shape, leaves))), []).append(phase)
    return [tuple(phases) for phases in found.values()]


def at_hand(systems: Systems, kind: tuple[int, ...], phase: Any, state: State) -> System:
    """The system of a phase at a state of its own: joints that have closed are where their bodies are.

    Args:
        systems: of all phases.
        kind: phases of systems of one structure.
        phase: one of these.
        state: in their layout.
    """
    here = 0 if len(kind) == 1 else jnp.searchsorted(jnp.array(kind), phase)
    system = jax.tree.map(lambda *x: x[0] if len(x) == 1 else jnp.stack(x)[here], *(systems[p] for p in kind))
    before, after = common_joints(systems[0], system)
    system = replace_fields(system, frames=system.frames.at[after].set(systems[0].frames[before]))
    table = np.stack([closed(systems, p) for p in kind])
    joints = np.flatnonzero(np.any(table, axis=0))
    if not joints.size:
        return system
    return held(system, rows_with_ground(state.q), joints, jnp.asarray(table[:, joints])[here])


def entered(systems: Systems, phase: int, state: State) -> tuple[System, State]:
    """The system of a phase and the state that it begins with, from that at the end of the phase before.

    What `nc.transfer` does, without its checks: rotors of the one are those of the other.
    """
    before, into = systems[phase - 1], systems[phase]
    moved, joints = in_layout(before, state, into, None), new_joints(before, into)
    into = at_hand(systems, (phase,), phase, moved)
    if not joints.size:
        return into, moved
    moved = with_coordinates_of(into, moved, joints, jnp.ones(joints.size, bool))
    return into, tangent(into, moved)


def like(systems: Systems, state: State, phase: int) -> State:
    """A state in the layout of a phase; its numbers say nothing."""
    return in_layout(systems[0], state, systems[phase], None) if phase else state


def most_counted(systems: Systems) -> int:
    """Largest number of joint coordinates."""
    return max(len(system.structure.coordinates) for system in systems)


def most_unknowns(systems: Systems) -> tuple[int, int]:
    """Largest number of unknowns of a step, and of rates among them."""
    structures = [system.structure for system in systems]
    return max(s.unknowns + s.multipliers for s in structures), max(s.unknowns for s in structures)


def places(systems: Systems, phases: Phases) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each step its phase, the number of its kind, and the phase that it enters, 0 if none."""
    number = np.repeat(np.arange(len(phases)), phases)
    kind = np.zeros(len(phases), int)
    for k, members in enumerate(kinds(systems)):
        kind[list(members)] = k
    enters, starts = np.zeros(number.size, int), np.cumsum((0, *phases))
    names = [(system.structure.joints, system.structure.coordinates) for system in systems]
    for phase in range(1, len(systems)):
        enters[starts[phase]] = phase if names[phase] != names[phase - 1] else 0
    return number, kind[number], enters


def rates_of(systems: Systems, phases: Phases, stages: int) -> Bool[np.ndarray, "steps n"]:
    """Which unknowns of each step are rates of free motions."""
    count, _ = most_unknowns(systems)
    own = [system.structure.unknowns for system in systems]
    rows = np.arange(stages * count) < stages * np.array(own)[:, None]
    return rows[np.repeat(np.arange(len(systems)), phases if len(systems) > 1 else sum(phases))]


def in_all_phases(systems: Systems, state: State, maps: tuple[Array, Array]) -> tuple[Array, Array]:
    """Tangent maps with room for the coordinates and the free motions of all phases, zero where it has none.

    Args:
        systems: of all phases.
        state: in the layout of its own.
        maps: see `tangent.tangent_maps`.
    """
    forth, back = maps
    if len(systems) == 1:
        return forth, back
    size, quick = 2 * state.q.size + state.coordinates.size, state.v.size + state.rates.size
    motions, counted = forth.shape[1] - quick, most_counted(systems) - state.coordinates.size
    more = most_unknowns(systems)[1] - motions
    rows = np.r_[:size, size + counted : forth.shape[0] + counted]
    columns = np.r_[:motions, motions + more : forth.shape[1] + more]
    whole = jnp.zeros((forth.shape[0] + counted, forth.shape[1] + more), forth.dtype)
    place = np.ix_(rows, columns)
    return whole.at[place].set(forth), whole.T.at[place[1].T, place[0].T].set(back)


def filled(x: Float[Array, "*k n"], count: int) -> Float[Array, "*k m"]:
    """An array with zeros behind along its last axis."""
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, count - x.shape[-1])])
