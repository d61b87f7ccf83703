"""What is wrong with a step though its equations are solved.

An element inside out, a drive that jumps, neighbours overlooked. One number tells what it is: first come the
elements that can be inside out, then the drives, then, for each instance of an effect that looks for
neighbours, pairs of its markers that it has missed, then those it had no room for.
"""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.equations_of_motion import drives_of
from natcoord_jax.mechanics.inversion import first_inverted
from natcoord_jax.mechanics.response import group_rows
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model

KINDS = Result.MISSED, Result.OVERFLOW

BEYOND = 3.0
"""How far beyond its rates in a step, in terms of the difference between them, a drive may change."""

NEGLIGIBLE = 1e-9
"""Jump of a drive per radian or unit of size of the places that passes: the rounding of a function."""


def can_fail(system: Model) -> bool:
    """Whether there is anything of the kind."""
    return any(group.has_volumes or group.searches for group in system.effects) or bool(drives_of(system))


def _before_searches(system: Model) -> tuple[int, int]:
    """Number of the first drive, and of the first pair that a search can miss."""
    first = sum(group.count for group in system.effects if group.has_volumes)
    return first, first + sum(group.count for group in drives_of(system))


def first_failure(equations: Any, after: State) -> Int[Array, ""] | None:
    """Number of the first failure of a step; -1: there is none, None: there cannot be.

    Args:
        equations: of the step.
        after: state at its end.
    """
    system: Model = equations.system
    if not can_fail(system):
        return None
    inverted = first_inverted(system, after)
    found = jnp.array(-1) if inverted is None else inverted
    drives, first = _before_searches(system)
    if first > drives:
        jumps = jnp.concatenate([_jumps(group, equations) for group in drives_of(system)])
        found = jnp.where((found < 0) & jnp.any(jumps), drives + jnp.argmax(jumps), found)
    for group, where in zip(equations.groups, equations.situations):
        if group.searches:
            missed = _missed(system, group, where, equations.state, after)
            found = jnp.where((found < 0) & (missed >= 0), first + missed, found)
            first += _numbers(group)
    return found


def _jumps(group: Group, equations: Any) -> Bool[Array, " n"]:
    """Which drives change in a step by more than rates in it tell.

    The change of a function that steps resolve lies between those of its rates, and that of one with kinks
    not far from it. By next to nothing, of an angle or of the places, they may jump.
    """
    # A drive may have no numbers: its coordinates count the lanes.
    prescribed = jax.vmap(lambda effect, _: effect.prescribed(equations.state.t, equations.h))
    change, rates = prescribed(group.effect, group.coordinates)
    low, high = jnp.min(rates, axis=1), jnp.max(rates, axis=1)
    beyond = jnp.abs(change - jnp.clip(change, low, high))
    jump, relation = jnp.where(beyond > BEYOND * (high - low), beyond, 0.0), cast(Any, group.effect)
    angular = all(axis.unit == "rad" for axis in relation.axes)
    size = 1.0 if angular else jnp.max(jnp.abs(equations.state.rows[:, 0]))
    return jump > NEGLIGIBLE * size


def _numbers(group: Group) -> int:
    return group.count * len(KINDS) * group.bodies.shape[1] ** 2


def _missed(system: Model, group: Group, where: Any, before: State, after: State) -> Int[Array, ""]:
    """Number of the first pair, within a group."""
    rows, rates = group_rows(group, before)
    pairs = jax.vmap(lambda effect, *given: effect.missed(*given, where.h))(
        group.effect, where.place, where.neighbours, rows, rates, group_rows(group, after)[0]
    )
    size = group.bodies.shape[1]
    numbers = (np.arange(group.count * len(KINDS)).reshape(-1, len(KINDS)) * size + pairs[..., 0]) * size
    numbers, wrong = (numbers + pairs[..., 1]).reshape(-1), pairs[..., 0].reshape(-1) >= 0
    return jnp.where(jnp.any(wrong), numbers[jnp.argmax(wrong)], -1)


def failure(system: Model, number: int) -> tuple[Result, str]:
    """Result code and name of a failure by its number; on the host."""
    for group in system.effects:
        if group.has_volumes:
            if number < group.count:
                return Result.INVERTED, f"{group.effect.kind} {group.names[number]!r}"
            number -= group.count
    for group in drives_of(system):
        if number < group.count:
            return Result.JUMPED, f"{group.effect.kind} {group.names[number]!r}"
        number -= group.count
    for group in system.effects:
        if group.searches:
            if number < _numbers(group):
                size = group.bodies.shape[1]
                which, one, other = np.unravel_index(number, (group.count * len(KINDS), size, size))
                instance, kind = divmod(int(which), len(KINDS))
                bodies = [system.structure.bodies[int(group.bodies[instance, k])] for k in (one, other)]
                return KINDS[kind], f"{bodies[0]!r} and {bodies[1]!r} in {group.names[instance]!r}"
            number -= _numbers(group)
    return Result.INVERTED, "an element"


def result_of(system: Model, number: Int[Array, ""]) -> Int[Array, ""]:
    """Result code of a failure by its number."""
    drives, first = _before_searches(system)
    code = jnp.where(number >= drives, int(Result.JUMPED), int(Result.INVERTED))
    for group in system.effects:
        if group.searches:
            kind = (number - first) // group.bodies.shape[1] ** 2 % len(KINDS)
            code = jnp.where(number >= first, jnp.array([int(k) for k in KINDS])[kind], code)
            first += _numbers(group)
    return code
