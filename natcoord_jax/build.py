"""Compilation: from named parts to a system and its initial state."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.bodies import DIRECTOR, POINT, Body
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.elements import Elements
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.names import compact
from natcoord_jax.core.nodes import Clamp
from natcoord_jax.core.state import State
from natcoord_jax.maths.vectors import safe_norm, safe_sqrt
from natcoord_jax.mechanics.coordinates import coordinate_values, state_rates
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.mechanics.impacts import untouched, with_mobilities
from natcoord_jax.mechanics.projection import with_sizes
from natcoord_jax.model.axisymmetric_axes import symmetries
from natcoord_jax.model.bodies import Bodies
from natcoord_jax.model.choice import choose_solver, elimination_order
from natcoord_jax.model.graph import make_tree
from natcoord_jax.model.grouping import element_group, stack
from natcoord_jax.model.islands import contact_islands
from natcoord_jax.model.layout import Layout
from natcoord_jax.model.local_rates import LocalRates
from natcoord_jax.model.masses import mass_of
from natcoord_jax.model.model import Structure
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.reading.admissible import sound
from natcoord_jax.system import System


def build(
    singles: dict[str, Body],
    joints: dict[str, Joint],
    effects: dict[str, Effect],
    solver: str | None,
    sets: dict[str, Any] | None = None,
    elements: dict[str, Elements] | None = None,
    clamps: Sequence[Clamp] = (),
) -> tuple[System, State]:
    """Number bodies along the spanning tree, group equal kinds, and lay out the state."""
    bodies = Bodies(singles, sets or {}, clamps)
    layout = Layout(bodies, joints, effects)
    instances = [layout.effect_instance(name, effect) for name, effect in effects.items()]
    layout.number_accounts(instances)
    turning = np.array([*(bool(kind.turns) for kind in layout.kinds), False])
    joint_groups, groups = stack(layout.joint_instances(), turning), stack(instances, turning)
    groups += tuple(element_group(layout, name, part, turning) for name, part in (elements or {}).items())
    tree = make_tree(layout.spanning, layout.motions())
    relations = sum(g.count * g.multipliers for g in groups)
    multipliers = relations + sum(g.count * g.multipliers for g in joint_groups if not g.in_tree)
    inequalities = sum(g.count * g.multipliers for g in groups if g.effect.unilateral)
    internal = sum(kind.constraints for kind in bodies.kinds)
    masses, between = mass_of(layout.masses(), groups, np.array([kind.rows for kind in layout.kinds]))
    coupled = between is not None
    structure = Structure(
        bodies=layout.ordered_names,
        joints=layout.ordered_joints,
        inputs=tuple(layout.inputs),
        works=tuple(layout.works),
        coordinates=tuple((name, k) for name, k, _ in layout.coordinates),
        rotors=len(layout.rotors),
        unknowns=len(tree.slot_of),
        multipliers=multipliers,
        solver=solver or choose_solver(tree, multipliers, joint_groups, groups, len(bodies), coupled),
        constraints=internal + relations - inequalities + sum(g.count * g.multipliers for g in joint_groups),
        points=compact([k for k, own in enumerate(layout.kinds) if own == POINT]),
        directors=compact([k for k, own in enumerate(layout.kinds) if own == DIRECTOR]),
        inequalities=inequalities,
        islands=contact_islands(groups, joint_groups, len(layout.ordered_names), coupled),
        dofs=len(tree.slot_of) - multipliers + inequalities,
        clamped=bodies.held,
        shapes=tuple(_drawn(bodies.shapes[k]) for k in layout.order),
    )
    system = System(
        masses,
        layout.frames(),
        layout.joint_bodies(),
        tree,
        LocalRates.of(layout.kinds),
        joint_groups,
        groups,
        layout.coordinate_groups(),
        layout.coordinate_order(),
        elimination_order(layout, groups, joint_groups, coupled) if structure.solver == "recursive" else None,
        structure,
        mass_between=between,
    )
    state = replace_fields(layout.state(), contacts=untouched(system))
    system = with_slip_speeds(with_sizes(system, state), state)
    system = with_mobilities(jax.tree.map(as_array, with_symmetries(system, state)), state)
    return sound(system, system), with_readings(system, state)


def _drawn(shape: Any) -> Any:
    """A shape by numbers of NumPy, which are no part of the program; None for one that is traced."""
    return jax.tree.map(np.asarray, shape) if is_concrete(shape) else None


def with_slip_speeds(system: System, state: State) -> System:
    """The system with rates of slip up to which friction is smooth, by its speeds, where none are given."""
    effects: list[Any] = list(system.effects)
    angles = np.concatenate([[-1], *(g.index for g in system.coordinates if g.axis.unit == "rad")])
    for k, group in enumerate(effects):
        name, part = group.effect.slips or (None, 0.0)
        if name and getattr(group.effect, name) is None:
            turns: Any = np.isin(group.coordinates, angles).any(axis=1)
            load = group.effect.friction if group.source == "coordinates" else 0.0
            slip = {name: part * _speeds(system, state, turns, load)}
            effects[k] = replace_fields(group, effect=replace_fields(group.effect, **slip))
    return replace_fields(system, effects=tuple(effects))


@eager_numpy
def _speeds(system: System, state: State, turns: Bool[Array, " n"], load: Any) -> Float[Array, " n"]:
    """Of the fastest body at the start, and that which gravity gives along the size of the scene [m/s].

    Of coordinates that turn, over that size. What rests where nothing falls is moved by no less than a load.
    """
    fields = replace_fields(system, effects=tuple(g for g in system.effects if g.source == "mass"))
    still, size = jnp.zeros_like(state.rows[:, 0]), system.size
    force, _ = loads(fields, state, jnp.zeros(len(system.structure.inputs)), still, still)
    pulls = safe_norm(force) / jnp.where(system.mass[:, 0, 0] > 0, system.mass[:, 0, 0], 1.0)
    speed = safe_sqrt(jnp.max(pulls) * size) + jnp.max(safe_norm(state.row_rates[:, 0]))
    least = safe_sqrt(load * jnp.where(turns, 1.0, size) / jnp.sum(system.mass[:, 0, 0]))
    speed = jnp.where(speed > 0, speed, jnp.where(least > 0, least, size))
    return speed / jnp.where(turns, size, 1.0)


def with_symmetries(system: System, state: State) -> System:
    """The system with the axes of bodies that are round, turn freely, and that nothing is fixed to.

    Along axes that do not spin with a body, what is fixed to it off its axis would go round.
    """
    tree, count = system.tree, len(system.structure.bodies)
    single = tree.ball & ~np.isin(np.arange(count), tree.parent)
    if tree.directed is not None:
        single = single & ~tree.directed
    for group in (*system.effects, *system.joints):
        if group.effect.elastic or (group.source == "joint" and not group.in_tree):
            single = single & ~np.isin(np.arange(count), group.bodies)
    if not single.any():
        return system
    rows = state.rows
    found = symmetries(system.mass, tree.frames(system.frames), rows, jnp.asarray(single))
    return replace_fields(system, tree=replace_fields(tree, symmetry=found))


def with_readings(system: System, state: State) -> State:
    """The state with lengths as they are, and rotors turning with their joints; angles count from zero."""
    return _with_readings(system, state) if system.coordinates else state


@eager_numpy
def _with_readings(system: System, state: State) -> State:
    values, rates = coordinate_values(system, rows_with_ground(state.q)), state_rates(system, state)
    coordinates, rotors = state.coordinates, state.rates
    for group in system.coordinates:
        if group.axis.unit != "rad":
            coordinates = coordinates.at[group.index].set(values[group.index])
    for group in system.effects:
        if group.effect.rotors:
            rotors = rotors.at[group.rotors[:, 0]].set(rates[group.coordinates[:, 0]])
    return replace_fields(state, coordinates=coordinates, rates=rotors)
