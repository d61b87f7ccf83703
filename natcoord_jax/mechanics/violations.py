"""By how much a state misses the constraints: of bodies, joints, and relations between joint coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.coordinates import velocities_with_ground
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground

GAP = 1e-9
"""Largest violation, relative, and rate of it taken for round-off of printed data."""

LEFT_OPEN = 1e-6
"""Largest violation, relative, of a state that a run may start from: what is left by one with a loose
`newton_tol`."""


def constrained(system: Model) -> tuple[Group, ...]:
    """All groups with constraints: relations between coordinates, then joints."""
    return (*(g for g in system.effects if g.holds), *(g for g in system.joints if g.multipliers))


def contacts(system: Model) -> tuple[Group, ...]:
    """All groups with inequalities."""
    return tuple(g for g in system.effects if g.effect.unilateral)


def contact_gaps(system: Model, groups: Sequence[Group], state: State) -> Float[Array, " c"]:
    """Gaps of contacts [m]."""
    rows, found = rows_with_ground(state.q), []
    for group in groups:
        each = jax.vmap(lambda effect, place, rows: effect.readings(place, rows).gap)
        found.append(each(group.effect, group_places(system, group), rows[group.bodies]))
    return jnp.concatenate(found)


def refuse_contacts(system: Model, what: str) -> None:
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


def violations_of(
    system: Model, groups: tuple[Group, ...], state: State, measure: str = "opening"
) -> list[Float[Array, "n m"]]:
    """Violations of the constraints of some groups.

    Args:
        system: compiled system.
        groups: with constraints.
        state: whose.
        measure: "opening", which tells joints that are turned round, or "violation".
    """
    rows, found = rows_with_ground(state.q), []
    for group in groups:
        given = group_places(system, group), rows[group.bodies], state.coordinates[group.coordinates]
        found.append(jax.vmap(lambda e, *x: getattr(e, measure)(*x, state.t))(group.effect, *given))
    return found


def violation_rates_of(
    system: Model, groups: tuple[Group, ...], state: State, passing: float = 1.0
) -> list[Float[Array, "n m"]]:
    """Rates of the violations; with `passing` 0, of those at a fixed time."""
    rows, found = rows_with_ground(state.q), []
    rates, spin = velocities_with_ground(state.v, rows)
    for group in groups:
        given = (x[group.bodies] for x in (rows, rates, spin))
        every = jax.vmap(lambda e, *x: e.violation_rate(*x, state.t, passing))
        found.append(every(group.effect, group_places(system, group), *given))
    return found


@eager_numpy
def residuals(system: Model, state: State) -> list[Array]:
    """Residuals of every joint's constraints, in the order of the groups."""
    return violations_of(system, system.joints, state)


def largest(groups: list[Array]) -> Float[Array, ""]:
    """Largest absolute value in any of the arrays, zero without any; NaN where there is one."""
    return jnp.max(jnp.concatenate([jnp.zeros(1), *(jnp.abs(x).reshape(-1) for x in groups)]))


def spans(system: Model, groups: Sequence[Group]) -> list[Float[Array, "n m"]]:
    """What a motion by the size of the scene and a turn by one radian change each constraint by, at most."""
    return [
        system.size * shifted + turned for shifted, turned in (jnp.unstack(g.spans, axis=-1) for g in groups)
    ]


def relative(system: Model, groups: Sequence[Group], found: list[Array]) -> list[Array]:
    """Violations of the constraints of groups, or their rates, in terms of their spans [-, 1/s]."""
    return [x / span for x, span in zip(found, spans(system, groups), strict=True)]


def coordinate_sizes(system: Model) -> Float[Array, " coordinates"]:
    """One radian, or the size of the scene [m], of every joint coordinate."""
    sizes = jnp.ones(len(system.structure.coordinates))
    for group in system.coordinates:
        if group.axis.unit != "rad":
            sizes = sizes.at[group.index].set(system.size)
    return sizes


def position_size(system: Model, state: State) -> Float[Array, ""]:
    """What relative violations of positions are compared with.

    More than one far away and after many turns, where places and angles are rounded more coarsely.
    """
    far = jnp.max(jnp.abs(state.rows[:, 0])) / system.size
    return 1.0 + far + jnp.max(jnp.abs(state.coordinates / coordinate_sizes(system)), initial=0.0)


def rate_size(system: Model, state: State) -> Float[Array, ""]:
    """What their relative rates are compared with: how fast the bodies move in terms of that size [1/s]."""
    v = jnp.abs(state.row_rates)
    return jnp.maximum(jnp.max(v[:, 0]) / system.size, jnp.max(v[:, 1:]))


def misses(system: Model, state: State) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether any joint or relation is violated by more than `GAP`, and whether its rate is."""
    groups = constrained(system)
    closing = (*groups, *contacts(system))
    gap = largest(relative(system, closing, violations_of(system, closing, state)))
    rate = largest(relative(system, groups, violation_rates_of(system, groups, state)))
    return ~(gap <= GAP * position_size(system, state)), ~(rate <= GAP * rate_size(system, state))


def is_open(system: Model, state: State) -> Bool[Array, ""]:
    """Whether positions violate loops, relations or contacts by more than a run may start with.

    Those that are not numbers miss nothing: the first step finds them.
    """
    groups = (*(g for g in constrained(system) if not g.in_tree), *contacts(system))
    found = relative(system, groups, violations_of(system, groups, state, "violation"))
    return largest(found) > LEFT_OPEN * position_size(system, state)


@eager_numpy
def _violated(
    system: Model, state: State, rates: bool, overlaps: bool
) -> tuple[list[Array], list[Array], Array]:
    groups = contacts(system) if overlaps else constrained(system)
    missed = violation_rates_of if rates else violations_of
    size = rate_size if rates else position_size
    return missed(system, groups, state), spans(system, groups), size(system, state)


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
    system: Model,
    state: State,
    *,
    rates: bool = False,
    allowed: float = GAP,
    overlaps: bool = False,
) -> Violation | None:
    """The largest violation (or rate of one), relative, of a concrete state beyond what is allowed.

    Of constraints, or overlaps of surfaces in contact.
    """
    groups = contacts(system) if overlaps else constrained(system)
    if not groups:
        return None
    listed, spanned, size = _violated(system, state, rates, overlaps)
    found = [np.abs(np.asarray(x)) for x in listed]
    shares = [x / np.asarray(span) for x, span in zip(found, spanned, strict=True)]
    sizes = [np.max(x) for x in shares]
    worst = int(np.argmax(sizes))
    if not sizes[worst] > allowed * float(size):
        return None
    group = groups[worst]
    instance, row = np.unravel_index(np.argmax(shares[worst]), shares[worst].shape)
    places, rows = group_places(system, group)[instance], rows_with_ground(state.q)[group.bodies[instance]]
    alone = jax.tree.map(lambda x: x[instance], group.effect)
    unit = alone.violation_units(places, rows)[row]
    if rates:
        unit = "1/s" if unit == "-" else f"{unit}/s"
    is_joint = group.source == "joint"
    size = float(found[worst][instance, row])
    return Violation(group.effect.kind, group.names[int(instance)], size, unit, is_joint)
