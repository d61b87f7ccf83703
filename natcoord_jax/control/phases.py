"""Phases with systems of their own: joints close and open between them, as `nc.transfer` has it.

All systems have the same bodies, inputs and rotors, so that a node is one vector in all phases; coordinates
of joints and unknowns of steps are filled up to the most that a phase has. A joint that closes takes its
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
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.reading.transfer import common_joints, held, in_layout, rotor_names, transfer
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
            ("bodies", first.structure.bodies, other.structure.bodies),
            ("input channels", first.structure.inputs, other.structure.inputs),
            ("rotors", tuple(rotor_names(first)), tuple(rotor_names(other))),
        ):
            if tuple(one) != tuple(two):
                raise ValueError(
                    f"the system of phase {number} has the {what} {list(two)}, that of the first one "
                    f"{list(one)}; give all phases the same, in the same order"
                )


def closed(systems: Systems, phase: int) -> np.ndarray:
    """Numbers of the joints of a phase that are not there in all phases before it: where they are is found."""
    names = systems[phase].structure.joints
    before = [set(system.structure.joints) for system in systems[:phase]]
    return np.array([k for k, name in enumerate(names) if not all(name in known for known in before)], int)


def at_hand(systems: Systems, phase: int, state: State) -> System:
    """The system of a phase at a state of its own: joints that have closed are where their bodies are."""
    joints, system = closed(systems, phase), systems[phase]
    if not phase:
        return system
    before, after = common_joints(systems[0], system)
    system = replace_fields(system, frames=system.frames.at[after].set(systems[0].frames[before]))
    if not joints.size:
        return system
    return held(system, rows_with_ground(state.q), joints, jnp.ones(joints.size, bool))


def entered(systems: Systems, phase: int, state: State) -> tuple[System, State]:
    """The system of a phase and the state that it begins with, from that at the end of the phase before."""
    found: Any = transfer(at_hand(systems, phase - 1, state), state, systems[phase])
    return found


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


def ways_of(systems: Systems, phases: Phases) -> np.ndarray:
    """Which of the ways to make a step each step takes: 2 p in phase p, but 2 p - 1 where it is entered."""
    found = np.repeat(2 * np.arange(len(phases)), phases)
    starts = np.cumsum((0, *phases))[1:-1]
    names = [(system.structure.joints, system.structure.coordinates) for system in systems]
    changed = [one != other for one, other in zip(names, names[1:])]
    found[starts[changed]] -= 1
    return found


def rates_of(systems: Systems, phases: Phases) -> Bool[np.ndarray, "steps n"]:
    """Which unknowns of each step are rates of free motions."""
    count, _ = most_unknowns(systems)
    own = [system.structure.unknowns for system in systems]
    rows = np.arange(count) < np.array(own)[:, None]
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


def switched(number: Any, ways: list[Any], *given: Any) -> Any:
    """One of the ways, by its number."""
    return ways[0](*given) if len(ways) == 1 else jax.lax.switch(number, ways, *given)
