"""The derivative of a rollout, along its recorded slots.

States and solutions of all slots are known, so Newton's iteration is never differentiated: the step's
equations are, once for every slot (implicit function theorem). Substep fractions are constants.

Forward, all Jacobians are formed at once, vmapped over the slots, and only the recursion from state to state
is a scan. The way back has a program of its own, see `backward`. Recorded outputs are differentiated by the
same rule, so second derivatives (forward over reverse, forward over forward) are exact.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.assembly.system import System
from natcoord_jax.core.state import State
from natcoord_jax.stepping import linear_pair
from natcoord_jax.stepping.backward import Backward
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.one_kernel import lane_by_lane
from natcoord_jax.stepping.plan import Plan, Slots
from natcoord_jax.stepping.record import Numbers, Record, Slot, instantiated, zero_tangent
from natcoord_jax.stepping.rollout import Ending, run
from natcoord_jax.stepping.step import advance, linear_solver

CHUNK = 32
"""Slots whose Jacobians are formed together."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def run_slots(
    plan: Plan,
    system: System,
    state: State,
    parameters: Any,
    dt: Array,
    tolerance: Tolerance | None = None,
) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended; differentiable in every mode."""
    # JAX sets the mesh anew for derivatives, and to jit no mesh and an empty one are different circumstances.
    with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
        return _traced_once(plan, system, state, parameters, dt, tolerance)


@partial(jax.jit, static_argnums=0)
def _traced_once(plan: Plan, *numbers: Any) -> tuple[Slots, Ending]:
    """JAX evaluates the function and the rule for its derivative; jit remembers the program."""
    return lane_by_lane(partial(run, plan), *numbers)


class Rule:
    """The tangents of a rollout and their transpose; hashable, without traced values."""

    def __init__(self, plan: Plan):
        self.plan = plan
        self.tableau = plan.tableau

    def outcome(
        self, numbers: Numbers, varied: list[Array], slot: Slot, state: State, u: Any, y: Array
    ) -> tuple[Array, State]:
        """Residual of the slot's equations and the state at its end."""
        system, parameters, dt = numbers.whole(varied)
        u = slot.inputs(self.plan, parameters, state) if u is None else u
        return advance(system, state, u, slot.fraction * dt, y, self.tableau)[:2]

    def prepared(self, numbers: Numbers, varied_dot: list[Array], slot: Slot, u_dot: Any) -> tuple:
        """Linear maps of one slot: from (state, unknowns), of everything else's change, and the solver."""
        at = partial(self.outcome, numbers)
        _, along = jax.linearize(
            lambda state, y: at(numbers.varied, slot, state, slot.u, y), slot.before, slot.y
        )
        given, given_dot = (numbers.varied, slot.u), (varied_dot, u_dot)
        forcing = jax.jvp(lambda varied, u: at(varied, slot, slot.before, u, slot.y), given, given_dot)[1]
        system, parameters, dt = numbers.whole(numbers.varied)
        u = slot.inputs(self.plan, parameters, slot.before)
        h = slot.fraction * dt
        return along, linear_solver(system, slot.before, u, h, slot.y, self.tableau, along), forcing

    def tangents(self, record: Record, changes: tuple) -> tuple[State, Array]:
        """Tangents of the states after all slots and of their unknowns.

        Args:
            record: where.
            changes: of what varies, of the slots' inputs, and of the first state.
        """
        varied_dot, u_dot, state_dot = changes
        slots = record.slots

        def body(state_dot: State, xs: tuple) -> tuple:
            (along, solver, (residual_dot, end_dot)), accepted = xs
            resting = jnp.zeros(slots.y.shape[1:], slots.y.dtype)
            y_dot = -solver.solve(residual_dot + along(state_dot, resting)[0])
            end = jax.tree.map(jnp.add, end_dot, along(state_dot, y_dot)[1])
            end = jax.tree.map(partial(jnp.where, accepted), end, state_dot)
            return end, (end, jnp.where(accepted, y_dot, 0.0))

        each = partial(self.prepared, record.numbers, varied_dot)
        maps = _in_chunks(each, (slots, u_dot), slots.y.shape[0])
        return jax.lax.scan(body, state_dot, (maps, slots.accepted))[1]

    def cotangents(self, record: Record, given: tuple[State, Array]) -> tuple:
        """The transpose of `tangents`, see `backward`."""
        return Backward(self.plan).cotangents(record, given)


def _in_chunks(function: Callable, slots: tuple, length: int) -> Any:
    """The function of every slot, vmapped in chunks whose temporaries stay in the cache."""
    every = jax.vmap(lambda x: function(*x))
    if length <= CHUNK:
        return every(slots)
    chunks = -(-length // CHUNK)
    padding = jnp.minimum(jnp.arange(chunks * CHUNK), length - 1)

    def chunked(x: Array) -> Array:
        return x[padding].reshape(chunks, CHUNK, *x.shape[1:])

    found = jax.lax.map(every, jax.tree.map(chunked, slots))
    return jax.tree.map(lambda x: x.reshape(chunks * CHUNK, *x.shape[2:])[:length], found)


@partial(run_slots.defjvp, symbolic_zeros=True)
def _run_slots_jvp(plan: Plan, primals: tuple, tangents: tuple):
    system, state, parameters, dt, _ = primals
    system_dot, state_dot, parameters_dot, dt_dot, _ = tangents
    slots, ending = run_slots(plan, *primals)
    state_dot = instantiated(state_dot, state)
    u = u_dot = None
    if plan.control is None:
        # Inputs are those of the slots, so that no slot sees all of them.
        within = jax.vmap(plan.within_step)
        u, u_dot = (
            within(x[slots.step], slots.done, slots.fraction)
            for x in (parameters, instantiated(parameters_dot, parameters))
        )
        numbers, varied_dot = Numbers.of((system, None, dt), (system_dot, None, dt_dot))
    else:
        numbers, varied_dot = Numbers.of((system, parameters, dt), (system_dot, parameters_dot, dt_dot))
    before = jax.tree.map(
        lambda first, after: jnp.concatenate([first[None], after[:-1]]), state, slots.states
    )
    # Attempts that failed may hold anything: their maps are formed at rest, and then not used.
    sound = jnp.where(slots.accepted[:, None], slots.y, 0.0)
    record = Record(
        numbers,
        Slot(before, sound, u, slots.step, slots.fraction, slots.done, slots.accepted),
        ending.factors,
    )
    rule = Rule(plan)
    changes, outputs = (varied_dot, u_dot, state_dot), (slots.states, slots.y)
    states_dot, y_dot = linear_pair.apply(rule.tangents, rule.cotangents, record, changes, outputs)
    last_dot = jax.tree.map(lambda x: x[-1], states_dot)
    slots_dot = jax.tree.map(zero_tangent, slots)
    slots_dot = eqx.tree_at(lambda s: (s.states, s.y), slots_dot, (states_dot, y_dot))
    ending_dot = jax.tree.map(zero_tangent, ending)
    ending_dot = eqx.tree_at(lambda e: e.course.state, ending_dot, last_dot)
    return (slots, ending), (slots_dot, ending_dot)
