"""The rollout: steps, retries in substeps and events.

A rollout is a loop over slots; one slot is one attempt at one (sub)step. As long as every attempt succeeds,
slots are steps. A failed attempt is repeated with half the substep in the next slot; spare slots at the end
make up for it, and are not entered otherwise.

The derivative of a rollout runs along its recorded slots, see `derivative`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.failures import can_fail, result_of
from natcoord_jax.stepping.attempt import LoopCarry
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.factors import Factors
from natcoord_jax.stepping.plan import Plan, Slots
from natcoord_jax.stepping.rollout_state import RolloutProblem, RolloutState
from natcoord_jax.stepping.two_kernel_loop import TakenUp, all_slots
from natcoord_jax.system import System
from natcoord_jax.xla.one_kernel import as_one_kernel


class Ending(eqx.Module):
    """Where a rollout ended, the factors it ended with, and what another one can take up, if asked for."""

    course: RolloutState
    factors: Factors
    carried: LoopCarry | None = None


def run(
    plan: Plan,
    system: System,
    state: State,
    parameters: Any,
    dt: Array,
    tolerance: Tolerance | None,
    event: Any = None,
    steps: Int[Array, ""] | None = None,
    taken_up: TakenUp | None = None,
) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended; without derivatives (see `derivative`).

    The plan has room for its steps, of which the first are made: as many as `steps` says, or all. What is
    taken up goes on, and can be taken up in turn.
    """
    setting = RolloutProblem(
        system, parameters, dt, tolerance, plan, plan.steps if steps is None else steps, event=event
    )
    found, unpack = all_slots(setting, state, taken_up=taken_up)
    course, (states, *rest) = replace_fields(found.course, state=unpack(found.state)), found.record
    count, factors, slots = found.count, found.factors, Slots(jax.vmap(unpack)(states), *rest)
    if tolerance is not None:
        # The accepted slots only, filled up.
        order = jnp.argsort(~slots.accepted, stable=True)[: plan.steps + plan.extra]
        slots, count = jax.tree.map(lambda x: x[order], slots), jnp.sum(slots.accepted)
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
    carried = None if taken_up is None else replace_fields(found, record=())
    return slots, Ending(_judged(system, course, setting.steps), factors, carried)


def run_to_the_end(setting: RolloutProblem, state: State, kernel: Callable = as_one_kernel) -> RolloutState:
    """Where a rollout of any number of steps ends: one program for all numbers, and nothing recorded.

    Without derivatives. At most as many steps are made as the plan has.

    Args:
        setting: of the rollout.
        state: the first.
        kernel: see `all_slots`.
    """
    found, unpack = all_slots(setting, state, kernel)
    return _judged(setting.system, replace_fields(found.course, state=unpack(found.state)), setting.steps)


def _judged(system: System, course: RolloutState, steps: Any) -> RolloutState:
    """With the code of a run that used up its substeps, and no culprit in one that went well."""
    short = (course.step < steps) & ~course.stopped
    cause = int(Result.MAX_SUBSTEPS)
    if can_fail(system):
        # Substeps become ever shorter on the way to where an element is turned inside out.
        cause = jnp.where(course.worst < -1, result_of(system, -2 - course.worst), cause)
    code = jnp.where(short, cause, course.code)
    well = (code == int(Result.SUCCESSFUL)) | (code == int(Result.EVENT))
    worst = jnp.where(well, -1, course.worst)
    return eqx.tree_at(lambda c: (c.code, c.worst), course, (code, worst))
