"""The rollout: steps, retries in substeps and events.

A rollout is a loop over slots; one slot is one attempt at one (sub)step. As long as every attempt succeeds,
slots are steps. A failed attempt is repeated with half the substep in the next slot; spare slots at the end
make up for it, and are not entered otherwise.

The derivative of a rollout runs along its recorded slots, see `derivative`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from natcoord_jax.assembly.equations import kind_of, prepare, starting
from natcoord_jax.assembly.kick import Kick
from natcoord_jax.assembly.outset import Outset
from natcoord_jax.assembly.system import System
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.rows import row, with_row
from natcoord_jax.stepping.course import Course, Setting, after_attempt, start_of
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.newton import Factors, any_lane, factors_of, judge, refreshed
from natcoord_jax.stepping.one_kernel import as_one_kernel
from natcoord_jax.stepping.plan import Plan, Slots
from natcoord_jax.stepping.probe import Probe
from natcoord_jax.stepping.step import end_of_step

ATTEMPTS = 2
"""Slots for every accepted substep with error control: one and a half, and some that are rejected."""


class Carried(eqx.Module):
    """What goes from one evaluation of the equations to the next.

    Attributes:
        count: complete slots.
        course: where the rollout stands, its state left out.
        state: the state in one array: fewer operations than one for every field.
        outset: what the equations need of that state.
        factors: of a Jacobian.
        probe: the Jacobian in the making.
        record: fields of `Slots`, for every slot; the states in one array.
    """

    count: Int[Array, ""]
    course: Course
    state: Float[Array, " numbers"]
    outset: Outset
    factors: Factors
    probe: Probe | None
    record: tuple[Array, ...]


def _trip(setting: Setting, unpack: Callable[[Array], State], carried: Carried) -> Carried:
    """One evaluation of the equations, and what follows from it."""
    plan, factors, probe = setting.plan, carried.factors, carried.probe
    course = _with_state(carried.course, unpack(carried.state))
    it, over = course.it, setting.over(course)
    u, h, index = setting.situation(course)
    equations = prepare(setting.system, course.state, u, h, plan.tableau, carried.outset)
    found = equations.evaluate(it.y if probe is None else probe.moved(it.y, equations))
    probing = jnp.array(False) if probe is None else probe.at >= 0
    driven = any(group.multipliers and group.effect.works for group in equations.groups)
    cost = equations.renewal if probe is None else max(equations.renewal, it.y.shape[0] // 2)
    options = {"balances": driven, "patience": cost}
    judged = judge(factors, plan.tolerance, it, found.residual, found.size, **options)
    it = jax.tree.map(partial(jnp.where, probing), it, judged)
    ending = ~probing & ~any_lane(it.unsolved & ~over)
    wanting = ~probing & ~ending & any_lane(it.wanting & it.unsolved & ~over)

    def ended(carry: tuple) -> tuple:
        _, before, x, _, record = carry
        before = _with_state(before, unpack(x))
        groups, tableau = equations.groups, plan.tableau
        ends = end_of_step(setting.system, before.state, h, groups, found, tableau)
        after = after_attempt(setting, before, factors.inertias, ends)
        accepted = after.taken > before.taken
        x = ravel_pytree(after.state)[0]
        slot = x, before.it.y, index, before.fraction, before.done, accepted, after.step
        if after.trial is not None:
            record = _taken_back(record, carried.count - 1, after.trial.undone, x)
        record = tuple(with_row(b, carried.count, r) for b, r in zip(record, slot))
        outset = _outset_after(setting, after, accepted, carried.outset, found.kick)
        return jnp.array(False), _with_state(after, None), x, outset, record

    # Loops of no or one trip leave what they carry where it is; a conditional would copy it.
    start = (
        ending,
        eqx.tree_at(lambda c: c.it, carried.course, it),
        carried.state,
        carried.outset,
        carried.record,
    )
    _, after, x, outset, record = jax.lax.while_loop(lambda carry: carry[0], ended, start)
    # An attempt for comparison leaves the run where it is, and factors that serve.
    solved = after.taken > course.taken if setting.tolerance is None else it.converged
    kept = factors.after_step(it, solved | over, cost)
    factors = eqx.tree_at(
        lambda f: (f.usable, f.fresh, f.least, f.extra, f.noise),
        factors,
        tuple(
            jnp.where(ending, a, b)
            for a, b in (
                (kept.usable, factors.usable),
                (kept.fresh, factors.fresh),
                (kept.least, factors.least),
                (kept.extra, factors.extra),
                (kept.noise, factors.noise),
            )
        ),
    )
    if probe is not None:
        probe, wanting = probe.with_column(it.y, found.residual, equations, wanting)

    def renewed(carry: tuple) -> tuple:
        _, it, factors = carry
        if probe is not None:
            made = factors_of(equations, probe.columns[:-1].T, factors.noise)
            return jnp.array(False), refreshed(it), made
        # Evaluated where the new factors belong, unless these begin anew where the step began.
        here = jnp.all(it.y == carried.course.it.y)
        loads = jax.tree.map(lambda x: jnp.where(here, x, 0.0), found.loads)
        factors = factors_of(equations, equations.tangent(it.y, loads), factors.noise)
        it = refreshed(it)
        # What the residual asks for with new factors needs no evaluation.
        moved = judge(factors, plan.tolerance, it, found.residual, found.size, **options)
        return jnp.array(False), jax.tree.map(partial(jnp.where, here & it.unsolved), moved, it), factors

    _, it, factors = jax.lax.while_loop(lambda carry: carry[0], renewed, (wanting, after.it, factors))
    after = eqx.tree_at(lambda c: c.it, after, it)
    return Carried(carried.count + ending, after, x, outset, factors, probe, record)


def _outset_after(
    setting: Setting, after: Course, accepted: Array, known: Outset, kick: Kick | None
) -> Outset:
    """What is known of the state that the next attempt starts from."""
    tangents = None
    if kick is not None and known.tangents is not None and setting.tolerance is None:
        # The end of this step is the start of the next one. (With error control it may be neither.)
        reached = kick.after.without_system()
        tangents = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), reached, known.tangents)
    return starting(setting.system, after.state, setting.plan.tableau, tangents)


def _taken_back(record: tuple, index: Array, undone: Array, x: Array) -> tuple:
    """The record with one slot that was not accepted after all, if it was not."""
    states, *others, accepted, finished = record
    index = jnp.maximum(index, 0)
    states = with_row(states, index, jnp.where(undone, x, row(states, index)))
    accepted = with_row(accepted, index, row(accepted, index) & ~undone)
    return states, *others, accepted, finished


def _is_none(x: Any) -> bool:
    return x is None


def _with_state(course: Course, state: State | None) -> Course:
    return eqx.tree_at(lambda c: c.state, course, state, is_leaf=_is_none)


class Ending(eqx.Module):
    """Where a rollout ended, and the factors it ended with."""

    course: Course
    factors: Factors


def run(
    plan: Plan, system: System, state: State, parameters: Any, dt: Array, tolerance: Tolerance | None
) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended; without derivatives (see `derivative`)."""
    found, unpack = _run(Setting(system, parameters, dt, tolerance, plan, plan.steps), state)
    course, (states, *rest) = _with_state(found.course, unpack(found.state)), found.record
    count, factors, slots = found.count, found.factors, Slots(jax.vmap(unpack)(states), *rest)
    if tolerance is not None:
        slots, count = slots.accepted_first(plan.steps + plan.extra)
    else:
        count = any_lane(count)
    unused = jnp.arange(plan.steps + plan.extra) >= count

    def fill(x: Array, last: Array | float) -> Array:
        return jnp.where(unused.reshape(-1, *(1,) * (x.ndim - 1)), last, x)

    slots = eqx.tree_at(
        lambda s: (s.states, s.finished, s.fraction, s.accepted),
        slots,
        (
            jax.tree.map(fill, slots.states, course.state),
            fill(slots.finished, course.step),
            fill(slots.fraction, jnp.ones(())),
            slots.accepted & ~unused,
        ),
    )
    return slots, Ending(_judged(course, plan.steps), factors)


