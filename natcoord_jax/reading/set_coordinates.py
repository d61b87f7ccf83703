"""Setting joint coordinates and rates in a state, and random valid states."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.state import STATE, State, Trajectory
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import cross, safe_divide
from natcoord_jax.mechanics.coordinates import (
    coordinate_rates,
    coordinate_values,
    frames_of,
    stage_rates,
    state_rates,
)
from natcoord_jax.mechanics.rates import carried, null_space, tree_rates, twists
from natcoord_jax.mechanics.response import stations
from natcoord_jax.mechanics.sweeps import sweep_motion
from natcoord_jax.model.model import SYSTEM, Model
from natcoord_jax.model.rows import row_rates, rows_with_ground, states_of
from natcoord_jax.model.tree import gather_slots
from natcoord_jax.reading.sensors import joint_coordinates, rates_of
from natcoord_jax.reading.tangent_states import Source

DEVIATION = Number("not negative")
KEY = of("a random key, jax.random.key(0)", jax.Array)


def _place(system: Model, joint: Handle | str, index: int) -> tuple[int, np.ndarray]:
    """Number of a joint and the places of its coordinates in the state; checks the index."""
    number, places, _ = joint_coordinates(system, joint)
    if not 0 <= index < len(places):
        name = system.structure.joints[number]
        known = f"{len(places)} coordinates, no number {index}"
        raise ValueError(f"joint {name!r} has {known}; they count from 0")
    return number, np.array(places)


def coordinate(
    system: Model, motion: State | Trajectory, joint: Handle | str, index: int = 0
) -> Float[Array, "*t"]:
    """Coordinate of a joint [rad, counted on over many turns, or m]; see `System.coordinate`."""
    _, places = _place(system, joint, index)
    return states_of(motion).coordinates[..., int(places[index])]


def rate(
    system: Model, motion: State | Trajectory, joint: Handle | str, index: int = 0
) -> Float[Array, "*t"]:
    """Rate of a joint coordinate [rad/s or m/s]; see `System.rate`."""
    _, places = _place(system, joint, index)
    return rates_of(Source.of(system, motion))[..., int(places[index])]


def _joint_motions(
    system: Model, rows: Float[Array, "bodies 4 3"], body: int, places: np.ndarray
) -> tuple[Array, Array, Array, Array]:
    """Unit motions of the slots of one tree joint.

    Returns:
        Rates of the joint's coordinates (n, 7), velocity and angular velocity of the body (7, 3) each, and
        the place of each slot among the unknowns (7,).
    """
    velocities, spins = null_space(system, rows)
    slots = jnp.asarray(system.tree.slot_index)[body]
    extended, still = rows_with_ground(rows.reshape(-1, 3)), jnp.zeros((1, 3), rows.dtype)

    def unit(slot):
        velocity, spin = (x.at[:, slot].get(mode="fill", fill_value=0.0) for x in (velocities, spins))
        moving = jnp.concatenate([row_rates(rows, velocity, spin), jnp.zeros((1, *NODE), rows.dtype)])
        rates = coordinate_rates(system, extended, moving, jnp.concatenate([spin, still]))
        return rates[places], velocity[body], spin[body]

    rates, velocity, spin = jax.vmap(unit)(slots)
    return rates.T, velocity, spin, slots


def _with_relations(system: Model, places: np.ndarray, index: int, change: Array) -> Float[Array, " n"]:
    """Changes of all coordinates of a joint when one changes, so that a relation among them still holds.

    The pitch relation of a screw is such a relation; relations that involve other joints are left alone.
    """
    changes = jnp.zeros(len(places)).at[index].set(change)
    others = np.delete(np.arange(len(places)), index)
    for group in system.effects:
        if group.multipliers and group.source == "coordinates" and others.size:
            factors = jax.vmap(lambda e: e.coefficients())(group.effect)
            every = jnp.zeros((group.count, len(system.structure.coordinates)))
            every = every.at[jnp.arange(group.count)[:, None], group.coordinates].add(factors)
            here = every[:, places]
            elsewhere = jnp.sum(jnp.abs(every), axis=1) - jnp.sum(jnp.abs(here), axis=1)
            free = jnp.where((elsewhere == 0)[:, None], here[:, others], 0.0)
            shares = safe_divide(here[:, index], jnp.sum(free**2, axis=1))
            changes = changes.at[others].add(-change * (shares @ free))
    return changes


def _slot_rates(rates: Float[Array, "n 7"], wanted: Float[Array, " n"]) -> Float[Array, "7"]:
    """Smallest slot rates that give the coordinates the wanted rates."""
    return rates.T @ jnp.linalg.solve(rates @ rates.T, wanted)


def _moved_coordinates(
    system: Model, before: Array, after: Array, coordinates: Array, places: np.ndarray
) -> Array:
    """Coordinates of other joints (those that close loops) follow, angles by less than half a turn."""
    start, end = (coordinate_values(system, rows_with_ground(x.reshape(-1, 3))) for x in (before, after))
    change = end - start
    for group in system.coordinates:
        if group.axis.unit == "rad":
            turn = change[group.index]
            change = change.at[group.index].set(turn - 2 * jnp.pi * jnp.round(turn / (2 * jnp.pi)))
    kept = np.isin(np.arange(coordinates.shape[0]), places)
    return jnp.where(kept, coordinates, coordinates + change)


def _rotors(system: Model, rates: Array, state: State, places: np.ndarray) -> Float[Array, " rotors"]:
    """Stored rotor rates with those on some coordinates replaced by the rates of the coordinates."""
    stored = state.rates
    for group in system.effects:
        if group.effect.rotors:
            at, on = group.rotors[:, 0], jnp.asarray(group.coordinates)[:, 0]
            stored = stored.at[at].set(jnp.where(jnp.isin(on, places), rates[on], stored[at]))
    return stored


def _moved(
    system: Model, state: State, body: int, places: np.ndarray, changes: Array
) -> Float[Array, "bodies 4 3"]:
    """Rows after the subtree beyond a tree joint has been turned and shifted by changes of its coordinates.

    The turn is about the joint's point on its child, so that displacements along axes of the parent stay.
    """
    rows = state.rows
    rates, velocities, spins, _ = _joint_motions(system, rows, body, places)
    slots = _slot_rates(rates, changes)
    turn, shift = slots @ spins, slots @ velocities
    _, child = frames_of(system, jnp.array([body]), rows_with_ground(state.q))
    pivot = child.point[0]
    shift = shift + cross(turn, pivot - rows[body, 0])
    rotation = from_rotation_vector(turn)
    turned = jnp.einsum("ij,brj->bri", rotation, rows.at[:, 0].add(-pivot))
    moved = turned.at[:, 0].add(pivot + shift)
    return jnp.where((carried(system)[:, body] > 0)[:, None, None], moved, rows)


def with_coordinate(
    system: Model, state: State, joint: Handle | str, value: Any, *, rate: Any = None, index: int = 0
) -> State:
    """State with a joint coordinate set; see `System.with_coordinate`."""
    body, places = _place(system, joint, index)
    bodies = len(system.structure.bodies)
    if body >= bodies:
        raise ValueError(
            f"joint {system.structure.joints[body]!r} closes a loop: its coordinates follow from the "
            "others. Set those of the other joints of the loop and project with nc.assemble(system, state)"
        )
    rate = None if rate is None else as_array(rate, float)
    return _with_coordinate(system, state, body, tuple(places.tolist()), index, as_array(value, float), rate)


@eager_numpy
def _with_coordinate(
    system: Model, state: State, body: int, at: tuple[int, ...], index: int, value: Array, rate: Array | None
) -> State:
    places = np.array(at, int)
    w = tree_rates(system, state)
    change = _with_relations(system, places, index, value - state.coordinates[places[index]])
    rows = _moved(system, state, body, places, change)
    coordinates = state.coordinates.at[places].add(change).at[places[index]].set(value)
    coordinates = _moved_coordinates(system, state.q, rows, coordinates, places)
    wanted = state_rates(system, state)[places]
    if rate is not None:
        wanted = wanted + _with_relations(system, places, index, rate - wanted[index])
    rates, _, _, slots = _joint_motions(system, rows, body, places)
    own = jnp.concatenate([w, jnp.zeros(1)])[slots]
    w = w.at[slots].add(_slot_rates(rates, wanted - rates @ own), mode="drop")
    moving = row_rates(rows, *twists(system, rows, w))
    inside = (carried(system)[:, body] > 0)[:, None, None]
    v = jnp.where(inside, moving, state.row_rates)
    found = replace_fields(state, q=rows.reshape(-1, 3), v=v.reshape(-1, 3), coordinates=coordinates)
    if system.structure.held:
        held = jnp.zeros((2, *coordinates.shape)) if state.held is None else state.held
        chosen = jnp.array([1.0, 0.0 if rate is None else 1.0])
        at = places[index]
        found = replace_fields(found, held=held.at[:, at].set(jnp.maximum(held[:, at], chosen)))
    if rate is None:
        return found
    return replace_fields(found, rates=_rotors(system, state_rates(system, found), state, places))


@checked(system=SYSTEM, state=STATE, key=KEY, coordinates=DEVIATION, rates=DEVIATION)
def random_state(
    system: Model, state: State, key: Array, *, coordinates: float = 1.0, rates: float = 1.0
) -> State:
    """Random valid state of a system without loops and relations, for tests.

    One kinematic step of unit size with random rates of all free motions, along which joints and directors
    hold exactly, then random rates there. Free bodies and ball joints move, too.

    Args:
        system: compiled system.
        state: where to start from, for example the initial state.
        key: random key.
        coordinates: standard deviation of the changes of position [rad, m].
        rates: standard deviation of the rates [rad/s, m/s].

    Raises:
        ValueError: for a system with loops or relations between coordinates.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="arm"))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm))
        >>> system, state = scene.compile()
        >>> state = nc.random_state(system, state, jax.random.key(0))
        >>> bool(system.constraint_errors(state).position < 1e-13)
        True
    """
    if system.structure.held:
        raise ValueError(
            "random_state needs a system without loops, drives and couplings; move the state of this one "
            "with with_coordinate and project it with nc.assemble"
        )
    first, second = jax.random.split(key)
    size, dtype = system.structure.unknowns, state.q.dtype
    change = coordinates * jax.random.normal(first, (1, size), dtype)
    return _displaced(system, state, change, rates * jax.random.normal(second, (size,), dtype))


@eager_numpy
def _displaced(
    system: Model, state: State, change: Float[Array, "1 unknowns"], w: Float[Array, " unknowns"]
) -> State:
    """State after one kinematic step of unit size with the rates `change`, moving with the rates w."""
    tableau, h = gauss(1), jnp.ones(())
    rows = state.rows
    slots = gather_slots(system.tree, change)
    motion, _ = sweep_motion(system.tree, system.tree.frames(system.frames), rows, slots, h, tableau)
    points = rows[:, 0] + 0.5 * motion.velocity
    at = stations(rows, points, motion.directors, motion.velocity, motion.spin)
    after = rows + at.rates[0, :-1]
    counted = state.coordinates + stage_rates(system, at, h)[0]
    v = row_rates(after, *twists(system, after, w))
    moved = replace_fields(state, q=after.reshape(-1, 3), v=v.reshape(-1, 3), coordinates=counted)
    every = np.arange(counted.shape[0])
    return replace_fields(moved, rates=_rotors(system, state_rates(system, moved), moved, every))
