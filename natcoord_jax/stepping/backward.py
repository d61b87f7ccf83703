"""The way back along the recorded slots of a rollout.

A loop goes from the last slot to the first. Each transposed system is solved by corrections with factors
carried from slot to slot, as the step itself is, and nothing is stored but the states. What the constraints
admit at the end of one step is what they admit at the start of the next: its cotangent is carried along with
that of the state, and it is differentiated once a step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.assembly.equations import kind_of, prepare
from natcoord_jax.assembly.momentum import row_weights
from natcoord_jax.assembly.separate import Tangents, tangents_at
from natcoord_jax.assembly.system import System
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.learning import learns
from natcoord_jax.maths.rows import row, with_row
from natcoord_jax.stepping.correcting import Correcting
from natcoord_jax.stepping.factors import Factors, factors_of
from natcoord_jax.stepping.newton import any_lane
from natcoord_jax.stepping.one_kernel import as_one_kernel, lane_by_lane, plainly
from natcoord_jax.stepping.past import Past
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.probe import jacobian_by_differences
from natcoord_jax.stepping.record import Changes, Numbers, Record, Returning, Slot
from natcoord_jax.stepping.step import advance_between

CHUNK = 32
"""Slots that a round sees, at most."""


class Backward:
    """The way back; hashable, without traced values.

    Args:
        plan: of the rollout.
        forced: whether the multipliers of all slots and the cotangents of their ends are kept, see `Changes`.
    """

    def __init__(self, plan: Plan, forced: bool = False):
        self.plan = plan
        self.forced = forced
        self.tableau = plan.tableau
        # Velocities across constraints alternate from step to step where no kicks hold them: v_1 = 2 V - v_0.
        # So do their cotangents, and a part of the multipliers; every other one of these is smooth.
        self.stride = 1 if self.tableau.kick else 2

    def cotangents(self, record: Record, given: tuple[State, Array]) -> Changes:
        """Cotangents of what varies, of the slots' inputs, and of the first state.

        Args:
            record: where.
            given: cotangents of the states after all slots and of their unknowns.
        """
        return lane_by_lane(self._in_kernels, record, given)

    def _in_kernels(self, record: Record, given: tuple[State, Array]) -> Changes:
        """One kernel for all slots, or one for each part if that would take too long to compile."""
        several = partial(self._backward, as_one_kernel)
        return as_one_kernel(partial(self._backward, plainly), record, given, too_large=several)

    def _backward(self, kernel: Callable, record: Record, given: tuple[State, Array]) -> Changes:
        """In rounds: of a kernel that goes on until it needs new factors, and one that makes them.

        A round sees a few slots, so that what travels between kernels does not grow with their number.
        """
        numbers, slots = record.numbers, record.slots
        count = slots.y.shape[0]
        rows = min(CHUNK, count)

        def round_of(carry: tuple[Returning, Any]) -> tuple[Returning, Any]:
            c, found = carry
            first = jnp.maximum(c.left - rows, 0)
            near = jax.tree.map(
                lambda x: jax.lax.dynamic_slice_in_dim(x, first, rows, 0), (slots, given, found)
            )

            def renewed(carry: tuple) -> tuple:
                _, factors, at = carry
                slot = jax.tree.map(lambda x: row(x, c.left - 1 - first), near[0])
                return jnp.array(False), kernel(self._renewed, numbers, slot), at.refreshed()

            start = c.stuck, c.factors, c.at
            _, factors, at = jax.lax.while_loop(lambda carry: carry[0], renewed, start)
            c = replace_fields(c, factors=factors, at=at, stuck=jnp.array(False))
            c, part = kernel(self._several, numbers, first, *near, c)
            update = partial(jax.lax.dynamic_update_slice_in_dim, start_index=first, axis=0)
            return c, jax.tree.map(update, found, part)

        y, before_all = slots.y[-1], jax.tree.map(lambda x: x[0], slots.before)
        start = Returning(
            left=jnp.array(count),
            state_bar=jax.tree.map(jnp.zeros_like, before_all),
            tangents_bar=self._no_change(numbers, before_all),
            varied_bar=jax.tree.map(jnp.zeros_like, numbers.varied),
            pasts=(Past.of(jnp.zeros_like(y)),) * self.stride,
            lam=jnp.zeros_like(y),
            at=Correcting.first(slots.accepted[-1], y, record.factors),
            factors=record.factors,
            stuck=jnp.array(False),
        )
        found = jax.tree.map(jnp.zeros_like, (slots.u, (slots.y, slots.before) if self.forced else None))
        c, (u_bar, forced_bar) = jax.lax.while_loop(lambda carry: carry[0].left > 0, round_of, (start, found))
        if c.tangents_bar is None:
            return Changes(c.varied_bar, u_bar, c.state_bar, forced_bar)
        varied_bar, state_bar = kernel(self._before_all, numbers, before_all, c)
        return Changes(varied_bar, u_bar, state_bar, forced_bar)

    def _tangents(self, numbers: Numbers, varied: list[Array], state: State) -> Tangents | None:
        """What the constraints admit in a state, for schemes that ask for it."""
        if not self.tableau.kick:
            return None
        return tangents_at(numbers.whole(varied)[0], state).without_system()

    def _no_change(self, numbers: Numbers, state: State) -> Tangents | None:
        shapes = jax.eval_shape(partial(self._tangents, numbers, numbers.varied), state)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def _before_all(self, numbers: Numbers, state: State, c: Returning) -> tuple[list[Array], State]:
        """Cotangents of what varies and of the first state, with those of the tangent space there."""
        _, pull = jax.vjp(partial(self._tangents, numbers), numbers.varied, state)
        return jax.tree.map(jnp.add, (c.varied_bar, c.state_bar), pull(c.tangents_bar))

    def _several(
        self, numbers: Numbers, first: Array, slots: Slot, given: tuple, found: tuple, c: Returning
    ) -> tuple[Returning, tuple]:
        """Slots from the last one back, down to the first given here or to one that needs new factors."""

        def one(carry: tuple[Returning, tuple]) -> tuple[Returning, tuple]:
            c, found = carry
            here = c.left - 1 - first
            slot, (end_bar, y_bar) = jax.tree.map(lambda x: row(x, here), (slots, given))
            end_bar = jax.tree.map(jnp.add, c.state_bar, end_bar)
            bars, lam, at, factors = self._pulled(numbers, slot, end_bar, y_bar, c)
            stuck = any_lane(at.open & at.wanting)
            lost = slot.accepted & ~at.done
            forced_bar = (lam, end_bar) if self.forced else None
            more, before_bar, tangents_bar, own_bar, forced_bar = jax.tree.map(
                lambda x: jnp.where(lost, jnp.nan, x), (*bars, forced_bar)
            )
            keep = partial(jnp.where, slot.accepted)
            own, *others = c.pasts
            pasts = jax.tree.map(keep, (*others, own.followed_by(lam, factors.inertias)), c.pasts)
            before_bar = jax.tree.map(keep, before_bar, end_bar)
            tangents_bar = jax.tree.map(keep, tangents_bar, c.tangents_bar)
            varied_bar = jax.tree.map(lambda total, x: keep(total + x, total), c.varied_bar, more)
            # Of a slot that waits for factors nothing counts yet; this row is written again.
            found = jax.tree.map(
                lambda rows, x: with_row(rows, here, keep(x, jnp.zeros_like(x))), found, (own_bar, forced_bar)
            )
            guess = pasts[0].guess
            guess = jnp.where(jnp.all(jnp.isfinite(guess)), guess, 0.0)
            coming = row(slots.accepted, jnp.maximum(here - 1, 0))
            following = Correcting.first(coming, lam, factors)
            aged = factors.aged()
            done = Returning(
                c.left - 1, before_bar, tangents_bar, varied_bar, pasts, guess, following, aged, stuck
            )
            waiting = replace_fields(c, lam=lam, at=at, factors=factors, stuck=stuck)
            return jax.tree.map(partial(jnp.where, stuck), waiting, done), found

        return jax.lax.while_loop(lambda carry: (carry[0].left > first) & ~carry[0].stuck, one, (c, found))

    def _pulled(
        self, numbers: Numbers, slot: Slot, end_bar: State, y_bar: Array, c: Returning
    ) -> tuple[tuple, Array, Correcting, Factors]:
        """Cotangents of one slot, as far as the factors at hand go.

        The multipliers of its equations solve J^T lam = -(cotangent of the unknowns); their guess is
        extrapolated from those of the slots after it, or of every other one.

        Returns:
            Cotangents of what varies, of the state before the slot and the tangent space there, and of its
            inputs; the multipliers, where their solution stands, and the factors.
        """
        system, _, dt = numbers.whole(numbers.varied)
        patience = kind_of(system, self.tableau).renewal
        whole = _size_of(system, slot.fraction * dt, end_bar, y_bar, c.factors)

        # With one stage it saves time to pull back only what the corrections ask for; with more of them the
        # program grows too large for one kernel, which costs more than that.
        once = self.tableau.stages > 1
        tangents = self._tangents(numbers, numbers.varied, slot.before)
        given = numbers.varied, slot.before, tangents, slot.u
        nothing = jax.tree.map(jnp.zeros_like, given)

        def changing(factors: Factors) -> tuple:
            """What of the factors the corrections change."""
            return factors.leaving, factors.solver if learns(factors.solver) else None

        def with_changes(changes: tuple) -> Factors:
            leaving, learnt = changes
            solver = c.factors.solver if learnt is None else learnt
            return replace_fields(c.factors, leaving=leaving, solver=solver)

        def outcome(varied: list[Array], state: State, tangents: Tangents | None, u: Any, y: Array) -> tuple:
            system, parameters, dt = numbers.whole(varied)
            u = slot.inputs(self.plan, parameters, state) if u is None else u
            return advance_between(system, state, tangents, u, slot.fraction * dt, y, self.tableau)

        _, pull = jax.vjp(outcome, *given, slot.y)
        end_bars = end_bar, c.tangents_bar

        def trip(carry: tuple) -> tuple:
            _, learnt, lam, at = carry
            *bars, gap = pull((lam, *end_bars))
            at, known = at.judged(with_changes(learnt), lam, gap + y_bar, patience, whole, not once)
            lam = jnp.where(at.moving, lam - at.change, lam)
            return tuple(bars) if once else None, changing(known), lam, at

        start = nothing if once else None, changing(c.factors), c.lam, c.at
        bars, learnt, lam, at = jax.lax.while_loop(lambda carry: any_lane(carry[-1].going), trip, start)
        found: Any = bars if once else tuple(pull((lam, *end_bars))[:-1])
        return found, lam, at, with_changes(learnt)

    def _renewed(self, numbers: Numbers, slot: Slot) -> Factors:
        """New factors, for this slot."""
        system, parameters, dt = numbers.whole(numbers.varied)
        u = slot.inputs(self.plan, parameters, slot.before)
        equations = prepare(system, slot.before, u, slot.fraction * dt, self.tableau)
        if equations.by_differences:
            return factors_of(equations, jacobian_by_differences(equations, slot.y))
        return factors_of(equations, equations.tangent(slot.y))


def _size_of(system: System, h: Array, end_bar: State, y_bar: Array, factors: Factors) -> Array:
    """Energy norm of the solution of a transposed system, if nothing in its right-hand side cancelled."""
    weights, real = row_weights(system.mass), factors.inertias > 0
    moving = (h * jnp.abs(end_bar.q) + jnp.abs(end_bar.v)).reshape(*weights.shape, 3)
    own = jnp.where(real, y_bar**2 / jnp.where(real, factors.inertias, 1.0), 0.0)
    return jnp.sqrt(jnp.sum(weights[..., None] * moving**2) + jnp.sum(own))