def run_to_the_end(
    plan: Plan, system: System, state: State, parameters: Any, dt: Array, steps: Int[Array, ""]
) -> Course:
    """Where a rollout of any number of steps ends: one program for all numbers, and nothing recorded.

    Without derivatives. At most `plan.steps` steps are made.
    """
    found, unpack = _run(Setting(system, parameters, dt, None, plan, steps), state)
    return _judged(_with_state(found.course, unpack(found.state)), steps)


def _judged(course: Course, steps: Any) -> Course:
    """With the code of a run that used up its substeps."""
    short = (course.step < steps) & ~course.stopped
    code = jnp.where(short, int(Result.MAX_SUBSTEPS), course.code)
    return eqx.tree_at(lambda c: c.code, course, code)


def _run(setting: Setting, state: State) -> tuple[Carried, Callable[[Array], State]]:
    """The loop over all evaluations of the equations."""
    plan = setting.plan
    length = plan.steps + plan.extra
    if setting.tolerance is not None:
        length = ATTEMPTS * length
    packed, unpack = ravel_pytree(state)

    def unfinished(carried: Carried) -> Array:
        course = carried.course
        return (carried.count < length) & any_lane(~setting.over(course))

    def every_slot(course: Course, factors: Factors, outset: Outset, x: Array) -> Carried:
        it = course.it
        by_differences = kind_of(setting.system, plan.tableau).by_differences
        probe = Probe.first(it.y.shape[0], x.dtype) if by_differences else None
        slot = x, it.y, course.step, course.fraction, course.done, course.stopped, course.step
        # A row beyond the last goes to the last.
        rows = length if plan.recorded else 1
        record = tuple(jnp.zeros((rows, *x.shape), x.dtype) for x in slot)
        if plan.tableau.stages > 1 and by_differences:
            u, h, _ = setting.situation(_with_state(course, unpack(x)))
            equations = prepare(setting.system, unpack(x), u, h, plan.tableau, outset)
            factors = factors_of(equations, equations.inertial_jacobian())
            factors = eqx.tree_at(lambda f: f.fresh, factors, jnp.array(False))
        start = Carried(jnp.array(0), course, x, outset, factors, probe, record)
        return jax.lax.while_loop(unfinished, partial(_trip, setting, unpack), start)

    course, factors, outset = start_of(setting, state)
    return as_one_kernel(every_slot, _with_state(course, None), factors, outset, packed), unpack
