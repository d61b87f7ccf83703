"""What two systems have in common by name, and a state of one in the layout of the other."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import ground
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.coordinates import coordinate_values
from natcoord_jax.mechanics.impacts import untouched
from natcoord_jax.model.model import Model, SomeModel
from natcoord_jax.model.rows import rows_with_ground


def _merged(
    names: Sequence[Any], old_names: Sequence[Any], old: Array, onto: Array | None
) -> Float[Array, "names *rest"]:
    """Values by name from the old ones, where these have none from `onto`, else zero."""
    place = {name: k for k, name in enumerate(old_names)}
    found = jnp.zeros((len(names), *old.shape[1:]), old.dtype) if onto is None else onto
    here = np.array([i for i, name in enumerate(names) if name in place], int)
    there = np.array([place[names[i]] for i in here], int)
    return found.at[here].set(old[there])


def check_bodies(old: Model, new: Model, onto: State | None) -> None:
    """Bodies of the old system must be in the new one, and the other way round where no state has them.

    Raises:
        ValueError: naming the bodies that are missing.
    """
    before, after = set(old.structure.bodies), set(new.structure.bodies)
    if before - after:
        raise ValueError(
            f"the new system has no bodies {sorted(before - after)}; keep every body of the old system, or "
            "leave out what carries it"
        )
    if onto is None and after - before:
        raise ValueError(
            f"the old state says nothing of the bodies {sorted(after - before)}; pass a state of the new "
            "system that has them as `onto`"
        )


def common_joints(old: Model, new: Model) -> tuple[np.ndarray, np.ndarray]:
    """Numbers, in the old and in the new system, of the joints that both have."""
    place = {name: k for k, name in enumerate(old.structure.joints) if name}
    pairs = [(place[name], k) for k, name in enumerate(new.structure.joints) if name in place]
    table = np.array(pairs, int).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def new_joints(old: Model, new: Model) -> np.ndarray:
    """Numbers of the joints that only the new system has."""
    known = {*old.structure.joints, ""}
    return np.array([k for k, name in enumerate(new.structure.joints) if name not in known], int)


def check_joints(old: Model, new: Model) -> None:
    """Joints of both systems must join the same bodies; looks at concrete systems only.

    Raises:
        ValueError: naming a joint that does not.
    """
    if not is_concrete(old.joint_bodies, new.joint_bodies):
        return
    pairs = []
    for system, numbers in zip((old, new), common_joints(old, new)):
        names = (*system.structure.bodies, ground.name)
        ends = np.asarray(system.joint_bodies)[numbers]
        pairs.append([(system.structure.joints[j], names[a], names[b]) for j, (a, b) in zip(numbers, ends)])
    for before, after in zip(*pairs):
        if before != after:
            raise ValueError(
                f"joint {before[0]!r} joins {before[1:]} in the old system and {after[1:]} in the new one; "
                "give the new joint another name"
            )


def taking_hold(old: Model, new: Model, joints: np.ndarray) -> Bool[Array, " joints"]:
    """Which joints of the new system touch a body of the old one."""
    carried = np.array([name in old.structure.bodies for name in new.structure.bodies] + [False])
    return jnp.any(jnp.asarray(carried)[new.joint_bodies[joints]], axis=1)


def in_layout(old: Model, state: State, new: Model, onto: State | None) -> State:
    """A state by the names of another system; stored rates are those of rotors of the same name."""
    rest = [None] * 4 if onto is None else [onto.q, onto.v, onto.coordinates, onto.work]
    names = [(name, row) for name in new.structure.bodies for row in range(4)]
    old_names = [(name, row) for name in old.structure.bodies for row in range(4)]
    rates = onto.rates if onto is not None else jnp.zeros(new.structure.rotors, state.q.dtype)
    return State(
        state.t,
        _merged(names, old_names, state.q, rest[0]),
        _merged(names, old_names, state.v, rest[1]),
        _merged(new.structure.coordinates, old.structure.coordinates, state.coordinates, rest[2]),
        _merged(rotor_names(new), rotor_names(old), state.rates, rates),
        _merged(new.structure.works, old.structure.works, state.work, rest[3]),
        state.dissipated,
        contacts=untouched(new) if onto is None else onto.contacts,
    )


def rotor_names(system: Model) -> list[str]:
    """Names of the effects with stored rates; groups own consecutive pieces of them, in order."""
    return [name for group in system.effects if group.effect.rotors for name in group.names]


def held(
    system: SomeModel, rows: Float[Array, "bodies_and_ground 4 3"], joints: np.ndarray, closes: Array
) -> SomeModel:
    """The system with joints that close at given rows: the parent's frame is where the child's is."""
    bodies = system.joint_bodies[joints]

    def frame(place: Float[Array, "2 4 4"], closes: Array, parent: Array, child: Array) -> Array:
        point, *axes = place[1] @ child
        local = jnp.stack([point - parent[0], *axes]) @ parent[1:].T
        there = jnp.concatenate([place[1, :, :1], local], axis=1)
        return place.at[0].set(jnp.where(closes, there, place[0]))

    moved = jax.vmap(frame)(system.frames[joints], closes, rows[bodies[:, 0]], rows[bodies[:, 1]])
    return replace_fields(system, frames=system.frames.at[joints].set(moved))


def with_coordinates_of(system: Model, state: State, joints: np.ndarray, closes: Array) -> State:
    """The state with the coordinates of joints that close read off its positions."""
    number = {system.structure.joints[j]: k for k, j in enumerate(joints)}
    owners = [(i, number[name]) for i, (name, _) in enumerate(system.structure.coordinates) if name in number]
    if not owners:
        return state
    places, own = np.array(owners).T
    values = coordinate_values(system, rows_with_ground(state.q))[places]
    counted = jnp.where(closes[own], values, state.coordinates[places])
    return replace_fields(state, coordinates=state.coordinates.at[places].set(counted))
