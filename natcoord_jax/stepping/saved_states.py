"""A rollout as a trajectory: which states are saved, and the inputs and codes that go with them."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.compiled import briefly, compiled
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.native.call import as_native, fits
from natcoord_jax.reading.tangent_states import reads_velocities
from natcoord_jax.stepping.attempt import LoopCarry
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.plan import Control, Event, Plan, Slots
from natcoord_jax.stepping.rollout import run
from natcoord_jax.stepping.rollout_state import RolloutProblem
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.stepping.two_kernel_loop import TakenUp, first_carry, unknowns_of
from natcoord_jax.system import System

SEGMENT = 512
"""Longest segment of a rollout that does not save every step, or that is checkpointed."""


def segment_length(steps: int, save_every: int, checkpoint: bool) -> int:
    """Steps per segment: all, or the largest divisor that keeps saved steps and memory in step."""
    if save_every == 1 and not checkpoint:
        return steps
    limit = max(save_every, min(SEGMENT, 2 * math.isqrt(steps)) if checkpoint else SEGMENT)
    lengths = [m for m in range(save_every, limit + 1, save_every) if steps % m == 0]
    return max(lengths)


def _ends(slots: Slots, every: int, steps: int) -> Array:
    """Slots at which every `every`-th step is complete; the last slot for steps that never were."""
    wanted = jnp.arange(every, steps + 1, every)
    return jnp.minimum(jnp.searchsorted(slots.finished, wanted), slots.finished.shape[0] - 1)


def planned(
    state: State,
    inputs: Any,
    length: int,
    tolerance: float,
    extra_substeps: int,
    until: Callable | None,
    scheme: Scheme,
) -> tuple[Plan, Any, Any]:
    """What is static about so many steps, the parameters of the inputs, and the numbers of the event."""
    control, event, parameters, limit = None, None, inputs, None
    control_reads = event_reads = False
    if callable(inputs):
        control, parameters = Control.of(inputs)
        at_start = partial(control, parameters, jnp.array(0), state.t, fraction=jnp.ones(()))
        control_reads = scheme.loose and reads_velocities(lambda x: at_start(state=x), state)
    if until is not None:
        event, limit = Event.of(until)
        event_reads = scheme.loose and reads_velocities(partial(event, limit), state)
    plan = Plan(
        length, extra_substeps, tolerance, control, event, scheme.tableau,
        control_reads=control_reads, event_reads=event_reads,
    )  # fmt: skip
    return plan, parameters, limit


def _inputs_of_step(plan: Plan, system: System, parameters: Any, step: Array, before: State) -> Array:
    """Inputs of a whole step that starts at a state."""
    return plan.inputs(system, parameters, step, before, jnp.zeros(()), jnp.ones(()))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _by_machine_code(plan: Plan, *arguments: Any) -> Array:
    """The same, where a function of the user's is what the step itself calls."""
    return as_native(lambda function, *given: function(*given), partial(_inputs_of_step, plan), *arguments)


@_by_machine_code.defjvp
def _by_machine_code_jvp(plan: Plan, arguments: tuple, tangents: tuple) -> tuple[Array, Array]:
    return jax.jvp(partial(_inputs_of_step, plan), arguments, tangents)


@briefly
def nothing_before(
    system: System, state: State, inputs: Any, dt: Array, tolerance: Tolerance | None, static: Any
) -> TakenUp:
    """What a run takes up that begins anew: zeros; what is static is as in `planned`."""
    plan, parameters, limit = planned(state, inputs, *static)
    setting = RolloutProblem(system, parameters, dt, tolerance, plan, static[0], event=limit)
    shapes = jax.eval_shape(partial(first_carry, setting), state)
    return TakenUp(jnp.array(True), jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))


