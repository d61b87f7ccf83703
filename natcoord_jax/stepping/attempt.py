"""One attempt at a (sub)step in a rollout: evaluations of its equations, and what follows from them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.block_tangent_space import with_system
from natcoord_jax.mechanics.equations import prepare, starting
from natcoord_jax.mechanics.failures import first_failure
from natcoord_jax.mechanics.free_flight import in_free_flight
from natcoord_jax.mechanics.frozen_kick import Lagging
from natcoord_jax.mechanics.kick import Kick
from natcoord_jax.mechanics.redundancy import contact_weights
from natcoord_jax.mechanics.response import Evaluation
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.mechanics.tangent_space import driven
from natcoord_jax.mechanics.violations import contact_gaps
from natcoord_jax.stepping.after_attempt import after_attempt
from natcoord_jax.stepping.difference_jacobian import DifferenceJacobian, evaluated, told
from natcoord_jax.stepping.energy_check import motion_of, sound
from natcoord_jax.stepping.factors import Factors, factors_of
from natcoord_jax.stepping.located import WHOLE, Ahead
from natcoord_jax.stepping.newton import Iterate, any_lane, begin, judge, refreshed
from natcoord_jax.stepping.remainder import remainder, with_remainder
from natcoord_jax.stepping.rollout_state import RolloutProblem, RolloutState
from natcoord_jax.stepping.step import end_of_step
from natcoord_jax.xla.rows import row, with_row


class LoopCarry(eqx.Module):
    """What goes from one attempt to the next.

    Attributes:
        count: complete slots.
        course: where the rollout stands, its state left out.
        state: the state in one array: fewer operations than one for every field.
        start_cache: what the equations need of that state.
        factors: of a Jacobian.
        probe: what Jacobians by differences are formed with; None: they have formulas.
        record: fields of `Slots`, for every slot; the states in one array.
        first: slot of the first row of the record.
        asked: what new factors are asked for with; None: they are made where they are wanted.
    """

    count: Int[Array, ""]
    course: RolloutState
    state: Float[Array, " numbers"]
    start_cache: StartCache
    factors: Factors
    probe: DifferenceJacobian | None
    record: tuple[Array, ...]
    first: Int[Array, ""]
    asked: "RefactorRequest | None"


class RefactorRequest(eqx.Module):
    """What is known where new factors are wanted.

    Attributes:
        wanting: whether they are.
        residual: of the equations, where they were evaluated last.
        size: of their terms.
        loads: of the equations, see `Evaluation.loads`.
        here: whether they are wanted where the equations were evaluated, not where the step began.
    """

    wanting: Bool[Array, ""]
    residual: Float[Array, " unknowns"]
    size: Float[Array, ""]
    loads: Any
    here: Bool[Array, ""]


class NewtonCarry(eqx.Module):
    """Where the equations of an attempt stand, from one evaluation to the next.

    Attributes:
        it: the iteration.
        lagging: what is known of the kick.
        factors: of a Jacobian.
        probe: what Jacobians by differences are formed with.
        found: the last evaluation, without the system.
        residual: of the equations there, with what the step before has left.
        ending: whether the attempt is at its end.
        wanting: whether new factors are asked for, which are made elsewhere.
        here: whether they are wanted where the equations were evaluated, not where the step began.
    """

    it: Iterate
    lagging: Lagging | None
    factors: Factors
    probe: DifferenceJacobian | None
    found: Evaluation
    residual: Float[Array, " unknowns"]
    ending: Bool[Array, ""]
    wanting: Bool[Array, ""]
    here: Bool[Array, ""]


def attempt(
    setting: RolloutProblem, unpack: Callable[[Array], State], apart: bool, carried: LoopCarry
) -> LoopCarry:
    """One attempt at a (sub)step, to its end; if apart, no further than to where new factors are wanted.

    What does not change from one evaluation to the next is outside of the loop over these, where the compiler
    can see it: 5 to 18 % of the time of a step of order two.
    """
    course = replace_fields(carried.course, state=unpack(carried.state))
    u, h, index = setting.situation(course)
    search = course.search
    system = setting.system
    if search is not None:
        system = in_free_flight(system, course.state, setting.dt, search.event != WHOLE)
    equations = prepare(system, course.state, u, h, setting.plan.tableau, carried.start_cache)
    start = _unsolved(equations, carried)
    evaluate = partial(_evaluation, setting, course, equations, apart)
    solving = jax.lax.while_loop(lambda s: ~(s.ending | s.wanting), evaluate, start)
    begun = replace_fields(carried.course, it=solving.it, lagging=solving.lagging)
    found = with_system(solving.found, setting.system)

    def ended(carry: tuple) -> tuple:
        _, before, x, _, record, factors = carry
        before = replace_fields(before, state=unpack(x))
        ends = end_of_step(replace_fields(equations, state=before.state), found)
        kick = None if before.lagging is None else found.kick.exact
        given = solving.residual, found.size, before.it.correction, ends[0], setting.plan.tolerance
        steady = sound(equations, before.it.y, *given, factors.grain)
        before = eqx.tree_at(lambda c: c.it.converged, before, before.it.converged & steady)
        left = remainder(equations, solving.residual, factors.inertias)
        ahead = None if search is None else Ahead.of(system, before.state, found.at, h, setting.dt)
        failure = first_failure(equations, ends[0])
        after = after_attempt(setting, before, factors.inertias, ends, left, kick, ahead, failure)
        accepted = after.taken > before.taken
        x = ravel_pytree(after.state)[0]
        slot = x, before.it.y, index, before.fraction, before.done, accepted, after.step
        if after.search is not None:
            slot = *slot, after.search.ended
        if after.trial is not None:
            record = _taken_back(record, carried.count - 1 - carried.first, after.trial.undone, x)
        record = tuple(with_row(b, carried.count - carried.first, r) for b, r in zip(record, slot))
        start_cache = _outset_after(setting, after, accepted, carried.start_cache, found.kick)
        after = _with_normal_kick(setting, after, start_cache)
        if any(group.effect.bends for group in system.effects):
            few, failed = after.trial is not None, after.rejected > before.rejected
            it = jax.lax.cond(failed, lambda: begin(_sticking(equations), few), lambda: after.it)
            after = replace_fields(after, it=it)
        factors = _kept(setting, equations, before, after, factors, solving.probe)
        return jnp.array(False), replace_fields(after, state=None), x, start_cache, record, factors

    carry = solving.ending, begun, carried.state, carried.start_cache, carried.record, solving.factors
    if apart:
        # A loop of no or one trip leaves what it carries where it is; a conditional would copy it.
        carry = jax.lax.while_loop(lambda carry: carry[0], ended, carry)
    else:
        carry = ended(carry)
    _, after, x, start_cache, record, factors = carry
    wanted = solving.wanting, solving.residual, found.size, found.loads, solving.here
    asked = RefactorRequest(*wanted) if apart else None
    count = carried.count + _recorded(solving.ending, carried.course, after)
    return LoopCarry(count, after, x, start_cache, factors, solving.probe, record, carried.first, asked)


def _sticking(equations: Any) -> Float[Array, " unknowns"]:
    """A guess from which what sticks is found where friction presses more than it takes (Painleve's rod).

    Nothing moves, and contacts that may close press as much as all that moves could. From slip it is not.
    """
    system, state, multipliers = equations.system, equations.state, equations.split(equations.guess())[1]
    for k, group in enumerate(equations.groups):
        if group.effect.unilateral:
            mobility, gap = group.effect.mobility, contact_gaps(system, [group], state)
            speed = jnp.sqrt(motion_of(system, state) * mobility)
            pressed = jnp.where(0.5 * speed * equations.h > gap, speed / mobility, 0.0)
            multipliers[k] = multipliers[k].at[:, 0, 0].set(pressed)
    return jnp.concatenate([jnp.zeros(equations.balances), *(lam.reshape(-1) for lam in multipliers)])


def _with_normal_kick(setting: RolloutProblem, after: RolloutState, start_cache: Any) -> RolloutState:
    """With the kick at hand along the normals: another one would change momenta."""
    if after.lagging is None or start_cache.tangents is None:
        return after
    held = with_system(start_cache.tangents, setting.system).normal(after.lagging.held)
    return eqx.tree_at(lambda c: c.lagging.held, after, held)


def _recorded(ending: Bool[Array, ""], before: RolloutState, after: RolloutState) -> Bool[Array, ""]:
    """Whether an attempt that ends leaves a record: those that look for an impact leave none."""
    if after.search is None:
        return ending
    return ending & any_lane((after.taken > before.taken) | (after.rejected > before.rejected))


def _unsolved(equations: Any, carried: LoopCarry) -> NewtonCarry:
    """Before the first evaluation."""
    course, no = carried.course, jnp.array(False)
    shapes = jax.eval_shape(lambda y: with_system(equations.evaluate(y), None), course.it.y)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    given = course.it, course.lagging, carried.factors, carried.probe
    return NewtonCarry(*given, blank, blank.residual, no, no, no)


def _evaluation(
    setting: RolloutProblem, course: RolloutState, equations: Any, apart: bool, solving: NewtonCarry
) -> NewtonCarry:
    """One evaluation of the equations, and what follows from it.

    If apart, new factors are asked for, but not made.
    """
    it, lagging, factors, probe = solving.it, solving.lagging, solving.factors, solving.probe
    over = setting.over(course)
    lag = setting.lag(replace_fields(course, it=it, lagging=lagging))
    equations = replace_fields(equations, start_cache=replace_fields(equations.start_cache, lag=lag))
    if probe is None:
        found = equations.evaluate(it.y)
    else:
        lag = told(lag, probe.making)
        probe, found, it, factors = evaluated(setting, equations, probe, solving.found, it, factors)
    residual = with_remainder(equations, found.residual, course.left)
    cost, options = _judging(equations, it, probe)
    if lag is not None and lagging is not None:
        options |= {"jumped": lagging.jumped(found.kick, lag, it), "whole": lag.due}
    judged, factors = judge(factors, setting.plan.tolerance, it, residual, found.size, **options)
    if lag is not None and lagging is not None:
        lagging = lagging.after(found.kick, lag.due, judged.correction, it)
    it, here = judged, jnp.all(judged.y == it.y)
    ending = ~any_lane(it.unsolved & ~over)
    if lag is not None:
        ending = ending & lag.due
    wanting = ~ending & any_lane(it.wanting & it.unsolved & ~over)
    if probe is not None:
        # Differences need the kick: where the iteration begins anew, it is found first.
        astray = any_lane(it.wanting & it.unsolved & ~over & ~here)
        probe = probe.asked(wanting & ~astray, any_lane(it.rounds), setting.plan.tableau.stages)
        wanting = jnp.array(False)
    elif not apart:
        asked = RefactorRequest(wanting, residual, found.size, found.loads, here)

        def renewed(carry: tuple) -> tuple:
            _, it, factors = carry
            return jnp.array(False), *renewed_at(setting, equations, it, factors, asked)

        wanting, it, factors = jax.lax.while_loop(lambda carry: carry[0], renewed, (wanting, it, factors))
    return NewtonCarry(it, lagging, factors, probe, with_system(found, None), residual, ending, wanting, here)


def _kept(
    setting: RolloutProblem,
    equations: Any,
    before: RolloutState,
    after: RolloutState,
    factors: Factors,
    probe: DifferenceJacobian | None,
) -> Factors:
    """Factors after an attempt."""
    # An attempt for comparison leaves the run where it is, and factors that serve.
    solved = after.taken > before.taken if setting.tolerance is None else before.it.converged
    cost, _ = _judging(equations, before.it, probe)
    factors = factors.after_step(before.it, solved | setting.over(before), cost)
    if before.lagging is not None and after.lagging is not None:
        # Factors of equations in which kicks are held are not those of equations in which they are not.
        other = (before.lagging.closed > 0) != (after.lagging.closed > 0)
        factors = eqx.tree_at(lambda f: f.usable, factors, factors.usable & ~other)
    return factors


def _judging(equations: Any, it: Iterate, probe: DifferenceJacobian | None) -> tuple[int, dict[str, Any]]:
    """Cost of new factors, in corrections, and options of `judge`."""
    cost = equations.renewal if probe is None else max(equations.renewal, it.y.shape[0] // 2)
    alike = False if probe is None else probe.alike
    impulses = equations.system.structure.inequalities > 0
    options = {"balances": driven(equations.system) or impulses, "patience": cost, "alike": alike}
    if impulses:
        options["contacts"] = contact_weights(equations)
    return cost, options


def renewed_at(
    setting: RolloutProblem, equations: Any, it: Iterate, factors: Factors, asked: RefactorRequest
) -> tuple[Iterate, Factors]:
    """New factors by formulas, and the iteration with them."""
    _, options = _judging(equations, it, None)
    loads = jax.tree.map(lambda x: jnp.where(asked.here, x, 0.0), asked.loads)
    made = equations.factorised(equations.tangent(it.y, loads))
    factors = factors_of(made, factors.noise, equations.grain)
    it = refreshed(it)
    # What the residual asks for with new factors needs no evaluation; but the kick in it may have been held.
    options |= {"whole": not setting.plan.tableau.kick}
    moved, factors = judge(factors, setting.plan.tolerance, it, asked.residual, asked.size, **options)
    return jax.tree.map(partial(jnp.where, asked.here & it.unsolved), moved, it), factors


def _outset_after(
    setting: RolloutProblem, after: RolloutState, accepted: Array, known: StartCache, kick: Kick | None
) -> StartCache:
    """What is known of the state that the next attempt starts from."""
    tangents = None
    if kick is not None and known.tangents is not None and setting.tolerance is None:
        # The end of this step is the start of the next one. (With error control it may be neither.)
        reached = with_system(kick.after, None)
        tangents = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), reached, known.tangents)
    return starting(setting.system, after.state, setting.plan.tableau, tangents)


def _taken_back(record: tuple, index: Array, undone: Array, x: Array) -> tuple:
    """The record with one slot that was not accepted after all, if it was not."""
    states, *others, accepted, finished = record
    index = jnp.maximum(index, 0)
    states = with_row(states, index, jnp.where(undone, x, row(states, index)))
    accepted = with_row(accepted, index, row(accepted, index) & ~undone)
    return states, *others, accepted, finished
