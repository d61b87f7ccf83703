"""All that the hunt for wrong derivatives takes from inside of the engine.

Whoever rebuilds the engine ports this file: it says how a rollout is recorded slot by slot, what equations
one slot solves, and which velocities constraints admit.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

import natcoord_jax as nc
from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity
from natcoord_jax.mechanics.violations import contacts
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Event, Plan, Slots
from natcoord_jax.stepping.step import advance

__all__ = [
    "Plan",
    "Slots",
    "admitted",
    "contacts",
    "coordinate_rates",
    "inputs_of",
    "outcome",
    "plan_of",
    "record",
]


def plan_of(
    scheme: Any, steps: int, extra: int, until: Callable[[nc.State], Array] | None, policy: bool
) -> Plan:
    """What is static about a rollout; hashable, and opaque to others.

    Args:
        scheme: that makes the steps.
        steps: number of steps.
        extra: slots for retries.
        until: event.
        policy: whether inputs are a policy (t, state) instead of an array.
    """
    event = None if until is None else Event.of(until)[0]
    return Plan(steps, extra, TOLERANCE, _policy if policy else None, event, scheme.tableau)


def _policy(parameters: Any, step: Any, t: Any, state: nc.State, fraction: Any) -> Any:
    return parameters(t, state)


def record(
    plan: Plan, system: nc.System, state: nc.State, inputs: Any, dt: Array, rtol: float | None
) -> tuple[Slots, Array]:
    """The record of a rollout, differentiable in every mode, and its result.

    Of every slot: `states` after it, unknowns `y`, its `step`, the part `done` of it before and the
    `fraction` that it takes, whether it is `accepted`, and steps `finished` after it.
    """
    slots, ending = run_slots(plan, system, state, inputs, dt, Tolerance.of(rtol, None))
    return slots, ending.course.code


def inputs_of(plan: Plan, inputs: Any, state: nc.State, slot: Slots) -> Array:
    """Inputs within one slot that starts at a state."""
    if callable(inputs):
        return inputs(state.t, state)
    return plan.within_step(inputs[slot.step], slot.done, slot.fraction)


def outcome(
    plan: Plan, system: nc.System, state: nc.State, u: Array, h: Array, y: Array
) -> tuple[Array, nc.State]:
    """Residual of the equations of a step of length h at unknowns y, and the state at its end."""
    return advance(system, state, u, h, y, plan.tableau)[:2]


@eager_numpy
def admitted(system: nc.System, state: nc.State, v: Array) -> nc.State:
    """The state with the part of velocities that its constraints admit, in the metric of the mass."""
    free = TangentSpace.at(system, state).projected(Velocity(by_node(v), state.rates))
    return replace_fields(state, v=free.rows.reshape(state.v.shape), rates=free.rotors)


@eager_numpy
def coordinate_rates(system: nc.System, state: nc.State) -> Array:
    """Rates of all joint coordinates."""
    return jnp.asarray(state_rates(system, state))
