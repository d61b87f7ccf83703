"""The ways back and forth along the recorded slots of a rollout.

Back, a loop goes from the last slot to the first; forth, for one direction, from the first to the last. What
the constraints admit at the end of one step is what they admit at the start of the next: its cotangent, or
its change, is carried along with that of the state, and it is differentiated once a step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.block_tangent_space import Tangents
from natcoord_jax.mechanics.equations import kind_of
from natcoord_jax.mechanics.momentum import row_weights
from natcoord_jax.stepping.factors import Factors
from natcoord_jax.stepping.linear_iteration import LinearIteration
from natcoord_jax.stepping.newton import any_lane
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.record import Parameters, ParameterTangents, Record, Slot
from natcoord_jax.stepping.rollout_state import Predictor
from natcoord_jax.stepping.slot_sweep import Fixed, SlotSweep, SweepCarry, outcome
from natcoord_jax.system import System

MANY = 8
"""Bodies from which on only what the corrections ask for is pulled back until the solution is expected, if
there is one stage. That is a second copy of the equations: it saves a tenth of the time then, and 3 % or less
of that of small systems, whose programs compile for half as long again. With more stages the program would
grow too large for one kernel, which costs more than that."""


class Backward(SlotSweep):
    """The way back.

    It carries the cotangents of the state after a slot, of the tangent space there for schemes with kicks,
    and of what varies, so far.

    Args:
        plan: of the rollout.
        forced: whether the multipliers of all slots and the cotangents of their ends are kept, see
            `ParameterTangents`.
    """

    def __init__(self, plan: Plan, forced: bool = False):
        # Velocities across constraints alternate from step to step where no kicks hold them: v_1 = 2 V - v_0.
        # So do their cotangents, and a part of the multipliers; every other one of these is smooth.
        super().__init__(plan, 1 if plan.tableau.kick else 2)
        self.forced = forced

    def cotangents(self, record: Record, given: tuple[State, Array]) -> ParameterTangents:
        """Cotangents of what varies, of the slots' inputs, and of the first state.

        Args:
            record: where.
            given: cotangents of the states after all slots and of their unknowns.
        """
        return self.every(record, given)

    def following(self, kernel: Callable, record: Record, given: tuple[State, Array]) -> ParameterTangents:
        """Cotangents of everything."""
        numbers, slots = record.numbers, record.slots
        y, before_all = slots.y[-1], jax.tree.map(lambda x: x[0], slots.before)
        state_bar = jax.tree.map(jnp.zeros_like, before_all)
        shapes = jax.eval_shape(partial(self.admitted, numbers, numbers.varied), before_all)
        none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        own = state_bar, none, jax.tree.map(jnp.zeros_like, numbers.varied)
        like = slots.u, (slots.y, slots.before) if self.forced else None
        start = y, record.factors, own
        fixed = Fixed.of(self.tableau, record)
        c, (u_bar, forced_bar) = self.in_rounds(kernel, fixed, slots, given, start, like)
        state_bar, tangents_bar, varied_bar = c.own
        if tangents_bar is None:
            return ParameterTangents(varied_bar, u_bar, state_bar, forced_bar)
        varied_bar, state_bar = kernel(self._before_all, numbers, before_all, c)
        return ParameterTangents(varied_bar, u_bar, state_bar, forced_bar)

    def _before_all(self, numbers: Parameters, state: State, c: SweepCarry) -> tuple[list[Array], State]:
        """Cotangents of what varies and of the first state, with those of the tangent space there."""
        state_bar, tangents_bar, varied_bar = c.own
        _, pull = jax.vjp(partial(self.admitted, numbers), numbers.varied, state)
        return jax.tree.map(jnp.add, (varied_bar, state_bar), pull(tangents_bar))

    def arriving(self, own: tuple, given: tuple[State, Array]) -> State:
        """The cotangent of the state after the slot."""
        return jax.tree.map(jnp.add, own[0], given[0])

    def passed_on(self, own: tuple, arrived: State, outcome: tuple, keep: Callable) -> tuple[tuple, tuple]:
        """With the cotangents of the state before the slot; found are those of its inputs and its forces."""
        more, before_bar, tangents_bar, own_bar, forced_bar = outcome
        before_bar = jax.tree.map(keep, before_bar, arrived)
        tangents_bar = jax.tree.map(keep, tangents_bar, own[1])
        varied_bar = jax.tree.map(lambda total, x: keep(total + x, total), own[2], more)
        found = jax.tree.map(lambda x: keep(x, jnp.zeros_like(x)), (own_bar, forced_bar))
        return (before_bar, tangents_bar, varied_bar), found

    def solving(
        self, fixed: Fixed, slot: Slot, arrived: State, given: tuple[State, Array], c: SweepCarry
    ) -> Callable:
        """How the cotangents of one slot are found.

        The multipliers of its equations solve J^T lam = -(cotangent of the unknowns); their guess is
        extrapolated from those of the slots after it, or of every other one. From them follow cotangents of
        what varies, of the state before the slot and the tangent space there, of its inputs and its forces.
        """
        numbers, y_bar, tangents_bar = fixed.numbers, given[1], c.own[1]
        system, _, dt = numbers.whole(numbers.varied)
        patience = kind_of(system, self.tableau).renewal
        whole = _size_of(system, slot.fraction * dt, arrived, y_bar, c.factors)

        apart = self.tableau.stages == 1 and len(system.structure.bodies) >= MANY
        tangents = self.admitted(numbers, numbers.varied, slot.before)
        at_slot = numbers.varied, slot.before, tangents, slot.u
        nothing = jax.tree.map(jnp.zeros_like, at_slot)

        _, pull = jax.vjp(partial(outcome, self.plan, numbers, slot), *at_slot, slot.y)

        def solve(lam: Array, learnt: Any, at: LinearIteration) -> tuple:
            ends: Any = arrived, tangents_bar
            ends = jax.tree.map(lambda x: jnp.where(at.forming, 0.0, x), ends)

            def judged(given: tuple, product: Array) -> tuple:
                lam, learnt, at = given
                factors = c.factors.with_changes(learnt)
                at, known = at.judged(factors, lam, product + y_bar, fixed.masses, patience, whole)
                return jnp.where(at.moving, lam - at.change, lam), known.changing, at

            def nearer(given: tuple) -> tuple:
                return judged(given, pull((given[0], *ends))[-1])

            def evaluated(carry: tuple) -> tuple:
                _, given, _ = carry
                if apart:
                    given = jax.lax.while_loop(lambda x: any_lane(x[2].going & ~x[2].last), nearer, given)
                bars = pull((given[0], *ends))
                lam, learnt, at = judged(given, bars[-1])
                return at.going, (lam, learnt, at), bars

            start = at.going | at.forming, (lam, learnt, at), (*nothing, jnp.zeros_like(slot.y))
            found = jax.lax.while_loop(lambda carry: any_lane(carry[0]), evaluated, start)
            _, (lam, learnt, at), (*bars, product) = found
            return lam, learnt, at, (*bars, (lam, arrived) if self.forced else None), product

        return solve


def _size_of(system: System, h: Array, end_bar: State, y_bar: Array, factors: Factors) -> Array:
    """Energy norm of the solution of a transposed system, if nothing in its right-hand side cancelled."""
    weights, real = row_weights(system.mass), factors.inertias > 0
    moving = (h * jnp.abs(end_bar.q) + jnp.abs(end_bar.v)).reshape(*weights.shape, 3)
    own = jnp.where(real, y_bar**2 / jnp.where(real, factors.inertias, 1.0), 0.0)
    return jnp.sqrt(jnp.sum(weights[..., None] * moving**2) + jnp.sum(own))


class Forward(SlotSweep):
    """The way forth.

    It carries the tangents of the state before a slot, of the tangent space there for schemes with kicks, and
    the right-hand sides of the slots that are done.

    Args:
        plan: of the rollout.
    """

    columns = True

    def __init__(self, plan: Plan):
        super().__init__(plan, 1)

    def tangents(self, record: Record, given: ParameterTangents) -> tuple[State, Array]:
        """Tangents of the states after all slots and of their unknowns.

        Args:
            record: where.
            given: tangents of what varies, of the slots' inputs, of the first state, and of their forces.
        """
        record = replace_fields(record, slots=_reversed(record.slots))
        given = replace_fields(given, u=_reversed(given.u), forced=_reversed(given.forced))
        return _reversed(self.every(record, given))

    def following(self, kernel: Callable, record: Record, given: ParameterTangents) -> tuple[State, Array]:
        """Tangents of everything."""
        numbers, slots = record.numbers, record.slots
        y, before_all = slots.y[-1], jax.tree.map(lambda x: x[-1], slots.before)
        fixed, tangents_dot = Fixed.of(self.tableau, record, given.varied), None
        if self.tableau.kick:
            tangents_dot = kernel(self._first, (numbers, given.varied), before_all, given.state)
        own = given.state, tangents_dot, Predictor.of(jnp.zeros_like(y))
        start, like = (y, record.factors, own), (slots.before, slots.y)
        return self.in_rounds(kernel, fixed, slots, (given.u, given.forced), start, like)[1]

    def _first(
        self, fixed: tuple[Parameters, list[Array]], state: State, state_dot: State
    ) -> Tangents | None:
        """Change of the tangent space in the first state."""
        numbers, varied_dot = fixed
        at = partial(self.admitted, numbers)
        return jax.jvp(at, (numbers.varied, state), (varied_dot, state_dot))[1]

    def arriving(self, own: tuple, given: tuple) -> tuple:
        """The tangents of the state before the slot and of the tangent space there."""
        return own[:2]

    def passed_on(self, own: tuple, arrived: tuple, outcome: tuple, keep: Callable) -> tuple[tuple, tuple]:
        """With the tangents of the state after the slot; found are these and those of the unknowns."""
        end_dot, tangents_dot, y_dot, known = outcome
        past = own[2].followed_by(known, jnp.ones_like(known))
        end_dot, tangents_dot, past = jax.tree.map(keep, (end_dot, tangents_dot, past), own)
        return (end_dot, tangents_dot, past), (end_dot, keep(y_dot, jnp.zeros_like(y_dot)))

    def solving(self, fixed: Fixed, slot: Slot, arrived: tuple, given: tuple, c: SweepCarry) -> Callable:
        """How the tangents of one slot are found.

        Those of its unknowns solve J y_dot = -r. Their guess is extrapolated from those of the slots before,
        and corrected by what extrapolation misses of r, which is known.
        From them follow tangents of the state after the slot and of the tangent space there.
        """
        numbers, varied_dot, (u_dot, forced) = fixed.numbers, fixed.changes, given
        patience = kind_of(numbers.whole(numbers.varied)[0], self.tableau).renewal
        tangents = self.admitted(numbers, numbers.varied, slot.before)
        at_slot = numbers.varied, slot.before, tangents, slot.u

        # One product serves for everything: first without the unknowns, for r; then with them alone. A second
        # one would save some time and compile for as long again.
        _, along = jax.linearize(partial(outcome, self.plan, numbers, slot), *at_slot, slot.y)
        changes = varied_dot, *arrived, u_dot
        none, nothing = jnp.zeros_like(slot.fraction), jax.tree.map(jnp.zeros_like, (slot.before, tangents))
        foreseen = replace_fields(c.own[2], order=c.pasts[0].order).guess
        foreseen = jnp.where(jnp.all(jnp.isfinite(foreseen)), foreseen, 0.0)
        fresh = (c.at.count == 0) & (c.at.rounds == 0) & c.factors.usable

        def solve(y_dot: Array, learnt: Any, at: LinearIteration) -> tuple:
            forming = at.forming

            def trip(carry: tuple) -> tuple:
                ran, y_dot, learnt, at, known, ends, _ = carry
                begun = ran | forming
                given = jax.tree.map(lambda x: jnp.where(begun, 0.0, x), changes)
                product, *moved = along(*given, jnp.where(begun, y_dot, 0.0))
                if forced is not None:
                    more = jax.tree.map(lambda x: jnp.where(begun, 0.0, x), forced)
                    product, moved[0] = jax.tree.map(jnp.add, (product, moved[0]), more)
                known = jnp.where(ran & ~forming, known, product)
                ends, moved = (
                    jax.tree.map(partial(jnp.where, begun), *x)
                    for x in ((ends, tuple(moved)), (tuple(moved), nothing))
                )
                factors = c.factors.with_changes(learnt)
                start = jnp.where(fresh, y_dot - factors.solver.solve(known - foreseen), y_dot)
                given = y_dot, product + known, fixed.masses, patience, none
                judged = at.judged(factors, *given, transposed=False)
                at, factors = jax.tree.map(partial(jnp.where, begun), judged, (at, factors))
                y_dot = jnp.where(begun, jnp.where(at.moving, y_dot - at.change, y_dot), start)
                return jnp.array(True), y_dot, factors.changing, at, known, ends, moved

            start = jnp.array(False), y_dot, learnt, at, jnp.zeros_like(slot.y), nothing, nothing
            found = jax.lax.while_loop(lambda x: any_lane(x[3].going | ~x[0]), trip, start)
            _, y_dot, learnt, at, known, ends, moved = found
            end_dot, tangents_dot = jax.tree.map(jnp.add, ends, moved)
            return y_dot, learnt, at, (end_dot, tangents_dot, y_dot, known), known

        return solve


def _reversed(tree: Any) -> Any:
    """The last row first."""
    return jax.tree.map(lambda x: x[::-1], tree)
