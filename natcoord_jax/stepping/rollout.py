"""The rollout: steps, retries in substeps, events, and its derivative.

A rollout is a loop over slots; one slot is one attempt at one (sub)step. As long as every attempt succeeds,
slots are steps. A failed attempt is repeated with half the substep in the next slot; spare slots at the end
make up for it, and are not entered otherwise.

The derivative (`custom_jvp`) runs along the recorded slots: their states and solutions are outputs, so all
Jacobians are formed at once, vmapped over the slots, and only the recursion from state to state is a scan.
Newton's iteration is never differentiated. The recorded outputs are differentiated by the same rule, so
second derivatives (forward over reverse, forward over forward) are exact. Substep fractions are constants.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.assembly.system import System
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.stepping.newton import Warm, any_lane
from natcoord_jax.stepping.step import advance, linear_solver, solve, start_cold

SMALLEST_FRACTION = 1.0 / 64
"""A step is given up when a substep of this fraction of it fails."""


CHUNK = 32
"""Slots whose Jacobians are formed together."""

LARGEST_HALF_TURN = 10.0
"""Tangent of half the largest rotation of a body in one (sub)step, 169 degrees: beyond lies the pole."""


@dataclass(frozen=True)
class Plan:
    """What is static about a rollout.

    Attributes:
        steps: number of steps.
        extra: slots available for retries.
        tolerance: of Newton's iteration.
        control: function (parameters, step index, t, state) to inputs.
        event: function of the state whose change of sign ends the run, or None.
        stages: stages of the collocation method.
    """

    steps: int
    extra: int
    tolerance: float
    control: Callable[[Any, Array, Array, State], Array]
    event: Callable[[State], Array] | None = None
    stages: int = 1


class Slots(eqx.Module):
    """Record of all slots.

    Attributes:
        states: state after each slot (unchanged if the attempt failed).
        y: unknowns of each attempt.
        step: step each slot belongs to.
        fraction: its part of the step.
        accepted: whether the attempt succeeded.
        finished: steps completed after the slot.
    """

    states: State
    y: Float[Array, "*slots unknowns"]
    step: Int[Array, "*slots"]
    fraction: Float[Array, "*slots"]
    accepted: Bool[Array, "*slots"]
    finished: Int[Array, "*slots"]


class Course(eqx.Module):
    """Where a rollout stands: carried from slot to slot.

    `worst` is the unknown with the largest correction in the attempt that ended the run, -1 without one;
    `warm` is what the last step left to the next, `before` the unknowns of the last accepted step.
    """

    state: State
    warm: Warm
    before: Float[Array, " unknowns"]
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


def _start(plan: Plan, system: System, state: State, parameters: Any, dt: Float[Array, ""]) -> Course:
    u = plan.control(parameters, jnp.array(0), state.t, state)
    warm = start_cold(system, state, u, dt, gauss(plan.stages))
    zero = jnp.array(0)
    bad = ~(jnp.isfinite(dt) & (dt > 0))
    code = jnp.where(bad, int(Result.BAD_STEP), int(Result.SUCCESSFUL))
    nought = jnp.zeros((), state.q.dtype)
    return Course(
        state, warm, warm.y, zero, nought, nought + 1.0, code, bad, zero - 1, zero, zero, zero, nought
    )


def _slot(plan: Plan, system: System, parameters: Any, dt: Array, course: Course) -> tuple[Course, Slots]:
    """One attempt at one (sub)step."""
    tableau = gauss(plan.stages)
    state, idle = course.state, course.stopped | (course.step >= plan.steps)
    h = course.fraction * dt
    h = jnp.where(idle, jnp.ones_like(h) * 1e-3, h)
    index = jnp.minimum(course.step, plan.steps - 1)
    u = plan.control(parameters, index, state.t, state)
    solution = solve(system, state, u, h, tableau, plan.tolerance, course.warm)
    _, new, half_turn = advance(system, state, u, h, solution.y, tableau)
    finite = jnp.all(jnp.isfinite(new.q)) & jnp.all(jnp.isfinite(new.v))
    code = jnp.where((solution.code == 0) & ~finite, int(Result.NONFINITE), solution.code)
    code = jnp.where((code == 0) & (half_turn > LARGEST_HALF_TURN), int(Result.DIVERGED), code)
    accepted = (code == int(Result.SUCCESSFUL)) & ~idle
    new = jax.tree.map(partial(jnp.where, accepted), new, state)
    done = course.done + jnp.where(accepted, course.fraction, 0.0)
    complete = accepted & (done > 1.0 - 1e-9)
    halved = 0.5 * course.fraction
    hopeless = ~accepted & ~idle & (halved < SMALLEST_FRACTION)
    stopped = course.stopped | hopeless
    result = jnp.where(hopeless, code, course.code)
    if plan.event is not None:
        crossed = accepted & (plan.event(state) * plan.event(new) <= 0) & (plan.event(state) != 0)
        stopped, result = stopped | crossed, jnp.where(crossed, int(Result.EVENT), result)
    fraction = jnp.where(complete, 1.0, jnp.where(accepted | idle, course.fraction, halved))
    done = jnp.where(complete, 0.0, done)
    worked = jnp.where(idle, 0, solution.iterations)
    ahead = jnp.where(accepted, 2 * solution.y - course.before, course.warm.y)
    sane = jnp.where(jnp.all(jnp.isfinite(ahead)), ahead, course.before)
    following = Course(
        new,
        eqx.tree_at(lambda w: (w.y, w.valid), solution.warm, (sane, accepted & solution.warm.valid)),
        jnp.where(accepted, solution.y, course.before),
        course.step + complete,
        done,
        fraction,
        result,
        stopped,
        jnp.where(hopeless, solution.worst, course.worst),
        course.taken + accepted,
        course.iterations + worked,
        jnp.maximum(course.iterations_max, worked),
        jnp.where(accepted, jnp.maximum(course.residual, solution.error), course.residual),
    )
    record = Slots(new, solution.y, index, course.fraction, accepted, following.step)
    return following, record


def _is_none(x: Any) -> bool:
    return x is None


def _without_state(course: Course) -> Course:
    return eqx.tree_at(lambda c: c.state, course, None)


def _run(plan: Plan, system: System, state: State, parameters: Any, dt: Array) -> tuple[Slots, Course]:
    attempt = partial(_slot, plan, system, parameters, dt)
    length = plan.steps + plan.extra
    start = _start(plan, system, state, parameters, dt)
    # One array instead of one for every field: fewer operations in every trip.
    packed, unpack = ravel_pytree(state)

    def packed_attempt(carried: tuple[Course, Array]) -> tuple[tuple[Course, Array], tuple[Slots, Array]]:
        course, x = carried
        after, record = attempt(eqx.tree_at(lambda c: c.state, course, unpack(x), is_leaf=_is_none))
        x = ravel_pytree(after.state)[0]
        return (_without_state(after), x), (eqx.tree_at(lambda s: s.states, record, None), x)

    first = (_without_state(start), packed)
    shapes = jax.eval_shape(packed_attempt, first)[1]
    buffer = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), shapes)

    def unfinished(carry: tuple) -> Array:
        count, (course, _), _ = carry
        return (count < length) & any_lane(~course.stopped & (course.step < plan.steps))

    def body(carry: tuple) -> tuple:
        count, carried, buffer = carry
        carried, record = packed_attempt(carried)
        buffer = jax.tree.map(
            lambda b, r: jax.lax.dynamic_update_index_in_dim(b, r, count, 0), buffer, record
        )
        return count + 1, carried, buffer

    count, (course, x), (slots, states) = jax.lax.while_loop(unfinished, body, (jnp.array(0), first, buffer))
    course = eqx.tree_at(lambda c: c.state, course, unpack(x), is_leaf=_is_none)
    slots = eqx.tree_at(lambda s: s.states, slots, jax.vmap(unpack)(states), is_leaf=_is_none)
    unused = jnp.arange(length) >= count

    def fill(x: Array, last: Array | float) -> Array:
        return jnp.where(unused.reshape(-1, *(1,) * (x.ndim - 1)), last, x)

    slots = eqx.tree_at(
        lambda s: (s.states, s.finished, s.fraction),
        slots,
        (
            jax.tree.map(fill, slots.states, course.state),
            fill(slots.finished, course.step),
            fill(slots.fraction, jnp.ones(())),
        ),
    )
    short = (course.step < plan.steps) & ~course.stopped
    code = jnp.where(short, int(Result.MAX_SUBSTEPS), course.code)
    return slots, eqx.tree_at(lambda c: c.code, course, code)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def run_slots(plan: Plan, system: System, state: State, parameters: Any, dt: Array) -> tuple[Slots, Course]:
    """All slots of a rollout and where it ended; see the module for its derivative."""
    return _run(plan, system, state, parameters, dt)


def _zero_tangent(x: Array) -> Array | np.ndarray:
    if jnp.issubdtype(jnp.result_type(x), jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(jnp.shape(x), jax.dtypes.float0)


def _in_chunks(function: Callable, slots: tuple) -> Any:
    """The function of every slot, vmapped in chunks whose temporaries stay in the cache."""
    every = jax.vmap(lambda x: function(*x))
    length = slots[1].shape[0]
    if length <= CHUNK:
        return every(slots)
    chunks = -(-length // CHUNK)
    padding = jnp.minimum(jnp.arange(chunks * CHUNK), length - 1)

    def chunked(x: Array) -> Array:
        return x[padding].reshape(chunks, CHUNK, *x.shape[1:])

    found = jax.lax.map(every, jax.tree.map(chunked, slots))
    return jax.tree.map(lambda x: x.reshape(chunks * CHUNK, *x.shape[2:])[:length], found)


def _is_zero(x: Any) -> bool:
    return isinstance(x, jax.custom_derivatives.SymbolicZero)


def _some_tangents(tree: Any, tangents: Any) -> tuple[list, Callable, list]:
    """The leaves that are differentiated, the way back to the tree, and their tangents."""
    leaves, structure = jax.tree.flatten(tree)
    changes = jax.tree.leaves(tangents, is_leaf=_is_zero)
    chosen = [i for i, change in enumerate(changes) if not _is_zero(change)]

    def whole(some: list) -> Any:
        every = list(leaves)
        for i, leaf in zip(chosen, some):
            every[i] = leaf
        return jax.tree.unflatten(structure, every)

    return [leaves[i] for i in chosen], whole, [changes[i] for i in chosen]


def _instantiated(tangents: Any, primals: Any) -> Any:
    """Tangents with arrays for symbolic zeros."""
    return jax.tree.map(
        lambda t, p: _zero_tangent(p) if _is_zero(t) else t, tangents, primals, is_leaf=_is_zero
    )


@partial(run_slots.defjvp, symbolic_zeros=True)
def _run_slots_jvp(plan: Plan, primals: tuple, tangents: tuple):
    system, state, parameters, dt = primals
    system_dot, state_dot, parameters_dot, dt_dot = tangents
    state_dot = _instantiated(state_dot, state)
    some, whole, some_dot = _some_tangents((system, parameters, dt), (system_dot, parameters_dot, dt_dot))
    slots, course = run_slots(plan, *primals)
    tableau = gauss(plan.stages)
    before = jax.tree.map(
        lambda first, after: jnp.concatenate([first[None], after[:-1]]), state, slots.states
    )

    def outcome(system, state, parameters, dt, y, step, fraction):
        u = plan.control(parameters, step, state.t, state)
        return advance(system, state, u, fraction * dt, y, tableau)[:2]

    def prepared(state, y, step, fraction):
        """Linear maps of one slot: from (state, unknowns), of the parameters' change, and the solver."""
        _, along = jax.linearize(
            lambda state, y: outcome(system, state, parameters, dt, y, step, fraction), state, y
        )

        def by_numbers(some: list) -> tuple[Array, State]:
            system, parameters, dt = whole(some)
            return outcome(system, state, parameters, dt, y, step, fraction)

        forcing = jax.jvp(by_numbers, (some,), (some_dot,))[1]
        u = plan.control(parameters, step, state.t, state)
        solver = linear_solver(system, state, u, fraction * dt, y, tableau, along)
        return along, solver, forcing

    def body(state_dot, xs):
        (along, solver, (residual_dot, end_dot)), accepted = xs
        resting = jnp.zeros(slots.y.shape[1:], slots.y.dtype)
        y_dot = -solver.solve(residual_dot + along(state_dot, resting)[0])
        end = jax.tree.map(jnp.add, end_dot, along(state_dot, y_dot)[1])
        end = jax.tree.map(partial(jnp.where, accepted), end, state_dot)
        return end, (end, jnp.where(accepted, y_dot, 0.0))

    # Attempts that failed may hold anything: their maps are formed at rest, and then not used.
    sound = jnp.where(slots.accepted[:, None], slots.y, 0.0)
    maps = _in_chunks(prepared, (before, sound, slots.step, slots.fraction))
    last_dot, (states_dot, y_dot) = jax.lax.scan(body, state_dot, (maps, slots.accepted))
    slots_dot = jax.tree.map(_zero_tangent, slots)
    slots_dot = eqx.tree_at(lambda s: (s.states, s.y), slots_dot, (states_dot, y_dot))
    course_dot = jax.tree.map(_zero_tangent, course)
    course_dot = eqx.tree_at(lambda c: c.state, course_dot, last_dot)
    return (slots, course), (slots_dot, course_dot)
