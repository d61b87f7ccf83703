"""Impacts at the end of a step: what contacts have taken from the motion, and what they give back.

A gap that a step would have made negative is zero at its end (66), by an impulse that takes some energy with
it, more or less by where in the step the surfaces met. `natcoord_jax.maths.impact_law` says what velocities
follow: those of the restitution that is asked for, wherever that was.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.block_tangent_space import tangents_at
from natcoord_jax.assembly.diagnostics import group_places, rows_with_ground
from natcoord_jax.assembly.response import Evaluation
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.assembly.tangent_space import Velocity
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.impact_law import impact_impulses

TOUCHING = 1e-12
"""Gap at the start of a step, per unit of size of the places, up to which surfaces have met before: what the
last step has left of a gap that it closed."""


class Answers:
    """What impulses along the gaps do to the velocities of one configuration."""

    def __init__(self, system: System, groups: Sequence[Group], state: State) -> None:
        self.space: Any = tangents_at(system, state)
        rows = rows_with_ground(state.q)
        levers = []
        for group in groups:
            each = jax.vmap(lambda effect, place, rows: effect.lever(place, rows))
            found = each(group.effect, group_places(system, group), rows[group.bodies])
            whole = jnp.zeros((group.count, *rows.shape), rows.dtype)
            index = jnp.arange(group.count)[:, None], group.bodies
            levers.append(whole.at[index].add(found)[:, :-1])
        still = jnp.zeros((sum(g.count for g in groups), *state.rates.shape), rows.dtype)
        self.impulses = Velocity(jnp.concatenate(levers), still)
        self.along = jax.vmap(self.space.answer)(self.impulses)

    @property
    def matrix(self) -> Float[Array, "c c"]:
        """W = G M^-1 G^T."""
        flat = self.along.reshape(self.along.shape[0], -1)
        return flat @ flat.T

    def rates(self, velocity: Velocity) -> Float[Array, " c"]:
        """gamma: work of a unit impulse on a velocity."""
        return self.along.reshape(self.along.shape[0], -1) @ self.space.framed(velocity).reshape(-1)

    def pushed(self, velocity: Velocity, impulses: Float[Array, " c"]) -> Velocity:
        """A velocity after impulses."""
        change = self.space.along(jnp.tensordot(impulses, self.along, 1))
        return Velocity(velocity.rows + change.rows, velocity.rotors + change.rotors)


def gaps(system: System, groups: Sequence[Group], state: State) -> Float[Array, " c"]:
    """Gaps of contacts [m]."""
    rows, found = rows_with_ground(state.q), []
    for group in groups:
        each = jax.vmap(lambda effect, place, rows: effect.readings(place, rows).gap)
        found.append(each(group.effect, group_places(system, group), rows[group.bodies]))
    return jnp.concatenate(found)


def after_impacts(
    system: System, start: State, end: State, h: Array, groups: Sequence[Group], found: Evaluation
) -> tuple[State, dict[int, Array]]:
    """The state after the impacts at the end of a step of one stage, and their work [J] by number of group.

    Args:
        system: compiled system.
        start: state at the start of the step.
        end: at its end.
        h: step [s].
        groups: that act.
        found: solved equations of the step.
    """
    numbers = [k for k, group in enumerate(groups) if group.effect.unilateral]
    these = [groups[k] for k in numbers]
    # Of the multipliers of a contact the first is that of the gap.
    lam = jnp.concatenate([found.given[k][:, 0, 0] for k in numbers])
    taken = -jnp.concatenate([found.power[k][:, 0] for k in numbers])
    # As in the equations: what is left of the impulse of an open contact may be of either sign.
    mobility = jnp.concatenate([group.effect.mobility for group in these])
    active = 0.5 * mobility * lam > gaps(system, these, end) / h
    none = jnp.zeros_like(lam)

    def impacts() -> tuple[Array, Array, Array]:
        return _impacts(system, start, end, these, active, taken)

    v, rotors, done = jax.lax.cond(jnp.any(active), impacts, lambda: (end.v, end.rates, none))
    parts = np.split(np.arange(lam.size), np.cumsum([group.count for group in these])[:-1])
    return replace_fields(end, v=v, rates=rotors), {k: done[part] for k, part in zip(numbers, parts)}


def _impacts(
    system: System, start: State, end: State, groups: Sequence[Group], active: Array, taken: Array
) -> tuple[Array, Array, Array]:
    """Velocities and rates of rotors after impacts of the active contacts, and their work."""
    answers = Answers(system, groups, end)
    size = 1.0 + jnp.max(jnp.abs(start.q))
    met = active & (gaps(system, groups, start) > TOUCHING * size)
    restitution = jnp.concatenate([group.effect.restitution for group in groups])
    work = jnp.where(met & (taken > 0), taken, 0.0)
    velocity = Velocity(end.v.reshape(-1, 4, 3), end.rates)
    rates, matrix = answers.rates(velocity), answers.matrix
    impulses = impact_impulses(matrix, rates, work, restitution, active, met)
    after = answers.pushed(velocity, impulses)
    done = impulses * (rates + 0.5 * matrix @ impulses)
    return after.rows.reshape(end.v.shape), after.rotors, done


def with_mobilities(system: System, state: State) -> System:
    """The system with what unit impulses do at its contacts, at one state."""
    groups = [group for group in system.effects if group.effect.unilateral]
    if not groups:
        return system
    own = jnp.diagonal(_matrix(system, state))
    effects, first = [], 0
    for group in system.effects:
        if group.effect.unilateral:
            here = own[first : first + group.count]
            first += group.count
            effect = replace_fields(group.effect, mobility=jnp.where(here > 0, here, 1.0))
            group = replace_fields(group, effect=effect)
        effects.append(group)
    return replace_fields(system, effects=tuple(effects))


@eager_numpy
def _matrix(system: System, state: State) -> Array:
    return Answers(system, [group for group in system.effects if group.effect.unilateral], state).matrix
