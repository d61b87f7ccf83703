"""The rollout: steps, retries in substeps and events.

A rollout is a loop over slots; one slot is one attempt at one (sub)step. As long as every attempt succeeds,
slots are steps. A failed attempt is repeated with half the substep in the next slot; spare slots at the end
make up for it, and are not entered otherwise.

The derivative of a rollout runs along its recorded slots, see `derivative`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.assembly.equations import prepare
from natcoord_jax.assembly.system import System
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.maths.rows import with_row
from natcoord_jax.stepping.newton import (
    PATIENCE,
    Factors,
    Iterate,
    any_lane,
    begin,
    factors_of,
    judge,
    no_factors,
    refreshed,
)
from natcoord_jax.stepping.one_kernel import as_one_kernel
from natcoord_jax.stepping.past import Past
from natcoord_jax.stepping.probe import BY_DIFFERENCES, Probe
from natcoord_jax.stepping.step import end_of_step

SMALLEST_FRACTION = 1.0 / 4096
"""A step is given up when a substep of this fraction of it fails, if slots have not run out before."""

LARGEST_HALF_TURN = 10.0
"""Tangent of half the largest rotation of a body in one (sub)step, 169 degrees: beyond lies the pole."""


@dataclass(frozen=True)
class Plan:
    """What is static about a rollout.

    Attributes:
        steps: number of steps.
        extra: slots available for retries.
        tolerance: of Newton's iteration.
        control: function (parameters, step index, t, state, fraction of the step) to inputs; None: they are
            parameters[step].
        event: function of the state whose change of sign ends the run, or None.
        tableau: of the collocation method.
        recorded: whether every slot is; else only the last is kept.
    """

    steps: int
    extra: int
    tolerance: float
    control: Callable[[Any, Array, Array, State, Array], Array] | None
    event: Callable[[State], Array] | None = None
    tableau: Tableau = gauss(1)
    recorded: bool = True

    def inputs(
        self, parameters: Any, step: Array, state: State, done: Array, fraction: Array
    ) -> Float[Array, " inputs"] | Float[Array, "s inputs"]:
        """Inputs of a (sub)step that starts at a state, after a part `done` of its step."""
        if self.control is None:
            return self.within_step(parameters[step], done, fraction)
        return self.control(parameters, step, state.t, state, fraction)

    def within_step(self, inputs: Array, done: Array, fraction: Array) -> Array:
        """Inputs of a part of a step from those of the whole one: held, or interpolated from its stages."""
        if inputs.ndim == 1:
            return inputs
        nodes = self.tableau.c
        times = done + fraction * jnp.asarray(nodes)
        columns = []
        for j, node in enumerate(nodes):
            others = [(times - other) / (node - other) for k, other in enumerate(nodes) if k != j]
            columns.append(reduce(jnp.multiply, others, jnp.ones_like(times)))
        weights = jnp.where(fraction == 1.0, jnp.eye(len(nodes)), jnp.stack(columns, axis=1))
        return weights @ inputs


class Slots(eqx.Module):
    """Record of all slots.

    Attributes:
        states: state after each slot (unchanged if the attempt failed).
        y: unknowns of each attempt.
        step: step each slot belongs to.
        fraction: its part of the step.
        done: the part of the step before it.
        accepted: whether the attempt succeeded.
        finished: steps completed after the slot.
    """

    states: State
    y: Float[Array, "*slots unknowns"]
    step: Int[Array, "*slots"]
    fraction: Float[Array, "*slots"]
    done: Float[Array, "*slots"]
    accepted: Bool[Array, "*slots"]
    finished: Int[Array, "*slots"]


class Course(eqx.Module):
    """Where a rollout stands: carried from slot to slot.

    `worst` is the unknown with the largest correction in the attempt that ended the run, -1 without one.
    """

    state: State
    it: Iterate
    past: Past
    step: Int[Array, ""]
    done: Float[Array, ""]
    fraction: Float[Array, ""]
    code: Int[Array, ""]
    stopped: Bool[Array, ""]
    worst: Int[Array, ""]
    taken: Int[Array, ""]
    iterations: Int[Array, ""]
    iterations_max: Int[Array, ""]
    residual: Float[Array, ""]


class Setting(eqx.Module):
    """What stays the same over a rollout."""

    system: System
    parameters: Any
    dt: Float[Array, ""]
    plan: Plan = eqx.field(static=True)
    steps: Int[Array, ""] | int

    def over(self, course: Course) -> Bool[Array, ""]:
        """Whether the rollout has ended."""
        return course.stopped | (course.step >= self.steps)

    def situation(self, course: Course) -> tuple[Array, Array, Array]:
        """Inputs, length and number of the (sub)step at hand."""
        h = jnp.where(self.over(course), 1e-3, course.fraction * self.dt)
        index = jnp.minimum(course.step, self.steps - 1)
        u = self.plan.inputs(self.parameters, index, course.state, course.done, course.fraction)
        return u, h, index

    @property
    def form(self) -> str:
        """Form of the equations."""
        return self.system.structure.solver


def _start(setting: Setting, state: State) -> tuple[Course, Factors]:
    dt, plan = setting.dt, setting.plan
    u = plan.inputs(setting.parameters, jnp.array(0), state, jnp.zeros(()), jnp.ones(()))
    equations = prepare(setting.system, state, u, dt, plan.tableau)
    it, factors = begin(equations.guess()), no_factors(equations, setting.form)
    zero, nought = jnp.array(0), jnp.zeros((), state.q.dtype)
    bad = ~(jnp.isfinite(dt) & (dt > 0))
    code = jnp.where(bad, int(Result.BAD_STEP), int(Result.SUCCESSFUL))
    course = Course(
        state, it, Past.of(it.y), zero, nought, nought + 1.0, code, bad, zero - 1, zero, zero, zero, nought
    )
    return course, factors


def _end(setting: Setting, course: Course, inertias: Array, found: tuple[State, Array]) -> Course:
    """The end of an attempt: the new state, or the same with half the substep."""
    plan, state, it, over = setting.plan, course.state, course.it, setting.over(course)
    new, half_turn = found
    finite = jnp.all(jnp.isfinite(new.q)) & jnp.all(jnp.isfinite(new.v))
    code = jnp.where((it.code == 0) & ~finite, int(Result.NONFINITE), it.code)
    code = jnp.where((code == 0) & (half_turn > LARGEST_HALF_TURN), int(Result.DIVERGED), code)
    accepted = (code == int(Result.SUCCESSFUL)) & ~over
    new = jax.tree.map(partial(jnp.where, accepted), new, state)
    done = course.done + jnp.where(accepted, course.fraction, 0.0)
    complete = accepted & (done > 1.0 - 1e-9)
    halved = 0.5 * course.fraction
    hopeless = ~accepted & ~over & (halved < SMALLEST_FRACTION)
    stopped = course.stopped | hopeless
    result = jnp.where(hopeless, code, course.code)
    if plan.event is not None:
        crossed = accepted & (plan.event(state) * plan.event(new) <= 0) & (plan.event(state) != 0)
        stopped, result = stopped | crossed, jnp.where(crossed, int(Result.EVENT), result)
    fraction = jnp.where(complete, 1.0, jnp.where(accepted | over, course.fraction, halved))
    worked = jnp.where(over, 0, it.total)
    # Guesses hold for steps of one length: another length begins anew from the last solution.
    alone = Past(course.past.differences, jnp.ones_like(course.past.known), jnp.zeros_like(course.past.order))
    past = jax.tree.map(partial(jnp.where, accepted), course.past.followed_by(it.y, inertias), alone)
    same = fraction == course.fraction
    past = Past(past.differences, jnp.where(same, past.known, 1), jnp.where(same, past.order, 0))
    guess = jnp.where(jnp.all(jnp.isfinite(past.guess)), past.guess, it.start)
    return Course(
        new,
        begin(guess),
        past,
        course.step + complete,
        jnp.where(complete, 0.0, done),
        fraction,
        result,
        stopped,
        jnp.where(hopeless, it.worst, course.worst),
        course.taken + accepted,
        course.iterations + worked,
        jnp.maximum(course.iterations_max, worked),
        jnp.where(accepted, jnp.maximum(course.residual, it.error), course.residual),
    )


class Carried(eqx.Module):
    """What goes from one evaluation of the equations to the next.

    Attributes:
        count: complete slots.
        course: where the rollout stands, its state left out.
        state: the state in one array: fewer operations than one for every field.
        factors: of a Jacobian.
        probe: the Jacobian in the making.
        record: fields of `Slots`, for every slot; the states in one array.
    """

    count: Int[Array, ""]
    course: Course
    state: Float[Array, " numbers"]
    factors: Factors
    probe: Probe | None
    record: tuple[Array, ...]


def _trip(setting: Setting, unpack: Callable[[Array], State], carried: Carried) -> Carried:
    """One evaluation of the equations, and what follows from it."""
    plan, factors, probe = setting.plan, carried.factors, carried.probe
    course = _with_state(carried.course, unpack(carried.state))
    it, over = course.it, setting.over(course)
    u, h, index = setting.situation(course)
    equations = prepare(setting.system, course.state, u, h, plan.tableau)
    found = equations.evaluate(it.y if probe is None else probe.moved(it.y, equations))
    probing = jnp.array(False) if probe is None else probe.at >= 0
    driven = any(group.multipliers and group.effect.works for group in equations.groups)
    cost = PATIENCE if probe is None else max(PATIENCE, it.y.shape[0] // 2)
    options = {"balances": driven, "patience": cost}
    judged = judge(factors, plan.tolerance, it, found.residual, found.size, **options)
    it = jax.tree.map(partial(jnp.where, probing), it, judged)
    ending = ~probing & ~any_lane(it.unsolved & ~over)
    wanting = ~probing & ~ending & any_lane(it.wanting & it.unsolved & ~over)

    def ended(carry: tuple) -> tuple:
        _, before, x, record = carry
        before = _with_state(before, unpack(x))
        groups, tableau = equations.groups, plan.tableau
        ends = end_of_step(setting.system, before.state, h, groups, found, tableau)
        after = _end(setting, before, factors.inertias, ends)
        accepted = after.taken > before.taken
        x = ravel_pytree(after.state)[0]
        slot = x, before.it.y, index, before.fraction, before.done, accepted, after.step
        record = tuple(with_row(b, carried.count, r) for b, r in zip(record, slot))
        return jnp.array(False), _with_state(after, None), x, record

    # Loops of no or one trip leave what they carry where it is; a conditional would copy it.
    start = ending, eqx.tree_at(lambda c: c.it, carried.course, it), carried.state, carried.record
    _, after, x, record = jax.lax.while_loop(lambda carry: carry[0], ended, start)
    accepted = after.taken > course.taken
    kept = factors.after_step(it.total, accepted | over, 2 * cost)
    factors = eqx.tree_at(
        lambda f: (f.usable, f.fresh, f.extra),
        factors,
        tuple(
            jnp.where(ending, a, b)
            for a, b in (
                (kept.usable, factors.usable),
                (kept.fresh, factors.fresh),
                (kept.extra, factors.extra),
            )
        ),
    )
    if probe is not None:
        probe, wanting = probe.with_column(it.y, found.residual, equations, wanting)

    def renewed(carry: tuple) -> tuple:
        _, it, _ = carry
        matrix = equations.jacobian(it.y) if probe is None else probe.columns[:-1].T
        return jnp.array(False), refreshed(it), factors_of(equations, setting.form, matrix)

    _, it, factors = jax.lax.while_loop(lambda carry: carry[0], renewed, (wanting, after.it, factors))
    after = eqx.tree_at(lambda c: c.it, after, it)
    return Carried(carried.count + ending, after, x, factors, probe, record)


def _is_none(x: Any) -> bool:
    return x is None


def _with_state(course: Course, state: State | None) -> Course:
    return eqx.tree_at(lambda c: c.state, course, state, is_leaf=_is_none)


class Ending(eqx.Module):
    """Where a rollout ended, and the factors it ended with."""

    course: Course
    factors: Factors


def run(plan: Plan, system: System, state: State, parameters: Any, dt: Array) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended; without derivatives (see `derivative`)."""
    found, unpack = _run(Setting(system, parameters, dt, plan, plan.steps), state)
    course, (states, *rest) = _with_state(found.course, unpack(found.state)), found.record
    count, factors, slots = found.count, found.factors, Slots(jax.vmap(unpack)(states), *rest)
    unused = jnp.arange(plan.steps + plan.extra) >= any_lane(count)

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
    found, unpack = _run(Setting(system, parameters, dt, plan, steps), state)
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
    packed, unpack = ravel_pytree(state)

    def unfinished(carried: Carried) -> Array:
        course = carried.course
        return (carried.count < length) & any_lane(~setting.over(course))

    def every_slot(course: Course, factors: Factors, x: Array) -> Carried:
        it = course.it
        probe = Probe.first(it.y.shape[0], x.dtype) if setting.form in BY_DIFFERENCES else None
        slot = x, it.y, course.step, course.fraction, course.done, course.stopped, course.step
        # A row beyond the last goes to the last.
        rows = length if plan.recorded else 1
        record = tuple(jnp.zeros((rows, *x.shape), x.dtype) for x in slot)
        if plan.tableau.stages > 1 and setting.form in BY_DIFFERENCES:
            u, h, _ = setting.situation(_with_state(course, unpack(x)))
            equations = prepare(setting.system, unpack(x), u, h, plan.tableau)
            factors = factors_of(equations, setting.form, equations.inertial_jacobian())
            factors = eqx.tree_at(lambda f: f.fresh, factors, jnp.array(False))
        start = Carried(jnp.array(0), course, x, factors, probe, record)
        return jax.lax.while_loop(unfinished, partial(_trip, setting, unpack), start)

    course, factors = _start(setting, state)
    return as_one_kernel(every_slot, _with_state(course, None), factors, packed), unpack
