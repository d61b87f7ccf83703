"""From one system to another in the middle of a motion: joints that close, and joints that open."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import ground
from natcoord_jax.core.state import STATE, State
from natcoord_jax.mechanics.admissible_velocities import with_admissible_velocities
from natcoord_jax.mechanics.coordinates import coordinate_values, state_rates
from natcoord_jax.mechanics.impacts import untouched
from natcoord_jax.mechanics.violations import residuals
from natcoord_jax.model.model import SYSTEM, Model, SomeModel
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


def _check_parts(old: Model, new: Model, onto: State | None) -> None:
    """Bodies of the old system must be in the new one, and the other way round where no state has them.

    Joints of both must join the same bodies.

    Raises:
        ValueError: naming the bodies that are missing, or a joint that joins others.
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


def in_layout(old: Model, state: State, new: Model, onto: State | None) -> State:
    """A state by the names of another system; stored rates are those of rotors of the same name."""
    rest = [None] * 4 if onto is None else [onto.q, onto.v, onto.coordinates, onto.work]
    old_names, names = ([(n, row) for n in x.structure.bodies for row in range(4)] for x in (old, new))
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


GAP = 1e-9
"""Largest gap [m, -] of a joint that has closed, per unit of size."""


@checked(system=SYSTEM, state=STATE, into=SYSTEM, onto=STATE)
def transfer(
    system: Model, state: State, into: SomeModel, *, onto: State | None = None
) -> tuple[SomeModel, State]:
    """A state of one system as a state of another: joints may close and open in the middle of a motion.

    Both systems are compiled from scenes with the same bodies. What has the same name is the same: bodies
    keep their positions and velocities, joints of both their frames and coordinates, work accounts go on.

    A joint that only `into` has closes: it takes its two bodies as they are. The child has the frame that its
    scene gave it, the parent gets the same one at this pose, and coordinates count from here (44-47). An
    impact follows: of all velocities that the joints of `into` admit, the new ones are nearest to the old
    ones in the metric of the mass (rotors included), which is what impulsive reactions bring about. So
    momentum and angular momentum change by impulses of the ground only, and kinetic energy is lost, that of
    the difference: `system.energy(before).kinetic - into.energy(after).kinetic`. Bodies that meet at rest
    lose none. A joint that only `system` has opens, without any impulse.

    Args:
        system: of the state.
        state: one state.
        into: system to go on with.
        onto: state of `into`, for the bodies that `system` lacks, their joints, coordinates and accounts:
            so a part that has been treated by itself (an equilibrium, say) comes into the whole.

    Returns:
        `into` with the frames of its joints where they close, and its state, at the same time. Pure,
        jittable, differentiable; accounts and coordinates that `into` lacks are left behind.

    Raises:
        ValueError: for bodies that one of the systems lacks, a joint that joins other bodies than before, or
            one that cannot close where its bodies are (a distance has no length there).

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> def cars(coupled):
        ...     scene = nc.Scene()
        ...     first = scene.add(nc.RigidBody(mass=2.0, inertia=(1, 1, 1), velocity=(3, 0, 0), name="first"))
        ...     car = nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(5, 0, 0), name="second")
        ...     second = scene.add(car)
        ...     if coupled:
        ...         scene.add(nc.Fixed(first, second, name="coupling"))
        ...     return scene.compile(assemble=coupled)
        >>> system, state = cars(False)
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=15)
        >>> meeting = jax.tree.map(lambda x: x[-1], trajectory.states)
        >>> train, state = nc.transfer(system, meeting, cars(True)[0])
        >>> state.v[::4, 0].round(12).tolist()
        [2.0, 2.0]
        >>> float((state.q[4, 0] - state.q[0, 0]).round(12))
        0.5
    """
    _check_parts(system, into, onto)
    made, moved = _transferred(system, state, into, onto)
    names = {into.structure.joints[int(j)] for j in new_joints(system, into)}
    if names and is_concrete(made, moved):
        _check_closed(made, moved, names)
    return made, moved


@briefly
def _transferred(system: Model, state: State, into: SomeModel, onto: State | None) -> tuple[SomeModel, State]:
    before, after = common_joints(system, into)
    into = replace_fields(into, frames=into.frames.at[after].set(system.frames[before]))
    moved = in_layout(system, state, into, onto)
    joints = new_joints(system, into)
    if not joints.size:
        return into, moved
    # Those that touch a body of the old system.
    carried = np.array([name in system.structure.bodies for name in into.structure.bodies] + [False])
    closes = jnp.any(jnp.asarray(carried)[into.joint_bodies[joints]], axis=1)
    into = held(into, rows_with_ground(moved.q), joints, closes)
    moved = with_coordinates_of(into, moved, joints, closes)
    found = with_admissible_velocities(into, moved, _rates_before(system, into, moved))[0]
    return into, jax.tree.map(partial(jnp.where, jnp.any(closes)), found, moved)


def _rates_before(system: Model, into: Model, moved: State) -> Float[Array, " coordinates"]:
    """Rates of the coordinates before the impact, those that the rotors of both have had included."""
    known, rates = set(rotor_names(system)), state_rates(into, moved)
    for group in into.effects:
        if group.effect.rotors:
            stored = np.array([name in known for name in group.names])
            rates = rates.at[group.coordinates[stored, 0]].set(moved.rates[group.rotors[stored, 0]])
    return rates


def _check_closed(system: Model, state: State, names: set[str]) -> None:
    size = 1.0 + float(np.max(np.abs(np.asarray(state.q))))
    for group, value in zip(system.joints, residuals(system, state)):
        gaps = np.max(np.abs(np.asarray(value)), axis=1, initial=0.0)
        for name, gap in zip(group.names, gaps):
            if name in names and not gap <= GAP * size:
                raise ValueError(
                    f"joint {name!r} cannot close where its bodies are: its constraints are violated by "
                    f"{gap:.3g} m; bring the bodies to where it holds, or join them by another joint"
                )
