"""One evaluation of the equations of a rollout, and what follows from it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.assembly.equations import prepare, starting
from natcoord_jax.assembly.kick import Kick
from natcoord_jax.assembly.outset import Outset
from natcoord_jax.assembly.response import Evaluation
from natcoord_jax.core.state import State
from natcoord_jax.maths.rows import row, with_row
from natcoord_jax.stepping.course import Course, Setting, after_attempt
from natcoord_jax.stepping.newton import Factors, Iterate, any_lane, factors_of, judge, refreshed
from natcoord_jax.stepping.parts import Apart, Together
from natcoord_jax.stepping.probe import Probe
from natcoord_jax.stepping.step import end_of_step


class Stand(eqx.Module):
    """Where a rollout stands.

    Attributes:
        course: without its state.
        state: the state in one array: fewer operations than one for every field.
        outset: what the equations need of that state.
        probe: the Jacobian in the making.
    """

    course: Course
    state: Float[Array, " numbers"]
    outset: Outset
    probe: Probe | None


class Carried(eqx.Module):
    """What goes from one evaluation of the equations to the next; some of it is held, see `parts`.

    Attributes:
        count: complete slots.
        running: whether the rollout goes on, in any lane.
        stand: a `Stand`.
        solver: solver and inertias of `Factors`.
        history: all else of `Factors`.
        record: fields of `Slots`, for every slot; the states in one array.
    """

    count: Int[Array, ""]
    running: Bool[Array, ""]
    stand: Any
    solver: Any
    history: Any
    record: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Trip:
    """One evaluation of the equations, and what follows from it.

    Attributes:
        setting: of the rollout; held.
        unpack: of the array of a state.
        parts: how the parts are compiled.
    """

    setting: Any
    unpack: Callable[[Array], State]
    parts: type[Apart] | type[Together]

    def __call__(self, carried: Carried) -> Carried:
        """The whole of it."""
        count, solver, call = carried.count, carried.solver, self.parts.call
        ending, wanting, stand, found = call(
            self._evaluated, self.setting, carried.stand, solver, carried.history
        )

        # Loops of no or one trip leave what they carry where it is; a conditional would copy it.
        def ended(carry: tuple) -> tuple:
            *_, stand, history, record = carry
            running, undone, stand, history, *slot = call(
                self._ended, self.setting, stand, solver, history, found
            )
            if undone is not None:
                record = _taken_back(record, count - 1, undone, slot[0])
            record = tuple(with_row(b, count, r) for b, r in zip(record, slot))
            return jnp.array(False), running, stand, history, record

        def renewed(carry: tuple) -> tuple:
            _, stand, _, history = carry
            return jnp.array(False), *call(self._renewed, self.setting, stand, history, found)

        start = ending, carried.running, stand, carried.history, carried.record
        _, running, stand, history, record = jax.lax.while_loop(lambda carry: carry[0], ended, start)
        start = wanting, stand, solver, history
        _, stand, solver, history = jax.lax.while_loop(lambda carry: carry[0], renewed, start)
        return Carried(count + ending, running, stand, solver, history, record)

    def _prepared(self, setting: Setting, stand: Stand) -> tuple[Course, Any, Array, Array]:
        """The course with its state; equations, length and number of the (sub)step."""
        course = with_state(stand.course, self.unpack(stand.state))
        u, h, index = setting.situation(course)
        tableau = setting.plan.tableau
        return course, prepare(setting.system, course.state, u, h, tableau, stand.outset), h, index

    def _evaluated(self, setting: Setting, stand: Stand, solver: tuple, history: tuple) -> tuple:
        """The equations at the unknowns, and what this says of the iteration.

        Returns:
            Whether the attempt is over, whether new factors are wanted, where the rollout stands now, and
            for the other parts: the evaluation, where, and what has been found of a new Jacobian.
        """
        course, equations, *_ = self._prepared(setting, stand)
        it, probe, over = course.it, stand.probe, setting.over(course)
        found = equations.evaluate(it.y if probe is None else probe.moved(it.y, equations))
        probing = jnp.array(False) if probe is None else probe.at >= 0
        judged = _judged(setting, equations, Factors(*solver, *history), it, found)
        after = jax.tree.map(partial(jnp.where, probing), it, judged)
        ending = ~probing & ~any_lane(after.unsolved & ~over)
        wanting = ~probing & ~ending & any_lane(after.wanting & after.unsolved & ~over)
        if probe is not None:
            probe, wanting = probe.with_column(after.y, found.residual, equations, wanting)
        course = eqx.tree_at(lambda c: c.it, stand.course, after)
        return ending, wanting, Stand(course, stand.state, stand.outset, probe), (found, it.y)

    def _ended(
        self, setting: Setting, stand: Stand, solver: tuple, history: tuple, known: tuple[Evaluation, Array]
    ) -> tuple:
        """The end of an attempt: what follows from it, and the record of the slot."""
        found, _ = known
        before, equations, h, index = self._prepared(setting, stand)
        it, factors = before.it, Factors(*solver, *history)
        ends = end_of_step(setting.system, before.state, h, equations.groups, found, setting.plan.tableau)
        after = after_attempt(setting, before, factors.inertias, ends)
        accepted = after.taken > before.taken
        x = ravel_pytree(after.state)[0]
        slot = x, it.y, index, before.fraction, before.done, accepted, after.step
        outset = _outset_after(setting, after, accepted, stand.outset, found.kick)
        # An attempt for comparison leaves the run where it is, and factors that serve.
        solved = accepted if setting.tolerance is None else it.converged
        kept = factors.after_step(it, solved | setting.over(before), _cost(equations, it))
        running = any_lane(~setting.over(after))
        undone = None if after.trial is None else after.trial.undone
        stand = Stand(with_state(after, None), x, outset, stand.probe)
        return running, undone, stand, kept.history, *slot

    def _renewed(
        self, setting: Setting, stand: Stand, history: tuple, known: tuple[Evaluation, Array]
    ) -> tuple:
        """The iteration with new factors, and these."""
        found, last = known
        course, equations, *_ = self._prepared(setting, stand)
        it, noise = course.it, history[-1]
        if stand.probe is not None:
            made = factors_of(equations, stand.probe.columns[:-1].T, noise)
            it = refreshed(it)
        else:
            # Evaluated where the new factors belong, unless these begin anew where the step began.
            here = jnp.all(it.y == last)
            loads = jax.tree.map(lambda x: jnp.where(here, x, 0.0), found.loads)
            made = factors_of(equations, equations.tangent(it.y, loads), noise)
            it = refreshed(it)
            # What the residual asks for with new factors needs no evaluation.
            moved = _judged(setting, equations, made, it, found)
            it = jax.tree.map(partial(jnp.where, here & it.unsolved), moved, it)
        course = eqx.tree_at(lambda c: c.it, stand.course, it)
        stand = Stand(course, stand.state, stand.outset, stand.probe)
        return stand, (made.solver, made.inertias), made.history


def _cost(equations: Any, it: Iterate) -> int:
    """Cost of new factors, in corrections."""
    return max(equations.renewal, it.y.shape[0] // 2 if equations.by_differences else 0)


def _judged(setting: Setting, equations: Any, factors: Factors, it: Iterate, found: Evaluation) -> Iterate:
    driven = any(group.multipliers and group.effect.works for group in equations.groups)
    given = factors, setting.plan.tolerance, it, found.residual, found.size
    return judge(*given, balances=driven, patience=_cost(equations, it))


def _outset_after(
    setting: Setting, after: Course, accepted: Array, known: Outset, kick: Kick | None
) -> Outset:
    """What is known of the state that the next attempt starts from."""
    tangents = None
    if kick is not None and known.tangents is not None and setting.tolerance is None:
        # The end of this step is the start of the next one. (With error control it may be neither.)
        reached = kick.after.without_system()
        tangents = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), reached, known.tangents)
    return starting(setting.system, after.state, setting.plan.tableau, tangents)


def _taken_back(record: tuple, index: Array, undone: Array, x: Array) -> tuple:
    """The record with one slot that was not accepted after all, if it was not."""
    states, *others, accepted, finished = record
    index = jnp.maximum(index, 0)
    states = with_row(states, index, jnp.where(undone, x, row(states, index)))
    accepted = with_row(accepted, index, row(accepted, index) & ~undone)
    return states, *others, accepted, finished


def _is_none(x: Any) -> bool:
    return x is None


def with_state(course: Course, state: State | None) -> Course:
    """A course with another state, or with none."""
    return eqx.tree_at(lambda c: c.state, course, state, is_leaf=_is_none)
