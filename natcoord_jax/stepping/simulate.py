"""The public entrances: one step, and a rollout."""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import System
from natcoord_jax.core.checks import at_top_level, is_concrete
from natcoord_jax.core.results import REASONS, REMEDIES, Result, SimulationError
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.stepping import one_kernel
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.rollout import Plan, Slots
from natcoord_jax.stepping.scheme import SECOND_ORDER, EnergyMomentum

SEGMENT = 512
"""Longest segment of a rollout that does not save every step, or that is checkpointed."""


def _checked_step(dt: Any) -> Float[Array, ""]:
    step = jnp.asarray(dt, float)
    if step.shape != ():
        raise ValueError(f"dt [s] must be a scalar, not of shape {step.shape}; use jax.vmap for several")
    if is_concrete(step) and not (np.isfinite(float(step)) and float(step) > 0):
        raise ValueError(f"dt [s] is {float(step)}; pass a positive finite step")
    return step


def _checked_inputs(system: System, inputs: Any, steps: int | None, stages: int = 1) -> tuple[Any, int]:
    """Inputs as an array (steps, [stages,] inputs) or a callable, and the number of steps."""
    names = system.structure.inputs
    if steps is not None and (not isinstance(steps, int | np.integer) or steps < 1):
        raise ValueError(f"steps is {steps!r}; pass a positive integer")
    if callable(inputs):
        if steps is None:
            raise ValueError("pass steps when inputs is a function of (t, state)")
        return inputs, int(steps)
    if inputs is None:
        if steps is None:
            raise ValueError("pass steps, or inputs of shape (steps, inputs)")
        return jnp.zeros((steps, len(names))), int(steps)
    array = jnp.asarray(inputs, float)
    if array.shape == (len(names),) and steps is not None:
        array = jnp.broadcast_to(array, (steps, len(names)))
    counted = array.shape[0] if array.ndim else 0
    shapes = (len(names),), (stages, len(names))
    if array.shape[1:] not in shapes or counted != (steps or counted) or counted == 0:
        first = steps if steps is not None else "steps"
        wanted = f"({first}, {len(names)})" + f" or ({first}, {stages}, {len(names)})" * (stages > 1)
        raise ValueError(
            f"inputs has shape {array.shape}; this system has the input channels {list(names)}: pass shape "
            f"{wanted}, or a function (t, state) -> ({len(names)},)"
        )
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError("inputs has numbers that are not finite; pass finite forces [N] and torques [N m]")
    return array, int(array.shape[0])


def _check_state(system: System, state: State) -> None:
    expected = 4 * len(system.structure.bodies)
    if state.q.shape != (expected, 3) or state.v.shape != (expected, 3):
        raise ValueError(
            f"state.q has shape {state.q.shape}, state.v {state.v.shape}; this system has shape "
            f"({expected}, 3); use the state that `compile` returned with the system, jax.vmap for several"
        )
    single = {str(x.dtype) for x in (system.mass, state.q, state.v) if x.dtype != jnp.float64}
    if single:
        raise ValueError(
            f"system or state has numbers of type {', '.join(sorted(single))}; natcoord_jax needs double "
            "precision: use the system and state that `compile` returned, and cast results instead"
        )


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
    scheme: EnergyMomentum,
) -> Trajectory:
    tableau = scheme.tableau
    length = _segments(steps, save_every, checkpoint)
    if callable(inputs):
        # A policy may be a module with numbers of its own, which has no hash while it is traced.
        policy, constants = jax.closure_convert(lambda t, state: inputs(t, state), state.t, state)
        control, every_segment = partial(_by_policy, policy), constants
        pieces = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps // length, *x.shape)), every_segment)
    else:
        control, pieces = None, inputs.reshape(steps // length, length, *inputs.shape[1:])
    plan = Plan(length, extra_substeps, tolerance, control, until, tableau)

    def segment(carry, parameters):
        state, code, failed = carry
        slots, ending = run_slots(plan, system, state, parameters, dt)
        course = ending.course
        running = code == int(Result.SUCCESSFUL)
        keep = partial(jnp.where, running)
        picked = _ends(slots, save_every, length)
        saved = jax.tree.map(lambda x: x[picked], slots.states)
        if steps != length:
            saved = jax.tree.map(lambda x, s: jnp.where(running, x, s), saved, state)
        after = jax.tree.map(keep, course.state, state)
        starts = jax.tree.map(lambda x: x[jnp.maximum(picked - 1, 0)], slots.states)
        whole = jnp.zeros(()), jnp.ones(())
        used = jax.vmap(lambda k, s: plan.inputs(parameters, slots.step[k], s, *whole))(picked, starts)
        if used.ndim == 3:
            used = jnp.einsum("j,kji->ki", jnp.asarray(tableau.b), used)
        code = keep(course.code, code)
        worst = keep(course.worst, failed[2])
        failed = (failed[0] + jnp.where(running, course.step, 0), keep(course.state.t, failed[1]), worst)
        counts = (course.residual, course.taken, course.iterations, course.iterations_max)
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
    saved, used, (residual, taken, iterations, iterations_max) = outputs
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
        jnp.sum(iterations),
        jnp.max(iterations_max),
        scheme,
    )


