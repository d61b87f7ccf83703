"""Local errors of the steps of a solution: of the motion, and of inputs that are held over each step.

Every step is made again in two halves. The two differ by three quarters of the error of the step, for a
scheme of order two, as in the control of substeps (`stepping.error_control`). Where inputs are decided for
every step, the halves get what the optimal inputs would be in them: on each side of a jump what is on its
side, as in A. Harten, "ENO schemes with subcell resolution", J. Comput. Phys. 83 (1989) 148-184, else the
line with the smaller of the slopes beside. Their mean stays. So the error of a smooth input falls with the
cube of the step as that of the motion does, and that of a switch within a step with its square.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.refinement import marks
from natcoord_jax.control.tangent import steady_rates
from natcoord_jax.control.transcription import held_inputs, slices, times_of, unpacked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.state import State
from natcoord_jax.model.tree import SLOTS
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.system import System

FLAT = 5.0
"""Least jump within a step, in terms of what the history beside changes over a step."""
QUIET = 1e-12
"""Rates below which there is nothing to be relative to, in lengths of the motion per whole time."""


class LocalErrors(NamedTuple):
    """Local errors of a solution.

    Attributes:
        steps: largest error of each step, relative; infinite where a half of it has no solution.
        jumps: part of a step that goes by before an input jumps in it; NaN where none does (steps, inputs).
        order: the power of a step, less one, with which its error falls: that of the scheme, or two where
            inputs are held over each step or no kicks keep velocities on the constraints.
    """

    steps: Float[np.ndarray, " steps"]
    jumps: Float[np.ndarray, "steps inputs"]
    order: int


class Scales(NamedTuple):
    """What errors are relative to.

    Attributes:
        rows: of points the largest extent of scene and motion [m], of directors one.
        rates: of the free motions the largest of its kind along the motion [m/s, rad/s].
    """

    rows: Float[Array, "rows 1"]
    rates: Float[Array, " n"]


def local_errors(problem: OptimalControl, iterate: Iterate) -> LocalErrors:
    """Local errors of all steps.

    Positions are relative to the largest extent of the scene along the motion, directors to one, rates of
    free motions to the largest of their kind along the motion. (Velocities have a part along the normals of
    the constraints that changes its sign from step to step, so that these are compared.)

    Args:
        problem: the problem.
        iterate: where the method ended.
    """
    unknowns = iterate.unknowns
    inputs = np.asarray(held_inputs(problem, unknowns.coefficients))
    size = np.asarray(problem.lengths(unknowns.free))
    means = inputs if inputs.ndim == 2 else inputs[:, 0]
    changes, jumps = np.zeros_like(means), np.full_like(means, np.nan)
    # What a spline is within a step its stages say.
    if problem.inputs.every == 1 and (problem.stages == 1 or not problem.inputs.degree):
        for first, last in sections(problem):
            here = slice(first, last)
            changes[here], jumps[here] = changes_within(means[here], size[here])
    nodes = iterate.path.nodes.x
    found = _compared(problem, unknowns.free, nodes, jnp.asarray(inputs), jnp.asarray(changes))
    return LocalErrors(np.asarray(found), jumps, _order(problem))


def _order(problem: OptimalControl) -> int:
    """See `LocalErrors`."""
    smooth = problem.inputs.degree > 0 or problem.inputs.every > 1
    return problem.scheme.order if smooth and problem.scheme.tableau.kick else 2


def sections(problem: OptimalControl) -> list[tuple[int, int]]:
    """First step, and the one after the last, of pieces between ends of phases and marks."""
    ends = sorted({*np.cumsum([0, *problem.phases]).tolist(), *marks(problem)})
    return list(zip(ends[:-1], ends[1:]))


def changes_within(
    values: Float[np.ndarray, "steps m"], size: Float[np.ndarray, " steps"]
) -> tuple[np.ndarray, np.ndarray]:
    """How a history that is known by its means changes within steps.

    Returns:
        Half of what the second half of each step has more than the first; and where it jumps, see
        `LocalErrors`.
    """
    count, found, places = len(values), np.zeros_like(values), np.full_like(values, np.nan)
    if count < 2:
        return found, places
    middle = np.cumsum(size) - 0.5 * size
    slope = np.diff(values, axis=0) / np.diff(middle)[:, None]
    for k in range(count):
        inner = 0 < k < count - 1
        # Lines through the two steps on each side; at the ends through the step itself.
        left, right = (max(k - 2, 0), min(k + 1, count - 2)) if inner else [min(k, count - 2)] * 2
        before = values[left + 1] + slope[left] * (middle[k] - middle[left + 1])
        after = values[right] + slope[right] * (middle[k] - middle[right])
        steepest = np.minimum(np.abs(slope[left]), np.abs(slope[right]))
        tilt = np.where(slope[left] * slope[right] > 0, np.sign(slope[left]) * steepest, 0.0)
        tilt = 0.25 * size[k] * tilt
        jump = after - before if inner else np.zeros_like(after)
        part = np.where(jump != 0, (after - values[k]) / np.where(jump != 0, jump, 1.0), 0.0)
        part = np.clip(part, 0.0, 1.0)
        jumped = jump * np.minimum(part, 1.0 - part)
        found[k] = tilt + jumped
        steeper = size[k] * np.maximum(np.abs(slope[left]), np.abs(slope[right]))
        places[k] = np.where((np.abs(jump) > FLAT * steeper) & (jumped != 0), part, np.nan)
    return found, places


@compiled
def _compared(problem: OptimalControl, free: Array, nodes: Array, inputs: Array, changes: Array) -> Array:
    system, _ = problem.applied(free)
    order = _order(problem)
    plan = Plan(2, 0, TOLERANCE, None, tableau=problem.scheme.tableau)

    def state_of(x: Array, t: Array) -> State:
        return unpacked(problem.state, x, t)

    begin, size, _ = jax.vmap(lambda at: times_of(problem, free, at))(slices(problem))
    before, after = (jax.vmap(state_of)(x, begin) for x in (nodes[:-1], nodes[1:]))
    if inputs.ndim == 3:
        changes = changes[:, None]
    pieces = []
    for begun, sign in ((0.0, -1.0), (0.5, 1.0)):
        within = jax.vmap(lambda u, begun=begun: plan.within_step(u, jnp.asarray(begun), jnp.asarray(0.5)))
        pieces.append(within(inputs) + sign * changes)
    halves = jnp.stack(pieces, axis=1)

    def one(before: State, u: Array, dt: Array) -> tuple[State, Array]:
        slots, ending = run_slots(plan, system, before, u, 0.5 * dt)
        whole = (ending.course.code == 0) & jnp.all(slots.accepted) & jnp.all(slots.fraction == 1.0)
        return ending.course.state, whole

    fine, whole = jax.vmap(one)(before, halves, size)
    states = jax.vmap(state_of, in_axes=(0, None))(nodes, problem.state.t)
    scales = _scales(system, states, jnp.sum(size))
    over = 2.0**order / (2.0**order - 1.0)
    rows = jnp.linalg.norm(after.q - fine.q, axis=-1, keepdims=True) / scales.rows
    found = jnp.max(rows, axis=(1, 2), initial=0.0)
    if problem.system.structure.solver == "reduced":
        rates = [jax.vmap(lambda s: steady_rates(system, s))(states) for states in (after, fine)]
        found = jnp.maximum(found, jnp.max(jnp.abs(rates[0] - rates[1]) / scales.rates, axis=1, initial=0.0))
    return jnp.where(whole & jnp.isfinite(found), over * found, jnp.inf)


def _scales(system: System, states: State, duration: Array) -> Scales:
    """Scales of the errors along a motion."""
    points = states.rows[:, :, 0]
    extent = jnp.max(jnp.max(points, axis=(0, 1)) - jnp.min(points, axis=(0, 1)))
    extent = jnp.where(extent > 0, extent, 1.0)
    each = jnp.ones(points.shape[1:2] + (4,)).at[:, 0].set(extent)
    if system.structure.solver != "reduced":
        return Scales(each.reshape(-1, 1), jnp.ones(0))
    rates = jnp.max(jnp.abs(jax.vmap(lambda s: steady_rates(system, s))(states)), axis=0)
    slot = system.tree.slot_of % SLOTS
    along = (slot >= 3) & (slot < 6)
    least = QUIET / duration
    kinds = [jnp.max(jnp.where(kind, rates, 0.0), initial=0.0) for kind in (along, ~along)]
    speed, turning = jnp.maximum(kinds[0], least * extent), jnp.maximum(kinds[1], least)
    return Scales(each.reshape(-1, 1), jnp.where(along, speed, turning))
