"""The derivative of a rollout, along its recorded slots.

States and solutions of all slots are known, so Newton's iteration is never differentiated: the step's
equations are, once for every slot (implicit function theorem). Substep fractions are constants.

The way forth and the way back have programs of their own, see `forward` and `backward`. For many directions,
all Jacobians are formed, vmapped over the slots, and only the recursion from state to state is a scan: a
Jacobian then serves all of them. Recorded outputs are differentiated by the same rule, and what changes with
them is made of the same two programs, see `Rule`: derivatives of any order are exact, in every mode.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.momentum import row_weights
from natcoord_jax.native.call import fits
from natcoord_jax.stepping.backward import Backward, Forward
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.linear_iteration import STALL_ROUND_OFF, sizes_by_mass
from natcoord_jax.stepping.plan import Plan, Slots
from natcoord_jax.stepping.record import (
    Parameters,
    ParameterTangents,
    Record,
    Slot,
    instantiated,
    zero_tangent,
)
from natcoord_jax.stepping.rollout import Ending, run
from natcoord_jax.stepping.slot_chunks import in_chunks
from natcoord_jax.stepping.slot_sweep import Fixed, outcome
from natcoord_jax.stepping.step import linear_solver
from natcoord_jax.stepping.two_kernel_loop import unknowns_of
from natcoord_jax.system import System
from natcoord_jax.xla import linear_pair
from natcoord_jax.xla.one_kernel import lane_by_lane, on_cpu

JACOBIANS_FROM = 0.5
"""Directions, in terms of the number of unknowns, from which on Jacobians of all slots save time. Measured:
they take as long as a third as many directions as unknowns (one stage) to two thirds (two stages)."""

UNSOLVED = 1e-6
"""Residual of a slot's linear system, relative to its terms and those of its solution, from which on the
Jacobian is taken for singular: tangents are no numbers then. Rounding of very stiff systems leaves 1e-7."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def run_slots(
    plan: Plan,
    system: System,
    state: State,
    parameters: Any,
    dt: Array,
    tolerance: Tolerance | None = None,
    event: Any = None,
    steps: Array | None = None,
) -> tuple[Slots, Ending]:
    """All slots of a rollout and where it ended, see `rollout.run`; differentiable in every mode."""
    # JAX sets the mesh anew for derivatives, and to jit no mesh and an empty one are different circumstances.
    with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
        return _traced_once(plan, system, state, parameters, dt, tolerance, event, steps)


@partial(jax.jit, static_argnums=0)
def _traced_once(plan: Plan, *numbers: Any) -> tuple[Slots, Ending]:
    """JAX evaluates the function and the rule for its derivative; jit remembers the program."""
    if fits(unknowns_of(plan, numbers[0])):
        return run(plan, *numbers)
    return lane_by_lane(partial(run, plan), *numbers)


