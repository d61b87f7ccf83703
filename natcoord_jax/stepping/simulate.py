"""The public entrance: a rollout."""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.assembly.reading import handing, reads_velocities
from natcoord_jax.assembly.system import SYSTEM, System
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import as_array, at_top_level, is_concrete
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import STATE, State, Trajectory
from natcoord_jax.stepping import one_kernel
from natcoord_jax.stepping.admissibility import check_obeyed
from natcoord_jax.stepping.checked import INPUTS, STEP, check_state, checked_inputs, checked_step
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Control, Event, Plan, Slots
from natcoord_jax.stepping.room import cut, in_host_memory, room_for, with_room
from natcoord_jax.stepping.scheme import SCHEME, SECOND_ORDER, Scheme
from natcoord_jax.stepping.turns import warn_of_far_turns

SEGMENT = 512
"""Longest segment of a rollout that does not save every step, or that is checkpointed."""


def _segments(steps: int, save_every: int, checkpoint: bool) -> int:
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


def _rollout(
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
) -> Trajectory:
    tableau, control_reads = scheme.tableau, False
    length = _segments(steps, save_every, checkpoint)
    if callable(inputs):
        control, every_segment = Control.of(inputs)
        at_start = partial(control, every_segment, jnp.array(0), state.t, fraction=jnp.ones(()))
        control_reads = scheme.loose and reads_velocities(lambda x: at_start(state=x), state)
        pieces = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps // length, *x.shape)), every_segment)
    else:
        control, pieces = None, inputs.reshape(steps // length, length, *inputs.shape[1:])
    event, limit = (None, None) if until is None else Event.of(until)
    event_reads = scheme.loose and event is not None and reads_velocities(partial(event, limit), state)
    plan = Plan(
        length, extra_substeps, tolerance, control, event, tableau,
        control_reads=control_reads, event_reads=event_reads,
    )  # fmt: skip

    def segment(carry, parameters):
        state, code, failed = carry
        slots, ending = run_slots(plan, system, state, parameters, dt, allowed, limit, made)
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
        whole = jnp.zeros(()), jnp.ones(())
        used = jax.vmap(lambda k, s: plan.inputs(system, parameters, k, s, *whole))(number, starts)
        if used.ndim == 3:
            used = jnp.einsum("j,kji->ki", jnp.asarray(tableau.b), used)
        code = keep(course.code, code)
        worst = keep(course.worst, failed[2])
        failed = (failed[0] + jnp.where(running, course.step, 0), keep(course.state.t, failed[1]), worst)
        counts = (
            course.residual, course.taken, course.rejected, course.iterations, course.iterations_max
        )  # fmt: skip
        counts = jax.tree.map(lambda x: jnp.where(running, x, jnp.zeros_like(x)), counts)
        return (after, code, failed), (saved, used, counts)

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
    saved, used, (residual, taken, rejected, iterations, iterations_max) = outputs
    states = jax.tree.map(
        lambda x0, x: jnp.concatenate([x0[None], x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])]),
        state,
        saved,
    )
    return Trajectory(
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


@compiled
def _simulate(
    system: System,
    state: State,
    inputs: Any,
    dt: Array,
    tolerance: Tolerance | None,
    made: Array | None,
    static: Any,
) -> Trajectory:
    return _rollout(system, state, inputs, dt, *static, allowed=tolerance, made=made)


@checked(
    system=SYSTEM,
    state=STATE,
    dt=STEP,
    steps=Whole(1),
    inputs=INPUTS,
    save_every=Whole(1),
    throw=FLAG,
    until=FunctionOf("of the state to a number, whose sign changes"),
    checkpoint=FLAG,
    newton_tol=Number("positive"),
    extra_substeps=Whole(0),
    scheme=SCHEME,
    rtol=Number("not negative"),
    atol=Number("not negative"),
)
def simulate(
    system: System,
    state: State,
    *,
    dt: Any,
    steps: int | None = None,
    inputs: Any = None,
    save_every: int = 1,
    throw: bool = True,
    until: Callable[[State], Array] | None = None,
    checkpoint: bool = False,
    newton_tol: float = TOLERANCE,
    extra_substeps: int | None = None,
    scheme: Scheme = SECOND_ORDER,
    rtol: Any = None,
    atol: Any = None,
) -> Trajectory:
    """Simulate with the energy-momentum step (57), its relatives of higher order, or another scheme.

    Works under `jit`, `vmap`, `grad`, `jvp` and their compositions up to one reverse mode; `dt` and every
    floating leaf of `system`, `state` and `inputs` can be differentiated. Derivatives are exact where the
    motion changes suddenly, too; where the linear system of a step cannot be solved they are NaN, in every
    mode, though the run itself went well; outside of any `jit` that raises a `DerivativeError`.

    Functions (inputs, `until`, drives, loads, laws) and methods of effects of one's own are traced at each
    call from Python: whatever they read is as it is then, and another number, also a function made anew,
    compiles nothing. A number inside of a branch or a loop (`jax.lax.cond`, `scan`) or a changed formula
    compile once. What is inside of a `jax.jit` of one's own is as JAX has kept it. A function that gives
    something else when it is called again, or has a rule by `jax.custom_vjp`, is refused.

    Args:
        system: compiled system.
        state: initial state; its positions must obey joints, drives and couplings (looked at where there
            are any of the latter or loops, in calls that are not being traced), its velocities should; see
            `assemble`. The run starts at its time: `Scene.compile(t=...)` and `State.at_time` set another
            than zero.
        dt: step [s].
        steps: number of steps; may be left out when `inputs` is an array.
        inputs: array (steps, inputs) [N, N m], held over each step; (inputs,) for constant ones; or a
            function (t, state) -> (inputs,), evaluated at the start of each (sub)step, for which velocities
            obey the constraints (see `System.tangent`). None: zero. Held inputs that stand for smooth ones
            limit the order to two: give an array (steps, stages, inputs) at the times `scheme.times` instead.
        save_every: save every so many steps; must divide `steps`.
        throw: raise on failure when called eagerly; inside jit, vmap or grad nothing is raised, see
            `Trajectory.result` and `System.explain`.
        until: terminal event, a function of the state, given like that of `inputs`; the run stops after the
            step in which its sign changes, and later states repeat the last one. Derivatives hold that step
            fixed.
        checkpoint: recompute in the backward pass: memory of a gradient grows with the root of `steps`.
        newton_tol: accuracy of Newton's iteration relative to the terms of the equations. The default is
            the floor of round-off; larger values are faster and let energy and momentum drift in proportion.
        extra_substeps: how many substeps may be made beyond one a step (per segment of at most 512 steps
            where not every step is saved); by default 16, for steps that fail and are repeated in parts, and
            with error control 256 or eight a step (that there is room for). A gradient takes time for all.
        scheme: `EnergyMomentum`, by default that of order two; `VariationalMidpoint`; `Dissipative`.
        rtol: error that a substep may have, relative: steps are made in as few substeps as keep to it, of
            lengths found on the way. Inputs change at the ends of steps, states are saved there, and what
            the scheme conserves is conserved. The error is that of any row (a position or a director), with
            kicks (from order four on) also that of its velocity, by comparison with a substep twice as long.
            None: as many substeps as steps.
        atol: the same in metres (directors: 1; velocities: per second); as large as `rtol` by default.
            Derivatives hold the lengths of the substeps fixed.

    Returns:
        Trajectory with `steps / save_every + 1` saved states.

    Warns:
        UserWarning: in an eager call, of a joint that turns so far in a step that its rate and its angle tell
            different things, with the step to take: at order two from a radian on. What spins faster than
            half a turn in a step has no angle.

    Raises:
        ValueError: for a wrong dt, steps, tolerance, shape of inputs or state, a state that violates a
            constraint, with its name and size, or a function that cannot be seen.
        SimulationError: if the run fails and `throw` holds; it carries the trajectory computed so far.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=10)
        >>> trajectory.q.shape
        (11, 4, 3)
    """
    check_state(system, state)
    check_obeyed(system, state)
    state = scheme.started(replace_fields(state, held=None))
    step = checked_step(dt)
    inputs, until = Function.of(handing(inputs), state.t, state), Function.of(handing(until), state)
    checked, count = checked_inputs(system, inputs, steps, scheme.stages)
    if count % save_every:
        raise ValueError(f"save_every is {save_every}; pass a positive divisor of steps = {count}")
    tolerance = Tolerance.of(rtol, atol)
    room, made = count, None
    spare = save_every == 1 and not checkpoint and in_host_memory()
    if spare and at_top_level(system, state, inputs, step, until):
        room, made = room_for(count), as_array(count, int)
        checked = with_room(checked, count, room)
    if extra_substeps is None:
        extra_substeps = 16 if tolerance is None else max(256, 8 * room)
    static = (room, int(save_every), checkpoint, newton_tol, int(extra_substeps), until, scheme)
    try:
        trajectory = _simulate(system, state, checked, step, tolerance, made, static)
    except jax.errors.JaxRuntimeError as error:
        # Another version of the compiler may lack what one kernel needs.
        if not one_kernel.give_up(str(error)):
            raise
        warnings.warn(
            "the compiler cannot make one kernel of this rollout and goes on with many, which is slower: "
            f"{str(error).splitlines()[0]}; please report it with your version of jax, {jax.__version__}",
            stacklevel=2,
        )
        trajectory = _simulate(system, state, checked, step, tolerance, made, static)
    if count < room:
        trajectory = cut(trajectory, count)
    if throw and is_concrete(trajectory.result):
        system.raise_on_failure(trajectory)
    if tolerance is None:
        warn_of_far_turns(system, trajectory, step, int(save_every))
    return trajectory
