"""The recorded slots of a rollout in turn, each with a linear system to solve.

The systems of neighbouring slots are alike. So each is solved by corrections with factors carried from slot
to slot, as the steps themselves are, and nothing is stored but the states.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.learning import learns
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.block_tangent_space import Tangents, tangents_at, with_system
from natcoord_jax.mechanics.equations import kind_of, prepare
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.native.call import as_native, fits
from natcoord_jax.stepping.factors import AGEING, Factors, factors_of
from natcoord_jax.stepping.linear_iteration import LinearIteration
from natcoord_jax.stepping.located import part_of_step
from natcoord_jax.stepping.newton import any_lane
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.record import Parameters, Record, Slot
from natcoord_jax.stepping.rollout_state import Predictor
from natcoord_jax.stepping.step import advance
from natcoord_jax.xla.one_kernel import in_few_kernels, lane_by_lane, plainly
from natcoord_jax.xla.rows import part, row, with_part, with_row
from natcoord_jax.xla.tracing import traced_once

CHUNK = 32
"""Slots that a round sees, at most."""


class Fixed(eqx.Module):
    """What is the same for all slots.

    Attributes:
        numbers: what the rollout depends on.
        masses: inertias that unknowns have at least, see `least_inertias`.
        changes: tangents of the numbers that vary; None on the way back.
        unknowns: of a slot.
    """

    numbers: Parameters
    masses: Float[Array, " balances"]
    changes: list[Array] | None
    unknowns: int = eqx.field(static=True)

    @classmethod
    def of(cls, tableau: Tableau, record: Record, changes: list[Array] | None = None) -> "Fixed":
        """Of what the derivative is taken at."""
        numbers, slots = record.numbers, record.slots
        system, parameters, dt = numbers.whole(numbers.varied)
        state = jax.tree.map(lambda x: x[0], slots.before)
        idle = jnp.zeros(len(system.structure.inputs), dt.dtype)
        equations = prepare(system, state, idle, dt, tableau, NOTHING)
        return cls(numbers, equations.least_inertias(), changes, slots.y.shape[-1])


class SweepCarry(eqx.Module):
    """What goes from slot to slot.

    Attributes:
        left: slots that are not done.
        own: what is carried besides the solutions, see `SlotSweep`.
        pasts: solutions of the slots that are done, dealt out in turn; the first guesses the next.
        solution: of the system of the last slot that is not done.
        at: where it stands.
        factors: of a Jacobian.
        stuck: whether it cannot go on without new ones, in any lane.
    """

    left: Int[Array, ""]
    own: Any
    pasts: tuple[Predictor, ...]
    solution: Float[Array, " unknowns"]
    at: LinearIteration
    factors: Factors
    stuck: Bool[Array, ""]


def outcome(
    plan: Plan,
    numbers: Parameters,
    slot: Slot,
    varied: list[Array],
    state: State,
    tangents: Tangents | None,
    u: Any,
    y: Array,
) -> tuple[Array, State, Tangents | None]:
    """Residual of a slot's equations, the state at its end, and what the constraints admit there."""
    system, parameters, dt = numbers.whole(varied)
    u = slot.inputs(plan, system, parameters, state) if u is None else u
    system, h = part_of_step(system, state, u, dt, y, plan.tableau, slot)
    residual, after, tangents = advance(system, state, u, h, y, plan.tableau, tangents)
    return residual, slot.settled(after), tangents