@dataclass(frozen=True)
class Rule(linear_pair.LinearWithTranspose):
    """The tangents of a rollout and their transpose; hashable, without traced values.

    How both change with the record follows from what they are at every slot: the tangents of a slot solve
    J y_dot = -r, and their change solves the same equations with r the change of the slot's linearised
    equations at the tangents known. So it is with the transpose and the multipliers known. Nothing that is
    solved is differentiated.

    Attributes:
        plan: of the rollout.
        forced: whether residuals and ends of the slots have tangents of their own among the arguments. Their
            cotangents are the multipliers of the slots' equations and the cotangents of their ends.
    """

    plan: Plan
    forced: bool = False

    @property
    def tableau(self) -> Tableau:
        """Of the collocation method."""
        return self.plan.tableau

    def outcome(
        self, numbers: Parameters, slot: Slot, varied: list[Array], state: State, u: Any, y: Array
    ) -> tuple[Array, State]:
        """Residual of the slot's equations and the state at its end."""
        return outcome(self.plan, numbers, slot, varied, state, None, u, y)[:2]

    def prepared(self, numbers: Parameters, varied_dot: list[Array], slot: Slot, u_dot: Any) -> tuple:
        """Linear maps of one slot: from (state, unknowns), of everything else's change, and the solver."""
        at = partial(self.outcome, numbers, slot)
        _, along = jax.linearize(lambda state, y: at(numbers.varied, state, slot.u, y), slot.before, slot.y)
        given, given_dot = (numbers.varied, slot.u), (varied_dot, u_dot)
        forcing = jax.jvp(lambda varied, u: at(varied, slot.before, u, slot.y), given, given_dot)[1]
        system, parameters, dt = numbers.whole(numbers.varied)
        u = slot.inputs(self.plan, system, parameters, slot.before)
        h = slot.fraction * dt
        return along, linear_solver(system, slot.before, u, h, slot.y, self.tableau, along), forcing

    def forward(self, residuals: Record, arguments: ParameterTangents) -> tuple[State, Array]:
        """Tangents of the states after all slots and of their unknowns."""
        if not on_cpu():
            return self.with_jacobians(residuals, arguments)
        return Forward(self.plan).tangents(residuals, arguments)

    def forward_many(self, residuals: Record, arguments: ParameterTangents) -> tuple[State, Array]:
        """The same of several directions: by Jacobians if they are so many that it takes less time."""
        directions, unknowns = arguments.state.q.shape[0], residuals.slots.y.shape[-1]
        forward = self.with_jacobians if JACOBIANS_FROM * unknowns <= directions else self.forward
        return jax.vmap(partial(forward, residuals))(arguments)

    def with_jacobians(self, residuals: Record, arguments: ParameterTangents) -> tuple[State, Array]:
        """The same by Jacobians of all slots, which serve any number of directions."""
        slots, masses = residuals.slots, Fixed.of(self.tableau, residuals).masses
        system, _, dt = residuals.numbers.whole(residuals.numbers.varied)
        weights = row_weights(system.mass)

        def body(state_dot: State, xs: tuple) -> tuple:
            (along, solver, forcing), accepted, forced = xs
            residual_dot, end_dot = forcing if forced is None else jax.tree.map(jnp.add, forcing, forced)
            resting = jnp.zeros(slots.y.shape[1:], slots.y.dtype)
            known = residual_dot + along(state_dot, resting)[0]
            y_dot = -solver.solve(known)
            missing, moved = along(state_dot, y_dot)
            size, missing = sizes_by_mass(y_dot, missing + residual_dot, masses)
            # Where tangents decay within a state that keeps its own, what is known is a difference of these.
            moving = (jnp.abs(state_dot.v) + jnp.abs(state_dot.q) / dt).reshape(*weights.shape, 3)
            whole = jnp.sqrt(jnp.sum(weights[..., None] * moving**2))
            terms = size + sizes_by_mass(y_dot, known, masses)[1]
            solved = missing <= UNSOLVED * terms + STALL_ROUND_OFF * whole
            y_dot, moved = jax.tree.map(lambda x: jnp.where(solved, x, jnp.nan), (y_dot, moved))
            end = jax.tree.map(jnp.add, end_dot, moved)
            end = jax.tree.map(partial(jnp.where, accepted), end, state_dot)
            return end, (end, jnp.where(accepted, y_dot, 0.0))

        each = partial(self.prepared, residuals.numbers, arguments.varied)
        maps = in_chunks(each, (slots, arguments.u), slots.y.shape[0])
        return jax.lax.scan(body, arguments.state, (maps, slots.accepted, arguments.forced))[1]

    def backward(self, residuals: Record, cotangents: tuple[State, Array]) -> ParameterTangents:
        """The transpose, see `backward`."""
        return Backward(self.plan, self.forced).cotangents(residuals, cotangents)

    def forward_changed(
        self,
        residuals: Record,
        changes: Record,
        arguments: ParameterTangents,
        arguments_dot: ParameterTangents,
    ) -> tuple[tuple[State, Array], tuple[State, Array]]:
        """The tangents, and their change with the record and with what they are linear in."""
        numbers, slots = residuals.numbers, residuals.slots
        outputs = slots.before, slots.y
        found = linear_pair.apply(self, residuals, arguments, outputs)
        before_dot = _before_each(arguments.state, found[0])

        def change(slot: Slot, slot_dot: Slot, u_dot: Any, state_dot: State, y_dot: Array) -> tuple:
            def tangents(numbers: Parameters, slot: Slot) -> tuple[Array, State]:
                at = numbers.varied, slot.before, slot.u, slot.y
                by = arguments.varied, state_dot, u_dot, y_dot
                return jax.jvp(partial(self.outcome, numbers, slot), at, by)[1]

            _, more = linear_pair.along(tangents, (numbers, slot), (changes.numbers, slot_dot))
            return _if(slot.accepted, more)

        given = slots, changes.slots, arguments.u, before_dot, found[1]
        forced = in_chunks(change, given, slots.y.shape[0])
        if arguments_dot.forced is not None:
            forced = jax.tree.map(jnp.add, forced, arguments_dot.forced)
        arguments_dot = replace_fields(arguments_dot, forced=forced)
        return found, linear_pair.apply(Rule(self.plan, True), residuals, arguments_dot, outputs)

    def backward_changed(
        self, residuals: Record, changes: Record, cotangents: tuple[State, Array], cotangents_dot: tuple
    ) -> tuple[ParameterTangents, ParameterTangents]:
        """The cotangents, and their change with the record and with what they are linear in."""
        numbers, slots = residuals.numbers, residuals.slots
        first = jax.tree.map(lambda x: x[0], slots.before)
        plain = ParameterTangents(numbers.varied, slots.u, first)
        whole = replace_fields(plain, forced=(slots.y, slots.before))
        found = linear_pair.transposed(Rule(self.plan, True), residuals, cotangents, whole)

        def change(slot: Slot, slot_dot: Slot, forced: tuple[Array, State]) -> tuple:
            def pulled(numbers: Parameters, slot: Slot) -> tuple:
                at = numbers.varied, slot.before, slot.u, slot.y
                return jax.vjp(partial(self.outcome, numbers, slot), *at)[1](forced)

            _, more = linear_pair.along(pulled, (numbers, slot), (changes.numbers, slot_dot))
            return _if(slot.accepted, more)

        given = slots, changes.slots, found.forced
        varied, before, u, y = in_chunks(change, given, slots.y.shape[0], summed=True)
        # What changes the cotangent of a state changes that of the end of the slot before.
        ends = jax.tree.map(lambda x: jnp.concatenate([x[1:], jnp.zeros_like(x[:1])]), before)
        given = jax.tree.map(jnp.add, cotangents_dot, (ends, y))
        changed = linear_pair.transposed(self, residuals, given, whole if self.forced else plain)
        more = varied, u, jax.tree.map(lambda x: x[0], before)
        sums = jax.tree.map(jnp.add, (changed.varied, changed.u, changed.state), more)
        if not self.forced:
            found = replace_fields(found, forced=None)
        return found, ParameterTangents(sums[0], sums[1], sums[2], changed.forced)


