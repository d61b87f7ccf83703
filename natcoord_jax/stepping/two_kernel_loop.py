"""The loop over all slots of a rollout, in one kernel or in rounds of two.

What is compiled as one kernel becomes one function of machine code. The time of the compiler's passes over
loops grows with the square of their number, so that large programs are cut where little travels: between
steps that need no new factors, and these.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.equations import kind_of, prepare
from natcoord_jax.native.call import as_native, fits
from natcoord_jax.stepping.attempt import LoopCarry, RefactorRequest, attempt, renewed_at
from natcoord_jax.stepping.difference_jacobian import first_probe
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.factors import Factors
from natcoord_jax.stepping.newton import Iterate, any_lane
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.rollout_state import RolloutProblem, RolloutState, start_of
from natcoord_jax.system import System
from natcoord_jax.xla.one_kernel import as_one_kernel, lane_by_lane, plainly
from natcoord_jax.xla.rows import with_part

COUNTED = "step", "taken", "rejected", "iterations", "iterations_max", "residual"
"""What a rollout counts for itself."""


class TakenUp(eqx.Module):
    """The end of a rollout that the next goes on with.

    Besides the state there are factors, guesses and what Newton's iteration has learnt: with all of them
    the states are those of one run, to the bit.

    Attributes:
        anew: whether there is none, and the rollout begins with its state.
        carried: what the loop over the steps ended with, its record left out.
    """

    anew: Bool[Array, ""]
    carried: LoopCarry


def going_on(first: LoopCarry, taken_up: TakenUp | None) -> LoopCarry:
    """What the loop over the steps begins with."""
    if taken_up is None:
        return first
    carried = taken_up.carried
    course = replace_fields(carried.course, **{name: getattr(first.course, name) for name in COUNTED})
    carried = replace_fields(carried, course=course, count=first.count, first=first.first)
    return jax.tree.map(lambda new, old: jnp.where(taken_up.anew, new, old), first, carried)


PARTS = 4
"""Bodies from which on new factors are made in a kernel of their own."""

CHUNK = 16
"""Slots between two returns from the kernel of the steps, at most."""

ATTEMPTS = 2
"""Slots for every accepted substep with error control: one and a half, and some that are rejected."""


def all_slots(
    setting: RolloutProblem,
    state: State,
    kernel: Callable = as_one_kernel,
    taken_up: TakenUp | None = None,
) -> tuple[LoopCarry, Callable[[Array], State]]:
    """The loop over all evaluations of the equations.

    Args:
        setting: of the rollout.
        state: the first.
        kernel: what runs the loop where it is one kernel, see `in_parts`; `plainly` in that of the caller.
        taken_up: the loop that this one goes on with.
    """
    plan = setting.plan
    length = plan.steps + plan.extra
    if setting.tolerance is not None:
        length = ATTEMPTS * length
    packed, unpack = ravel_pytree(state)
    if in_parts(setting.system, plan, setting.tolerance):
        return _by_rounds(setting, unpack, length, packed, taken_up), unpack
    whole = partial(_every_slot, setting, unpack, length)
    if kernel is not plainly and fits(unknowns_of(plan, setting.system)):

        def otherwise(function: Callable, *arguments: Any) -> LoopCarry:
            return lane_by_lane(partial(kernel, function), *arguments)

        return as_native(otherwise, whole, packed, taken_up), unpack
    return kernel(whole, packed, taken_up), unpack


def in_parts(system: System, plan: Plan, tolerance: Tolerance | None) -> bool:
    """Whether new factors are made in a kernel of their own: one for all would compile for too long."""
    kind = kind_of(system, plan.tableau)
    large = len(system.structure.bodies) >= PARTS or system.structure.solver == "sparse"
    return kind.by_formulas and tolerance is None and large and not fits(unknowns_of(plan, system))


def unknowns_of(plan: Plan, system: System) -> int:
    """Unknowns of a step in the rates of the tree."""
    return plan.tableau.stages * (system.structure.unknowns + system.structure.multipliers)


def _unfinished(setting: RolloutProblem, length: int, carried: LoopCarry) -> Array:
    # Of fewer steps than there is room for in the record, as many attempts are made as with room for these.
    attempts = 1 if setting.tolerance is None else ATTEMPTS
    unused = attempts * (setting.plan.steps - setting.steps) if setting.plan.recorded else 0
    return (carried.count < length - unused) & any_lane(~setting.over(carried.course))


def _record(course: RolloutState, x: Array, rows: int) -> tuple[Array, ...]:
    """Room for so many slots."""
    slot = x, course.it.y, course.step, course.fraction, course.done, course.stopped, course.step
    if course.search is not None:
        slot = *slot, course.search.ended
    return tuple(jnp.zeros((rows, *x.shape), x.dtype) for x in slot)


def first_carry(setting: RolloutProblem, state: State) -> LoopCarry:
    """What the loop begins with, its record left out."""
    packed, unpack = ravel_pytree(state)
    rounds = in_parts(setting.system, setting.plan, setting.tolerance)
    return _first(setting, unpack, packed, rounds)


def _first(
    setting: RolloutProblem, unpack: Callable[[Array], State], x: Array, rounds: bool = False
) -> LoopCarry:
    course, factors, start_cache = start_of(setting, unpack(x))
    probe = None
    if kind_of(setting.system, setting.plan.tableau).by_differences:
        probe = first_probe(setting, course, start_cache)
    course = replace_fields(course, state=None)
    start = LoopCarry(jnp.array(0), course, x, start_cache, factors, probe, (), jnp.array(0), None)
    if not rounds:
        return start
    like = jax.eval_shape(lambda c: _situated(setting, unpack, c).evaluate(c.course.it.y), start)
    like = like.residual, like.size, like.loads
    residual, size, loads = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), like)
    asked = RefactorRequest(jnp.array(False), residual, size, loads, jnp.array(False))
    return eqx.tree_at(lambda c: c.asked, start, asked, is_leaf=lambda x: x is None)


def _every_slot(
    setting: RolloutProblem,
    unpack: Callable[[Array], State],
    length: int,
    x: Array,
    taken_up: TakenUp | None,
) -> LoopCarry:
    """All slots, in one loop."""
    # In the kernel, too: a few dozen fusions before it would take longer than the first steps.
    start = going_on(_first(setting, unpack, x), taken_up)
    # A row beyond the last goes to the last.
    record = _record(start.course, start.state, length if setting.plan.recorded else 1)
    start = replace_fields(start, record=record)
    going = partial(_unfinished, setting, length)
    return jax.lax.while_loop(going, partial(attempt, setting, unpack, False), start)


def _situated(setting: RolloutProblem, unpack: Callable[[Array], State], carried: LoopCarry) -> Any:
    """The equations of the attempt at hand."""
    state = unpack(carried.state)
    u, h, _ = setting.situation(replace_fields(carried.course, state=state))
    return prepare(setting.system, state, u, h, setting.plan.tableau, carried.start_cache)


def _by_rounds(
    setting: RolloutProblem,
    unpack: Callable[[Array], State],
    length: int,
    x: Array,
    taken_up: TakenUp | None,
) -> LoopCarry:
    """All slots, in rounds of a kernel that goes on until it needs new factors, and one that makes them.

    One kernel for both would compile twice as long; the slots of a round have a record of their own, so that
    what travels between kernels does not grow with the number of slots.
    """
    plan = setting.plan
    rows = CHUNK if plan.recorded else 1

    def attempts(near: RolloutProblem, carried: LoopCarry) -> LoopCarry:
        def going(c: LoopCarry) -> Array:
            assert c.asked is not None
            return _unfinished(near, length, c) & ~c.asked.wanting & (c.count < c.first + CHUNK)

        room = _record(carried.course, carried.state, rows)
        begun = eqx.tree_at(lambda c: (c.record, c.first), carried, (room, carried.count))
        return jax.lax.while_loop(going, partial(attempt, near, unpack, True), begun)

    def renewal(near: RolloutProblem, carried: LoopCarry) -> tuple[Iterate, Factors]:
        assert carried.asked is not None
        equations = _situated(near, unpack, carried)
        return renewed_at(near, equations, carried.course.it, carried.factors, carried.asked)

    def round_of(carry: tuple[LoopCarry, tuple[Array, ...]]) -> tuple:
        carried, record = carry
        near = setting.near(carried.course, CHUNK)
        found = as_one_kernel(partial(attempts, near), carried)
        if plan.recorded:
            record = tuple(with_part(whole, carried.count, new) for whole, new in zip(record, found.record))
        else:
            some = found.count > carried.count
            record = tuple(jnp.where(some, part, whole) for whole, part in zip(record, found.record))
        found = eqx.tree_at(lambda c: c.record, found, ())

        def renewed(found: LoopCarry) -> tuple[Iterate, Factors]:
            return as_one_kernel(partial(renewal, near), found)

        kept = found.course.it, found.factors
        it, factors = jax.lax.cond(found.asked.wanting, renewed, lambda _: kept, found)
        made = it, factors, jnp.array(False)
        return eqx.tree_at(lambda c: (c.course.it, c.factors, c.asked.wanting), found, made), record

    start = going_on(_first(setting, unpack, x, rounds=True), taken_up)
    # The slots of the last round may end before its room does.
    record = _record(start.course, start.state, length + CHUNK if plan.recorded else 1)
    found, record = jax.lax.while_loop(
        lambda carry: _unfinished(setting, length, carry[0]), round_of, (start, record)
    )
    return eqx.tree_at(lambda c: c.record, found, tuple(rows[:length] for rows in record))