def rollout(
    system: System,
    state: State,
    inputs: Any,
    dt: Array,
    steps: int,
    save_every: int,
    checkpoint: bool,
    tolerance: float,
    extra_substeps: int,
    until: Callable | None,
    scheme: Scheme,
    *,
    allowed: Tolerance | None,
    made: Array | None,
    taken_up: TakenUp | None = None,
) -> tuple[Trajectory, LoopCarry | None]:
    """A rollout and, if it takes up another one (then of one segment), what the next can take up."""
    length, tableau = segment_length(steps, save_every, checkpoint), scheme.tableau
    plan, parameters, limit = planned(state, inputs, length, tolerance, extra_substeps, until, scheme)
    if plan.control is None:
        pieces = parameters.reshape(steps // length, length, *parameters.shape[1:])
    else:
        pieces = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps // length, *x.shape)), parameters)

    def segment(carry, parameters):
        state, code, failed = carry
        given = plan, system, state, parameters, dt, allowed, limit, made
        slots, ending = run_slots(*given) if taken_up is None else run(*given, taken_up)
        course = ending.course
        running = code == int(Result.SUCCESSFUL)
        keep = partial(jnp.where, running)
        picked = _ends(slots, save_every, length)
        saved = jax.tree.map(lambda x: x[picked], slots.states)
        if steps != length:
            saved = jax.tree.map(lambda x, s: jnp.where(running, x, s), saved, state)
        after = jax.tree.map(keep, course.state, state)
        starts = jax.tree.map(lambda one, x: jnp.concatenate([one[None], x])[picked], state, slots.states)
        # Beyond the end of a run that failed there are the inputs of the step that failed.
        beyond = jnp.arange(save_every, length + 1, save_every) > course.step
        number = jnp.where(beyond, jnp.minimum(course.step, length - 1), slots.step[picked])
        starts = jax.tree.map(
            lambda x, last: jax.vmap(jnp.where, (0, None, 0))(beyond, last, x), starts, course.state
        )
        native = plan.control is not None and fits(unknowns_of(plan, system))
        given = _by_machine_code if native else _inputs_of_step
        used = jax.vmap(partial(given, plan, system, parameters))(number, starts)
        if used.ndim == 3:
            used = jnp.einsum("j,kji->ki", jnp.asarray(tableau.b), used)
        code = keep(course.code, code)
        worst = keep(course.worst, failed[2])
        failed = (failed[0] + jnp.where(running, course.step, 0), keep(course.state.t, failed[1]), worst)
        counts = (
            course.residual, course.taken, course.rejected, course.iterations, course.iterations_max
        )  # fmt: skip
        counts = jax.tree.map(lambda x: jnp.where(running, x, jnp.zeros_like(x)), counts)
        return (after, code, failed), (saved, used, counts, ending.carried)

    nought = jnp.array(0)
    first = (state, nought, (nought, state.t, nought - 1))
    if checkpoint:
        segment = jax.checkpoint(segment)
    if steps == length:
        carry, outputs = segment(first, jax.tree.map(lambda x: x[0], pieces))
        outputs = jax.tree.map(lambda x: x[None], outputs)
    else:
        carry, outputs = jax.lax.scan(segment, first, pieces)
    _, code, (failed_step, failed_time, worst) = carry
    saved, used, (residual, taken, rejected, iterations, iterations_max), carried = outputs
    states = jax.tree.map(
        lambda x0, x: jnp.concatenate([x0[None], x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])]),
        state,
        saved,
    )
    trajectory = Trajectory(
        states,
        used.reshape(used.shape[0] * used.shape[1], used.shape[2]),
        code,
        failed_step,
        failed_time,
        worst,
        jnp.max(residual),
        jnp.sum(taken),
        jnp.sum(rejected),
        jnp.sum(iterations),
        jnp.max(iterations_max),
        scheme,
    )
    return trajectory, None if carried is None else jax.tree.map(lambda x: x[0], carried)


@compiled
def simulated(
    system: System,
    state: State,
    inputs: Any,
    dt: Array,
    tolerance: Tolerance | None,
    made: Array | None,
    taken_up: TakenUp | None,
    static: Any,
) -> tuple[Trajectory, Any]:
    """The rollout, compiled; what is static is what lies between step and tolerance there."""
    return rollout(system, state, inputs, dt, *static, allowed=tolerance, made=made, taken_up=taken_up)