def _before_each(first: State, after: State) -> State:
    """The states before all slots: the first one, and those after all but the last."""
    return jax.tree.map(lambda one, ends: jnp.concatenate([one[None], ends[:-1]]), first, after)


def _if(accepted: Array, changes: Any) -> Any:
    """Changes of what a slot contributes, none if its attempt failed: its maps may not even be numbers."""
    return jax.tree.map(lambda x: jnp.where(accepted, x, 0.0), changes)


@partial(run_slots.defjvp, symbolic_zeros=True)
def _run_slots_jvp(plan: Plan, primals: tuple, tangents: tuple):
    system, state, parameters, dt, *_ = primals
    system_dot, state_dot, parameters_dot, dt_dot, *_ = tangents
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
        numbers, varied_dot = Parameters.of((system, None, dt), (system_dot, None, dt_dot))
    else:
        numbers, varied_dot = Parameters.of((system, parameters, dt), (system_dot, parameters_dot, dt_dot))
    before = _before_each(state, slots.states)
    # Attempts that failed may hold anything: their maps are formed at rest, and then not used.
    sound = jnp.where(slots.accepted[:, None], slots.y, 0.0)
    record = Record(
        numbers,
        Slot(before, sound, u, slots.step, slots.fraction, slots.done, slots.accepted, slots.event),
        ending.factors,
    )
    changes, outputs = ParameterTangents(varied_dot, u_dot, state_dot), (slots.states, slots.y)
    states_dot, y_dot = linear_pair.apply(Rule(plan), record, changes, outputs)
    last_dot = jax.tree.map(lambda x: x[-1], states_dot)
    slots_dot = jax.tree.map(zero_tangent, slots)
    slots_dot = eqx.tree_at(lambda s: (s.states, s.y), slots_dot, (states_dot, y_dot))
    ending_dot = jax.tree.map(zero_tangent, ending)
    ending_dot = eqx.tree_at(lambda e: e.course.state, ending_dot, last_dot)
    return (slots, ending), (slots_dot, ending_dot)
