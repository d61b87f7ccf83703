"""The way forth along the recorded slots of a rollout, for one direction.

A loop goes from the first slot to the last. What the constraints admit at the end of one step is what they
admit at the start of the next: its change is carried along with that of the state.
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
from natcoord_jax.stepping.linear_iteration import LinearIteration
from natcoord_jax.stepping.newton import any_lane
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.record import Parameters, ParameterTangents, Record, Slot
from natcoord_jax.stepping.rollout_state import Predictor
from natcoord_jax.stepping.slot_sweep import Fixed, SlotSweep, SweepCarry


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
        _, along = jax.linearize(partial(self.outcome, numbers, slot), *at_slot, slot.y)
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
