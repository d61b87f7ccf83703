"""The public entrance: a rollout."""

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
from jaxtyping import Array

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import as_array, at_top_level, is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, Concrete, FunctionOf, of
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import STATE, State, Trajectory
from natcoord_jax.mechanics.impacts import with_mobilities
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.reading.tangent_states import handing
from natcoord_jax.stepping.admissibility import check_obeyed
from natcoord_jax.stepping.after_run import warn_of_far_turns, warn_of_uncovered
from natcoord_jax.stepping.checked import (
    INPUTS,
    STEP,
    check_state,
    checked_inputs,
    checked_step,
    warn_of_dense_steps,
)
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.room import Steps, cut, in_host_memory, room_for, with_room
from natcoord_jax.stepping.saved_states import simulated
from natcoord_jax.stepping.scheme import SCHEME, SECOND_ORDER, Scheme
from natcoord_jax.stepping.segments import Run, in_segments
from natcoord_jax.storage.archive import PATH
from natcoord_jax.system import System
from natcoord_jax.xla import one_kernel


@checked()
def simulate(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    *,
    dt: Annotated[Any, STEP],
    steps: Annotated[int | Steps | None, Whole(1) | of("nc.Steps(number, most)", Steps)] = None,
    inputs: Annotated[Any, INPUTS] = None,
    save_every: Annotated[int, Whole(1)] = 1,
    throw: Annotated[bool, FLAG] = True,
    until: Annotated[
        Callable[[State], Array] | None, FunctionOf("of the state to a number, whose sign changes", 1)
    ] = None,
    checkpoint: Annotated[bool, FLAG] = False,
    newton_tol: Annotated[float, Concrete(Number("positive"))] = TOLERANCE,
    extra_substeps: Annotated[int | None, Whole(0)] = None,
    scheme: Annotated[Scheme, SCHEME] = SECOND_ORDER,
    rtol: Annotated[Any, Number("not negative")] = None,
    atol: Annotated[Any, Number("not negative")] = None,
    progress: Annotated[bool, FLAG] = False,
    store: Annotated[str | os.PathLike | None, PATH] = None,
    resume: Annotated[bool, FLAG] = False,
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
        steps: number of steps; may be left out when `inputs` is an array. A traced one: `nc.Steps`.
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
            with error control 256 or eight a step (that there is room for). Where impacts are located each
            takes one or two; by default there are 64, or one a step. A gradient takes time for all.
        scheme: `EnergyMomentum`, by default that of order two; `VariationalMidpoint`; `Dissipative`.
        rtol: error that a substep may have, relative: steps are made in as few substeps as keep to it, of
            lengths found on the way. Inputs change at the ends of steps, states are saved there, and what
            the scheme conserves is conserved. The error is that of any row (a position or a director), with
            kicks (from order four on) also that of its velocity, by comparison with a substep twice as long.
            None: as many substeps as steps.
        atol: the same in metres (directors: 1; velocities: per second); as large as `rtol` by default.
            Derivatives hold the lengths of the substeps fixed.
        progress: show a bar with speed and time left, where a terminal or a notebook is. The run is made in
            segments, with the same states, and an interruption from the keyboard (Ctrl-C) ends it after the
            segment at hand, some quarter of a second: what was reached is returned, with the code
            INTERRUPTED. A second one raises KeyboardInterrupt as always. For calls outside of
            transformations only.
        store: file (HDF5, as "run.h5") that states are written to as they are made, in such segments; the
            trajectory that is returned reads them from there, so that memory stays bounded. `nc.load` reads
            it in another process, ParaView shows bodies and elements in it (VTKHDF). It ends with the last
            state that was reached.
        resume: go on with what is in `store`, if there is anything, after a run that was killed or
            interrupted: with the last whole segment, to the same bits.

    Returns:
        Trajectory with `steps / save_every + 1` saved states; fewer of a run that was interrupted, or that
        ended early and is in a file.

    Warns:
        UserWarning: in an eager call, of a joint that turns so far in a step that its rate and its angle tell
            different things, with the step to take: at order two from a radian on. What spins faster than
            half a turn in a step has no angle.
        And of a node in contact with a surface that has left the facets that it may touch, at a saved state.

    Raises:
        ValueError: for a wrong dt, steps, tolerance, shape of inputs or state, a state that violates a
            constraint, with its name and size, a function that cannot be seen, or impacts to locate in a run
            with error control or without contacts that have any.
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
    system = with_mobilities(system, state)
    step = checked_step(dt)
    inputs, until = Function.of(handing(inputs), state.t, state), Function.of(handing(until), state)
    bounded = steps if isinstance(steps, Steps) else None
    steps = steps.most if isinstance(steps, Steps) else steps
    checked, count = checked_inputs(system, inputs, steps, scheme.stages)
    if bounded is not None and (save_every > 1 or checkpoint or progress or store is not None):
        raise ValueError("steps: nc.Steps goes with every state saved, in one piece, without a checkpoint")
    if count % save_every:
        raise ValueError(f"save_every is {save_every}; pass a positive divisor of steps = {count}")
    tolerance = Tolerance.of(rtol, atol)
    if tolerance is not None and scheme.tableau.max_events:
        raise ValueError(
            "rtol and atol make substeps of their own lengths, and max_events of the scheme splits steps at "
            "impacts; leave out one of the two"
        )
    warn_of_dense_steps(system, scheme)
    if progress or store is not None or resume:
        run = Run(
            system, state, checked, step, tolerance, float(newton_tol), extra_substeps, until, scheme, count,
            int(save_every), checkpoint,
        )  # fmt: skip
        traced = not at_top_level(system, state, inputs, step, until)
        trajectory = _long(run, traced, progress, store, resume)
        if throw:
            system.raise_on_failure(trajectory)
        if store is None:
            warn_of_uncovered(system, trajectory)
        return trajectory
    room, made = count, None
    spare = save_every == 1 and not checkpoint and in_host_memory()
    if bounded is not None:
        made = bounded.made
    elif spare and at_top_level(system, state, inputs, step, until):
        room, made = room_for(count), as_array(count, int)
        checked = with_room(checked, count, room)
    if extra_substeps is None:
        extra_substeps = 16 if tolerance is None else max(256, 8 * room)
        if scheme.tableau.max_events:
            extra_substeps = max(64, room)
    static = (room, int(save_every), checkpoint, float(newton_tol), int(extra_substeps), until, scheme)
    arguments = system, state, checked, step, tolerance, made, None, static
    try:
        trajectory, _ = simulated(*arguments)
    except jax.errors.JaxRuntimeError as error:
        # Another version of the compiler may lack what one kernel needs.
        if not one_kernel.give_up(str(error)):
            raise
        warnings.warn(
            "the compiler cannot make one kernel of this rollout and goes on with many, which is slower: "
            f"{str(error).splitlines()[0]}; please report it with your version of jax, {jax.__version__}",
            stacklevel=2,
        )
        trajectory, _ = simulated(*arguments)
    if bounded is not None:
        trajectory = bounded.judged(trajectory)
    if count < room:
        trajectory = cut(trajectory, count)
    if throw and is_concrete(trajectory):
        system.raise_on_failure(trajectory)
    if tolerance is None:
        warn_of_far_turns(system, trajectory, step, int(save_every))
    warn_of_uncovered(system, trajectory)
    return trajectory


def _long(
    run: Run, traced: bool, progress: bool, store: str | os.PathLike | None, resume: bool
) -> Trajectory:
    """A run in segments.

    Raises:
        ValueError: within a transformation, for `resume` without a file, or a file that is there already.
    """
    if traced:
        raise ValueError("progress and store are for calls from Python, outside of jit, vmap and grad")
    path = None if store is None else Path(store)
    if path is None and resume:
        raise ValueError("resume goes on with what is in a file; pass its name as `store`")
    if path is not None and path.exists() and not resume:
        raise ValueError(f"{path} is there already; pass resume=True to go on with it, or another name")
    return in_segments(run, progress=progress, store=path, resume=resume)
