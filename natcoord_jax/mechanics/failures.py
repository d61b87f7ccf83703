"""What is wrong with a step though its equations are solved.

An element inside out, a drive that jumps, neighbours overlooked. One number tells what it is: first come the
elements that can be inside out, then the drives, then, for each instance of an effect that looks for
neighbours, pairs of its markers that it has missed, then those it had no room for.
"""

from collections.abc import Sequence
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

SEARCHES = Result.MISSED, Result.OVERFLOW
"""What a search can miss, in turn."""

BEYOND = 3.0
"""How far beyond its rates in a step, in terms of the difference between them, a drive may change."""

NEGLIGIBLE = 1e-9
"""Jump of a drive per radian or unit of size of the places that passes: the rounding of a function."""


def _failing(system: Model) -> Sequence[tuple[Group, int, tuple[Result, ...]]]:
    """Groups that can fail in order, with so many numbers for each of their instances and of these codes."""
    volumes = ((g, 1, (Result.INVERTED,)) for g in system.effects if g.has_volumes)
    drives = ((g, 1, (Result.JUMPED,)) for g in drives_of(system))
    searches = ((g, g.bodies.shape[1] ** 2, SEARCHES) for g in system.effects if g.searches)
    return *volumes, *drives, *searches


def can_fail(system: Model) -> bool:
    """Whether there is anything of the kind."""
    return bool(_failing(system))


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
    first = sum(group.count for group in system.effects if group.has_volumes)
    if drives := drives_of(system):
        jumps = jnp.concatenate([_jumps(group, equations) for group in drives])
        found = jnp.where((found < 0) & jnp.any(jumps), first + jnp.argmax(jumps), found)
        first += len(jumps)
    for group, where in zip(equations.groups, equations.situations):
        if group.searches:
            missed = _missed(group, where, equations.state, after)
            found = jnp.where((found < 0) & (missed >= 0), first + missed, found)
            first += group.count * len(SEARCHES) * group.bodies.shape[1] ** 2
    return found


def _jumps(group: Group, equations: Any) -> Bool[Array, " n"]:
    """Which drives change in a step by more than rates in it tell.

    The change of a function that steps resolve lies between those of its rates, and that of one with kinks
    not far from it. By next to nothing, of an angle or of the places, they may jump.
    """
    # A drive may have no numbers: its coordinates count the lanes.
    prescribed = jax.vmap(lambda effect, _: effect.prescribed(equations.state.t, equations.h))
    change, rates = prescribed(group.effect, np.asarray(group.coordinates))
    low, high = jnp.min(rates, axis=1), jnp.max(rates, axis=1)
    beyond = jnp.abs(change - jnp.clip(change, low, high))
    jump, relation = jnp.where(beyond > BEYOND * (high - low), beyond, 0.0), cast(Any, group.effect)
    angular = all(axis.unit == "rad" for axis in relation.axes)
    size = 1.0 if angular else jnp.max(jnp.abs(equations.state.rows[:, 0]))
    return jump > NEGLIGIBLE * size


def _missed(group: Group, where: Any, before: State, after: State) -> Int[Array, ""]:
    """Number of the first pair, within a group."""
    rows, rates = group_rows(group, before)
    pairs = jax.vmap(lambda effect, *given: effect.missed(*given, where.h))(
        group.effect, where.place, where.neighbours, rows, rates, group_rows(group, after)[0]
    )
    size = group.bodies.shape[1]
    numbers = np.arange(group.count * len(SEARCHES)).reshape(-1, len(SEARCHES)) * size + pairs[..., 0]
    numbers, wrong = (numbers * size + pairs[..., 1]).reshape(-1), pairs[..., 0].reshape(-1) >= 0
    return jnp.where(jnp.any(wrong), numbers[jnp.argmax(wrong)], -1)


def failure(system: Model, number: int) -> tuple[Result, str]:
    """Result code and name of a failure by its number; on the host."""
    for group, each, codes in _failing(system):
        which, pair = divmod(number, each)
        instance, kind = divmod(which, len(codes))
        if instance < group.count:
            if codes is not SEARCHES:
                return codes[0], f"{group.effect.kind} {group.names[instance]!r}"
            pair = divmod(pair, group.bodies.shape[1])
            one, other = (system.structure.bodies[int(group.bodies[instance, k])] for k in pair)
            return codes[kind], f"{one!r} and {other!r} in {group.names[instance]!r}"
        number -= group.count * len(codes) * each
    return Result.INVERTED, "an element"


def result_of(system: Model, number: Int[Array, ""]) -> Int[Array, ""]:
    """Result code of a failure by its number."""
    code, first = jnp.array(int(Result.INVERTED)), 0
    for group, each, codes in _failing(system):
        if codes[0] is not Result.INVERTED:
            numbers: Any = jnp.array([int(k) for k in codes])
            kind = numbers[(number - first) // each % len(codes)] if codes is SEARCHES else int(codes[0])
            code = jnp.where(number >= first, kind, code)
        first += group.count * len(codes) * each
    return code