def _by_policy(
    policy: Callable, constants: Any, step: Array, t: Array, state: State, fraction: Array
) -> Array:
    return jnp.asarray(policy(t, state, *constants), float)


def _compiled(system, state, inputs, dt, static):
    return _rollout(system, state, inputs, dt, *static)


QUICK = {"xla_cpu_use_fusion_emitters": False}
"""Option of the CPU compiler: a third less time to compile, for programs that run as fast. JAX accepts
options at the outermost call only."""

_compiled_quickly = eqx.filter_jit(_compiled, compiler_options=QUICK)  # pyright: ignore[reportCallIssue]
_compiled_within = eqx.filter_jit(_compiled)


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
    extra_substeps: int = 16,
    scheme: EnergyMomentum = SECOND_ORDER,
) -> Trajectory:
    """Simulate with the energy-momentum step (57), or with its relatives of higher order.

    Works under `jit`, `vmap`, `grad`, `jvp` and their compositions up to one reverse mode; `dt` and every
    floating leaf of `system`, `state` and `inputs` can be differentiated.

    Args:
        system: compiled system.
        state: initial state; its velocities should obey the constraints (see `assemble`).
        dt: step [s].
        steps: number of steps; may be left out when `inputs` is an array.
        inputs: array (steps, inputs) [N, N m], held over each step; (inputs,) for constant ones; or a
            function (t, state) -> (inputs,), evaluated at the start of each (sub)step. None: zero. Held
            inputs that stand for smooth ones limit the order to two: give an array (steps, stages, inputs)
            at the times `scheme.times` instead.
        save_every: save every so many steps; must divide `steps`.
        throw: raise on failure when called eagerly; inside jit, vmap or grad nothing is raised, see
            `Trajectory.result` and `System.explain`.
        until: terminal event, a function of the state; the run stops after the step in which its sign
            changes, and later states repeat the last one. Derivatives hold that step fixed.
        checkpoint: recompute in the backward pass: memory of a gradient grows with the root of `steps`.
        newton_tol: accuracy of Newton's iteration relative to the terms of the equations. The default is
            the floor of round-off; larger values are faster and let energy and momentum drift in proportion.
        extra_substeps: how many substeps may be spent on steps that fail and are repeated with half the
            substep (per segment of at most 512 steps where not every step is saved).
        scheme: the scheme, by default that of order two.

    Returns:
        Trajectory with `steps / save_every + 1` saved states.

    Raises:
        ValueError: for a wrong dt, steps, shape of inputs or state.
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
    _check_state(system, state)
    step = _checked_step(dt)
    checked, count = _checked_inputs(system, inputs, steps, scheme.stages)
    if save_every < 1 or count % save_every:
        raise ValueError(f"save_every is {save_every}; pass a positive divisor of steps = {count}")
    static = (count, int(save_every), checkpoint, newton_tol, int(extra_substeps), until, scheme)
    arrays = eqx.filter((system, state, checked, step), eqx.is_array)
    outermost = at_top_level(arrays) and jax.default_backend() == "cpu"
    compiled = _compiled_quickly if outermost else _compiled_within
    try:
        trajectory = compiled(system, state, checked, step, static)
    except jax.errors.JaxRuntimeError as error:
        # Another version of the compiler may lack what one kernel needs.
        if not one_kernel.give_up(str(error)):
            raise
        warnings.warn(
            "the compiler cannot make one kernel of this rollout and goes on with many, which is slower: "
            f"{str(error).splitlines()[0]}; please report it with your version of jax, {jax.__version__}",
            stacklevel=2,
        )
        trajectory = compiled(system, state, checked, step, static)
    if throw and is_concrete(trajectory.result):
        system.raise_on_failure(trajectory)
    return trajectory


@eqx.filter_jit
def _one_step(system, state, u, dt, tolerance, extra, tableau):
    plan = Plan(1, extra, tolerance, None, None, tableau)
    course = run_slots(plan, system, state, u[None], dt)[1].course
    return course.state, course.code


def step(
    system: System,
    state: State,
    u: Any = None,
    dt: Any = None,
    *,
    newton_tol: float = TOLERANCE,
    scheme: EnergyMomentum = SECOND_ORDER,
) -> State:
    """One energy-momentum step (57), differentiable in everything.

    Args:
        system: compiled system.
        state: state at the start.
        u: inputs held over the step, shape (inputs,) [N, N m]; None: zero.
        dt: step [s].
        newton_tol: see `simulate`.
        scheme: see `simulate`.

    Returns:
        State at the end; all NaN if the step failed (an eager call raises instead).

    Raises:
        ValueError: for a wrong dt or shape.
        SimulationError: if the step fails in an eager call.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(1.0, 0, 0)))
        >>> system, state = scene.compile()
        >>> float(nc.step(system, state, dt=0.5).q[0, 0])
        0.5
    """
    _check_state(system, state)
    h = _checked_step(dt)
    inputs, _ = _checked_inputs(system, None if u is None else jnp.asarray(u, float)[None], 1)
    after, code = _one_step(system, state, inputs[0], h, newton_tol, 16, scheme.tableau)
    if is_concrete(code):
        result = Result(int(code))
        if not result.ok:
            raise SimulationError(f"step failed: {REASONS[result]}; {REMEDIES[result]}", result, after)
        return after
    return jax.tree.map(lambda x: jnp.where(code == 0, x, jnp.nan), after)


def linearise(
    system: System, state: State, u: Any = None, dt: Any = None
) -> tuple[Float[Array, "n n"], Float[Array, "n inputs"]]:
    """Derivatives of one step with respect to state and inputs.

    Args:
        system: compiled system.
        state: state at the start.
        u: inputs held over the step, shape (inputs,).
        dt: step [s].

    Returns:
        A and B: A is a matrix over the flattened (q, v, coordinates) of the state, shape (n, n); B has shape
        (n, inputs). Rows and columns are redundant coordinates; only tangent directions are meaningful.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0)))
        >>> system, state = scene.compile()
        >>> A, B = nc.linearise(system, state, dt=0.5)
        >>> A.shape, B.shape
        ((24, 24), (24, 0))
    """
    inputs, _ = _checked_inputs(system, None if u is None else jnp.asarray(u, float)[None], 1)
    shapes = [x.shape for x in (state.q, state.v, state.coordinates)]
    sizes = np.cumsum([math.prod(s) for s in shapes])[:-1]

    def flat(x: Array, u: Array) -> Array:
        parts = [p.reshape(s) for p, s in zip(jnp.split(x, sizes), shapes)]
        moved = eqx.tree_at(lambda s: (s.q, s.v, s.coordinates), state, tuple(parts))
        after = step(system, moved, u, dt)
        return jnp.concatenate([after.q.reshape(-1), after.v.reshape(-1), after.coordinates])

    x = jnp.concatenate([state.q.reshape(-1), state.v.reshape(-1), state.coordinates])
    return jax.jacfwd(flat, argnums=(0, 1))(x, inputs[0])
