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
from jaxtyping import Array, Int

from natcoord_jax.assembly.equations import kind_of, prepare
from natcoord_jax.assembly.outset import Outset
from natcoord_jax.assembly.system import System
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.stepping.course import Course, Setting, start_of
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.newton import Factors, any_lane, factors_of
from natcoord_jax.stepping.one_kernel import as_one_kernel
from natcoord_jax.stepping.parts import Apart, Together
from natcoord_jax.stepping.plan import Plan, Slots
from natcoord_jax.stepping.probe import Probe
from natcoord_jax.stepping.trip import Carried, Stand, Trip, with_state

ATTEMPTS = 2
"""Slots for every accepted substep with error control: one and a half, and some that are rejected."""


class Ending(eqx.Module):
    """Where a rollout ended, and the factors it ended with."""

    course: Course
    factors: Factors


def run(
    plan: Plan, system: System, state: State, parameters: Any, dt: Array, tolerance: Tolerance | None
) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended; without derivatives (see `derivative`)."""
    setting = Setting(system, parameters, dt, tolerance, plan, plan.steps)
    count, course, factors, (states, *rest), unpack = _run(setting, state)
    slots = Slots(jax.vmap(unpack)(states), *rest)
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
    _, course, *_ = _run(Setting(system, parameters, dt, None, plan, steps), state)
    return _judged(course, steps)


def _judged(course: Course, steps: Any) -> Course:
    """With the code of a run that used up its substeps."""
    short = (course.step < steps) & ~course.stopped
    code = jnp.where(short, int(Result.MAX_SUBSTEPS), course.code)
    return eqx.tree_at(lambda c: c.code, course, code)


def _run(setting: Setting, state: State) -> tuple[int | Array, Course, Factors, tuple[Array, ...], Callable]:
    """The loop over all evaluations of the equations.

    Returns:
        Number of slots, where the rollout ended, its factors, the record, and how to unpack states.
    """
    plan = setting.plan
    kind = kind_of(setting.system, plan.tableau)
    length = plan.steps + plan.extra
    if setting.tolerance is not None:
        length = ATTEMPTS * length
    packed, unpack = ravel_pytree(state)

    def every_slot(
        parts: type[Apart] | type[Together], course: Course, factors: Factors, outset: Outset, x: Array
    ) -> Carried:
        it = course.it
        probe = Probe.first(it.y.shape[0], x.dtype) if kind.by_differences else None
        slot = x, it.y, course.step, course.fraction, course.done, course.stopped, course.step
        # A row beyond the last goes to the last.
        rows = length if plan.recorded else 1
        record = tuple(jnp.zeros((rows, *x.shape), x.dtype) for x in slot)
        if plan.tableau.stages > 1 and kind.by_differences:
            u, h, _ = setting.situation(with_state(course, unpack(x)))
            equations = prepare(setting.system, unpack(x), u, h, plan.tableau, outset)
            factors = factors_of(equations, equations.inertial_jacobian())
            factors = eqx.tree_at(lambda f: f.fresh, factors, jnp.array(False))
        running, hold = any_lane(~setting.over(course)), parts.hold
        stand, solver = hold(Stand(course, x, outset, probe)), hold((factors.solver, factors.inertias))
        start = Carried(jnp.array(0), running, stand, solver, hold(factors.history), record)
        trip = Trip(hold(setting), unpack, parts)
        end = jax.lax.while_loop(lambda carried: (carried.count < length) & carried.running, trip, start)
        stand, solver, history = map(parts.read, (end.stand, end.solver, end.history))
        return Carried(end.count, end.running, stand, solver, history, end.record)

    course, factors, outset = start_of(setting, state)
    given = with_state(course, None), factors, outset, packed
    if kind.in_parts(setting.system):
        end = every_slot(Apart, *given)
    else:
        end = as_one_kernel(partial(every_slot, Together), *given)
    course = with_state(end.stand.course, unpack(end.stand.state))
    return end.count, course, Factors(*end.solver, *end.history), end.record, unpack
