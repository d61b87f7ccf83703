"""By how much a state misses the constraints: of bodies, joints, and relations between joint coordinates."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.coordinates import velocities_with_ground
from natcoord_jax.assembly.diagnostics import group_places, over_states, rows_with_ground
from natcoord_jax.assembly.reading import Source, over_source
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State, Trajectory

GAP = 1e-9
"""Largest violation [m, rad, -] and rate of it taken for round-off of printed data, per unit of size."""


class ConstraintErrors(eqx.Module):
    """Largest violations at each time; of a trajectory, of the velocities that are read of it.

    Attributes:
        directors: of d_i . d_j = delta_ij [-].
        joints: of the joints' constraints [m, -].
        relations: of drives, couplings and pitches of screws [rad, m].
        director_rates: of the time derivatives of what holds for directors [1/s].
        joint_rates: of those of the joints' constraints [m/s, 1/s].
        relation_rates: of those of relations [rad/s, m/s].
    """

    directors: Float[Array, "*t"]
    joints: Float[Array, "*t"]
    relations: Float[Array, "*t"]
    director_rates: Float[Array, "*t"]
    joint_rates: Float[Array, "*t"]
    relation_rates: Float[Array, "*t"]

    def __repr__(self) -> str:
        """The largest over all times."""
        if not is_concrete(self) or self.joints.size == 0:
            return eqx.tree_pformat(self)
        units = "-", "m, -", "rad, m", "1/s", "m/s, 1/s", "rad/s, m/s"
        names = (field.name for field in dataclasses.fields(self))
        sizes = [f"{name} {np.max(getattr(self, name)):.2g} [{unit}]" for name, unit in zip(names, units)]
        times = f", largest of {self.joints.size} states" if self.joints.size > 1 else ""
        return f"ConstraintErrors({', '.join(sizes)}{times})"

    @property
    def position(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint."""
        return jnp.maximum(jnp.maximum(self.directors, self.joints), self.relations)

    @property
    def velocity(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint rate."""
        return jnp.maximum(jnp.maximum(self.director_rates, self.joint_rates), self.relation_rates)


def constrained(system: System) -> tuple[Group, ...]:
    """All groups with constraints: relations between coordinates, then joints."""
    return (*(g for g in system.effects if g.holds), *(g for g in system.joints if g.multipliers))


def contacts(system: System) -> tuple[Group, ...]:
    """All groups with inequalities."""
    return tuple(g for g in system.effects if g.effect.unilateral)


def contact_gaps(system: System, groups: Sequence[Group], state: State) -> Float[Array, " c"]:
    """Gaps of contacts [m]."""
    rows, found = rows_with_ground(state.q), []
    for group in groups:
        each = jax.vmap(lambda effect, place, rows: effect.readings(place, rows).gap)
        found.append(each(group.effect, group_places(system, group), rows[group.bodies]))
    return jnp.concatenate(found)


def refuse_contacts(system: System, what: str) -> None:
    """Refuse to ask of contacts what they have no answer to.

    Raises:
        ValueError: with a contact, and what to do.
    """
    for group in contacts(system):
        remedy = (
            "which contacts are closed, it does not say; give the contact a stiffness, which makes it a "
            "potential"
            if group.effect.bounces
            else "which way friction acts, it does not say; leave out the friction"
        )
        raise ValueError(
            f"{what} of a system with {group.effect.kind} {group.labels[0]!r} is not defined: {remedy}"
        )


def violations_of(system: System, groups: tuple[Group, ...], state: State) -> list[Float[Array, "n m"]]:
    """Violations of the constraints of some groups."""
    rows, found = rows_with_ground(state.q), []
    for group in groups:
        given = group_places(system, group), rows[group.bodies], state.coordinates[group.coordinates]
        found.append(jax.vmap(lambda e, *x: e.violation(*x, state.t))(group.effect, *given))
    return found


def violation_rates_of(
    system: System, groups: tuple[Group, ...], state: State, passing: float = 1.0
) -> list[Float[Array, "n m"]]:
    """Rates of the violations; with `passing` 0, of those at a fixed time."""
    rows, found = rows_with_ground(state.q), []
    rates, spin = velocities_with_ground(state.v, rows)
    for group in groups:
        given = (x[group.bodies] for x in (rows, rates, spin))
        every = jax.vmap(lambda e, *x: e.violation_rate(*x, state.t, passing))
        found.append(every(group.effect, group_places(system, group), *given))
    return found


def joint_residuals(system: System, state: State) -> list[tuple[Group, Array, Array]]:
    """Residual and rate of every joint's constraints, by group."""
    groups = system.joints
    values, rates = violations_of(system, groups, state), violation_rates_of(system, groups, state)
    return list(zip(groups, values, rates))


@eager_numpy
def residuals(system: System, state: State) -> list[tuple[Array, Array]]:
    """Residual and rate of every joint's constraints, in the order of the groups."""
    return [(value, rate) for _, value, rate in joint_residuals(system, state)]


def largest(groups: list[Array]) -> Float[Array, ""]:
    """Largest absolute value in any of the arrays, zero without any; NaN where there is one."""
    return jnp.max(jnp.concatenate([jnp.zeros(1), *(jnp.abs(x).reshape(-1) for x in groups)]))


def _relations(system: System) -> tuple[Group, ...]:
    return tuple(g for g in system.effects if g.holds)


@over_states
def _values(system: System, state: State) -> tuple[Array, Array, Array]:
    d = state.q.reshape(-1, 4, 3)[:, 1:]
    gram = jnp.einsum("bik,bjk->bij", d, d) - jnp.eye(3)
    joints, relations = (
        largest(violations_of(system, groups, state)) for groups in (system.joints, _relations(system))
    )
    return jnp.max(jnp.abs(gram)), joints, relations


@over_source
def _rates(system: System, state: State) -> tuple[Array, Array, Array]:
    d, rates = (x.reshape(-1, 4, 3)[:, 1:] for x in (state.q, state.v))
    mixed = jnp.einsum("bik,bjk->bij", d, rates)
    joints, relations = (
        largest(violation_rates_of(system, groups, state)) for groups in (system.joints, _relations(system))
    )
    return jnp.max(jnp.abs(mixed + jnp.swapaxes(mixed, 1, 2))), joints, relations


def constraint_errors(system: System, motion: State | Trajectory) -> ConstraintErrors:
    """Largest violations of internal constraints, joints and relations, and of their rates."""
    source = Source.of(system, motion)
    if isinstance(motion, State):
        source = replace_fields(source, as_they_are=True)
    return ConstraintErrors(*_values(system, motion), *_rates(source))


def position_size(state: State) -> Float[Array, ""]:
    """What violations of positions are compared with."""
    return 1.0 + jnp.max(jnp.abs(state.q)) + jnp.max(jnp.abs(state.coordinates), initial=0.0)


def rate_size(state: State) -> Float[Array, ""]:
    """What their rates are compared with."""
    return 1.0 + jnp.max(jnp.abs(state.v))


def misses(system: System, state: State) -> tuple[Array, Array]:
    """Largest violation of any joint or relation and of their rates, in terms of `GAP` times the size."""
    groups = constrained(system)
    gap, rate = (
        largest(violations_of(system, (*groups, *contacts(system)), state)),
        largest(violation_rates_of(system, groups, state)),
    )
    return gap / (GAP * position_size(state)), rate / (GAP * rate_size(state))


@eager_numpy
def _position_violations(system: System, state: State) -> tuple[list[Array], Array]:
    return violations_of(system, constrained(system), state), position_size(state)


@eager_numpy
def _overlaps(system: System, state: State) -> tuple[list[Array], Array]:
    return violations_of(system, contacts(system), state), position_size(state)


@eager_numpy
def _rate_violations(system: System, state: State) -> tuple[list[Array], Array]:
    return violation_rates_of(system, constrained(system), state), rate_size(state)


@dataclass(frozen=True)
class Violation:
    """The constraint that a state violates most.

    Attributes:
        kind: of the part.
        name: of the part.
        size: of the violation, or of its rate.
        unit: of the size.
        is_joint: whether the part is a joint.
    """

    kind: str
    name: str
    size: float
    unit: str
    is_joint: bool

    def __str__(self) -> str:
        return f"{'joint' if self.is_joint else self.kind} {self.name!r}"


def worst_violation(
    system: System,
    state: State,
    *,
    rates: bool = False,
    allowed: float = GAP,
    overlaps: bool = False,
) -> Violation | None:
    """The largest violation (or rate of one) of a concrete state beyond what is allowed, per unit of size.

    Of constraints, or overlaps of surfaces in contact.
    """
    groups = contacts(system) if overlaps else constrained(system)
    if not groups:
        return None
    find = _overlaps if overlaps else _rate_violations if rates else _position_violations
    listed, size = find(system, state)
    found = [np.abs(np.asarray(x)) for x in listed]
    sizes = [np.max(x) for x in found]
    worst = int(np.argmax(sizes))
    if not sizes[worst] > allowed * float(size):
        return None
    group = groups[worst]
    instance, row = np.unravel_index(np.argmax(found[worst]), found[worst].shape)
    places, rows = group_places(system, group)[instance], rows_with_ground(state.q)[group.bodies[instance]]
    alone = jax.tree.map(lambda x: x[instance], group.effect)
    unit = alone.violation_units(places, rows)[row]
    if rates:
        unit = "1/s" if unit == "-" else f"{unit}/s"
    is_joint = group.source == "joint"
    return Violation(group.effect.kind, group.names[int(instance)], float(sizes[worst]), unit, is_joint)