class SlotSweep(ABC):
    """Slots from the last one to the first; hashable, without traced values.

    Args:
        plan: of the rollout.
        stride: from which solutions before it one is guessed: 1 for every one, 2 for every other.
    """

    def __init__(self, plan: Plan, stride: int):
        self.plan = plan
        self.tableau = plan.tableau
        self.stride = stride

    columns = False
    """Whether products with a unit vector are columns of a slot's Jacobian; if not, rows."""

    @abstractmethod
    def arriving(self, own: Any, given: Any) -> Any:
        """What arrives at a slot, of what is carried and of its row of what is given."""

    @abstractmethod
    def solving(self, fixed: "Fixed", slot: Slot, arrived: Any, given: Any, c: SweepCarry) -> Callable:
        """How the system of one slot is solved, as far as the factors at hand go.

        Returns:
            A function of a solution, what factors have learnt, and where the solution stands. It returns
            these three, what follows from the solution, and the last product with the matrix: that with the
            solution it was given, where it stands at one of the products asked for.
        """

    @abstractmethod
    def passed_on(self, own: Any, arrived: Any, outcome: Any, keep: Callable) -> tuple[Any, Any]:
        """What is carried on, and the slot's row of what is found.

        Args:
            own: what is carried to it.
            arrived: what arrives.
            outcome: what follows from its solution.
            keep: chooses between two values: the second one for attempts that failed.
        """

    @abstractmethod
    def following(self, kernel: Callable, record: Record, given: Any) -> Any:
        """Everything, with what computes a function of its arguments in a kernel."""

    def admitted(self, numbers: Parameters, varied: list[Array], state: State) -> Tangents | None:
        """What the constraints admit in a state, for schemes that ask for it."""
        if not self.tableau.kick:
            return None
        return with_system(tangents_at(numbers.whole(varied)[0], state), None)

    def every(self, record: Record, given: Any) -> Any:
        """Everything: in one kernel for all slots, or one for each part if that takes too long to compile."""
        by_xla = partial(lane_by_lane, partial(in_few_kernels, self.following))
        if not fits(record.slots.y.shape[-1]):
            return by_xla(record, given)
        return as_native(
            lambda _, *arguments: by_xla(*arguments), partial(self.following, plainly), record, given
        )

    def in_rounds(
        self,
        kernel: Callable,
        fixed: "Fixed",
        slots: Slot,
        given: Any,
        start: tuple[Array, Factors, Any],
        like: Any,
    ) -> tuple[SweepCarry, Any]:
        """In rounds: of a kernel that goes on until it needs new factors, and one that makes them.

        A round sees a few slots, so that what travels between kernels does not grow with their number.

        Args:
            kernel: computes a function in one kernel.
            fixed: what is the same for all slots.
            slots: of the rollout, the one to begin with at last.
            given: what is given to every slot, a row for each.
            start: what it begins with: the unknowns of that slot, factors of a Jacobian, and what is carried.
            like: pytree like what is found, a row for each slot.
        """
        count = slots.y.shape[0]
        rows = min(CHUNK, count)
        y, factors, own = start
        places = y.shape[0] if learns(factors.solver) else 0

        def round_of(carry: tuple[SweepCarry, Any, Array]) -> tuple[SweepCarry, Any, Array]:
            c, found, matrix = carry
            first = jnp.maximum(c.left - rows, 0)
            near = jax.tree.map(lambda x: part(x, first, rows), (slots, given, found))

            def renewed(carry: tuple) -> tuple:
                _, _, at = carry
                slot = jax.tree.map(lambda x: row(x, c.left - 1 - first), near[0])
                made = kernel(self._renewed, fixed, slot, matrix, at.most)
                return jnp.array(False), made, at.refreshed(places)

            start = c.stuck, c.factors, c.at
            _, factors, at = jax.lax.while_loop(lambda carry: carry[0], renewed, start)
            c = replace_fields(c, factors=factors, at=at, stuck=jnp.array(False))
            c, near_found, matrix = kernel(self._several, fixed, first, *near, c, matrix)
            return c, jax.tree.map(lambda x, y: with_part(x, first, y), found, near_found), matrix

        first = SweepCarry(
            left=jnp.array(count),
            own=own,
            pasts=(Predictor.of(jnp.zeros_like(y)),) * self.stride,
            solution=jnp.zeros_like(y),
            at=LinearIteration.first(y, factors, self._formed_first(fixed, factors)),
            factors=factors,
            stuck=jnp.array(False),
        )
        found = jax.tree.map(jnp.zeros_like, like)
        matrix = jnp.zeros((places, *y.shape), y.dtype)
        return jax.lax.while_loop(lambda carry: carry[0].left > 0, round_of, (first, found, matrix))[:2]

    def _formed_first(self, fixed: "Fixed", factors: Factors) -> int:
        """Rows of a slot's matrix that its first own factors ask for: none where there are formulas."""
        system = fixed.numbers.whole(fixed.numbers.varied)[0]
        rows = learns(factors.solver) and kind_of(system, self.tableau).by_differences
        return fixed.unknowns if rows else 0

    def _several(
        self, fixed: "Fixed", first: Array, slots: Slot, given: Any, found: Any, c: SweepCarry, matrix: Array
    ) -> tuple[SweepCarry, Any, Array]:
        """Slots from the last one back, down to the first given here or to one that needs new factors."""

        def one(carry: tuple[SweepCarry, Any, Array]) -> tuple[SweepCarry, Any, Array]:
            c, found, matrix = carry
            here = c.left - 1 - first
            slot, own_given = jax.tree.map(lambda x: row(x, here), (slots, given))
            # Of an attempt that failed there is nothing to solve.
            c = eqx.tree_at(lambda c: c.at.done, c, c.at.done | ~slot.accepted)
            arrived = self.arriving(c.own, own_given)
            solving = self.solving(fixed, slot, arrived, own_given, c)
            start = c.solution, c.factors.changing, c.at
            solution, learnt, at, outcome, matrix = self._formed(solving, start, matrix)
            factors = c.factors.with_changes(learnt)
            stuck = any_lane(at.open & at.wanting)
            lost = slot.accepted & ~at.done
            outcome = jax.tree.map(lambda x: jnp.where(lost, jnp.nan, x), outcome)
            keep = partial(jnp.where, slot.accepted)
            own, *others = c.pasts
            pasts = jax.tree.map(keep, (*others, own.followed_by(solution, factors.inertias)), c.pasts)
            carried, found_here = self.passed_on(c.own, arrived, outcome, keep)
            # Of a slot that waits for factors nothing counts yet; this row is written again.
            found = jax.tree.map(lambda rows, x: with_row(rows, here, x), found, found_here)
            guess = pasts[0].guess
            guess = jnp.where(jnp.all(jnp.isfinite(guess)), guess, 0.0)
            following = LinearIteration.first(solution, factors, self._formed_first(fixed, factors))
            # In another system corrections may leave more.
            aged = replace_fields(factors, leaving=jnp.minimum(AGEING * factors.leaving, 1.0))
            if slot.event is not None:
                # The time of an impact is in its own equations only: elsewhere its factors leave an error.
                aged = replace_fields(aged, usable=aged.usable & (slot.event < 0))
            done = SweepCarry(c.left - 1, carried, pasts, guess, following, aged, stuck)
            waiting = replace_fields(c, solution=solution, at=at, factors=factors, stuck=stuck)
            return jax.tree.map(partial(jnp.where, stuck), waiting, done), found, matrix

        start = c, found, matrix
        return jax.lax.while_loop(lambda carry: (carry[0].left > first) & ~carry[0].stuck, one, start)

    def _formed(self, solving: Callable, start: tuple[Array, Any, LinearIteration], matrix: Array) -> tuple:
        """The system of a slot solved; or, where factors do not serve, its matrix formed for new ones.

        It is formed by the products that corrections are made with, so that it is that of the slot exactly,
        and the equations are not in the program a second time. In the loops of corrections themselves, a
        matrix would cost a tenth of their time.
        """
        if not matrix.shape[0]:
            *found, _ = solving(*start)
            return *found, matrix

        solving, (*_, nothing, _) = traced_once(solving, *start)

        def trip(carry: tuple) -> tuple:
            _, (solution, learnt, at), _, matrix = carry
            forming = at.forming
            # The product with a unit vector is the next row.
            unit = jnp.where(jnp.arange(solution.shape[0]) == at.rows, 1.0, 0.0)
            given = jnp.where(forming, unit, solution)
            found, learnt, at, outcome, product = solving(given, learnt, at)
            place = jnp.minimum(at.rows, matrix.shape[0] - 1)
            matrix = with_row(matrix, place, jnp.where(forming, product, row(matrix, place)))
            at = eqx.tree_at(lambda c: c.rows, at, at.rows + forming)
            return at.forming, (jnp.where(forming, solution, found), learnt, at), outcome, matrix

        begun = jnp.ones_like(start[2].forming), start, nothing, matrix
        _, found, outcome, matrix = jax.lax.while_loop(lambda carry: any_lane(carry[0]), trip, begun)
        return *found, outcome, matrix

    def _renewed(self, fixed: "Fixed", slot: Slot, matrix: Array, rows: Array) -> Factors:
        """New factors, for this slot, of so many rows of its matrix, or of formulas if none was asked for."""
        numbers = fixed.numbers
        system, parameters, dt = numbers.whole(numbers.varied)
        u = slot.inputs(self.plan, system, parameters, slot.before)
        equations = prepare(system, slot.before, u, slot.fraction * dt, self.tableau)
        if not matrix.shape[0]:
            return factors_of(equations.factorised(equations.tangent(slot.y)))
        matrix = matrix.T if self.columns else matrix
        if not equations.by_differences:
            matrix = jnp.where(rows > 0, matrix, equations.tangent(slot.y))
        return factors_of(equations.factorised(matrix))
