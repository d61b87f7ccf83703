"""Where a rollout stands, and what an attempt at a (sub)step makes of it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.failures import result_of
from natcoord_jax.mechanics.frozen_kick import FEWEST, FrozenKick, Lagging, from_body_axes, in_body_axes
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.mechanics.tangent_space import Velocity
from natcoord_jax.stepping.checked import check_contacts
from natcoord_jax.stepping.error_control import StepDecision, Tolerance, Trial, follow
from natcoord_jax.stepping.factors import Factors, no_factors
from natcoord_jax.stepping.located import COMPLETE, Ahead, ImpactSearch, with_impacts
from natcoord_jax.stepping.newton import Iterate, any_lane, begin
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.predictor import Predictor
from natcoord_jax.system import System
from natcoord_jax.xla.rows import part

SMALLEST_FRACTION = 1.0 / 2**16
"""A step is given up when a substep of this fraction of it fails, if slots have not run out before."""

LARGEST_HALF_TURN = 10.0
"""Tangent of half the largest rotation of a body in one (sub)step, 169 degrees: beyond lies the pole."""


class RolloutState(eqx.Module):
    """Where a rollout stands: carried from slot to slot.

    Attributes:
        state: at the start of the attempt at hand.
        it: its iteration.
        past: solutions of earlier attempts, and the kicks with them in the axes of the bodies.
        step: steps completed.
        done: part of the step at hand that is done.
        fraction: part of it that is attempted.
        code: result.
        stopped: whether the run has ended before its time.
        worst: unknown with the largest correction in the last attempt that failed, -1 without one; -2
            less the number of the first element that was turned inside out.
        taken: accepted (sub)steps.
        rejected: (sub)steps that were repeated in parts.
        iterations: corrections in all attempts.
        iterations_max: in one of them.
        residual: largest accepted.
        trial: where a substep with error control stands.
        lagging: what is known of the kick; None for schemes without.
        left: impulse that the last (sub)step left to the next, see `remainder`.
        search: where the search for impacts stands; None for schemes that do not locate them.
    """

    state: State
    it: Iterate
    past: Predictor
    step: Int[Array, ""]
    done: Float[Array, ""]
    fraction: Float[Array, ""]
    code: Int[Array, ""]
    stopped: Bool[Array, ""]
    worst: Int[Array, ""]
    taken: Int[Array, ""]
    rejected: Int[Array, ""]
    iterations: Int[Array, ""]
    iterations_max: Int[Array, ""]
    residual: Float[Array, ""]
    trial: Trial | None
    lagging: Lagging | None
    left: Float[Array, " rates"]
    search: ImpactSearch | None = None


class RolloutProblem(eqx.Module):
    """What stays the same over a rollout.

    Attributes:
        system: compiled system.
        parameters: of the inputs.
        dt: step [s].
        tolerance: of the error of substeps; None: steps are made as they are given.
        plan: what is static.
        steps: number of steps.
        first: step of the first of the inputs that are given as an array.
        event: numbers of the event.
    """

    system: System
    parameters: Any
    dt: Float[Array, ""]
    tolerance: Tolerance | None
    plan: Plan = eqx.field(static=True)
    steps: Int[Array, ""] | int
    first: Int[Array, ""] | int = 0
    event: Any = None

    def near(self, course: RolloutState, steps: int) -> "RolloutProblem":
        """With the inputs of the next steps only."""
        if self.plan.control is not None or self.parameters.shape[0] <= steps:
            return self
        first = jnp.minimum(course.step, self.parameters.shape[0] - steps)
        some = part(self.parameters, first, steps)
        return RolloutProblem(
            self.system, some, self.dt, self.tolerance, self.plan, self.steps, first, self.event
        )

    def over(self, course: RolloutState) -> Bool[Array, ""]:
        """Whether the rollout has ended."""
        over = course.stopped | (course.step >= self.steps)
        if self.tolerance is None:
            return over
        return over | (course.taken >= self.steps + self.plan.extra)

    def lag(self, course: RolloutState) -> FrozenKick | None:
        """What the evaluation of the equations is told of the kick, if there is any."""
        lagging, it, over = course.lagging, course.it, self.over(course)
        if lagging is None:
            return None
        going = it.unsolved & ~over
        # Lanes that are done wait for the others; the last evaluation has the kicks of all.
        wanted = any_lane(lagging.wanted(it) & going) | ~any_lane(going)
        closed = (lagging.closed > 0) & ~over
        return FrozenKick(lagging.held, wanted, closed, jnp.zeros_like(closed))

    def situation(self, course: RolloutState) -> tuple[Array, Array, Array]:
        """Inputs, length and number of the (sub)step at hand."""
        h = jnp.where(self.over(course), 1e-3, course.fraction * self.dt)
        index = jnp.minimum(course.step, self.steps - 1)
        given = index if self.plan.control is not None else index - self.first
        u = self.plan.inputs(self.system, self.parameters, given, course.state, course.done, course.fraction)
        return u, h, index


def start_of(setting: RolloutProblem, state: State) -> tuple[RolloutState, Factors, StartCache]:
    """The first attempt, factors that are none, and what is known of the first state."""
    dt, plan = setting.dt, setting.plan
    check_contacts(setting.system, plan.tableau)
    u = plan.inputs(setting.system, setting.parameters, jnp.array(0), state, jnp.zeros(()), jnp.ones(()))
    equations = prepare(setting.system, state, u, dt, plan.tableau)
    few = setting.tolerance is not None
    guess = equations.guess()
    left = jnp.zeros_like(equations.by_stage(guess)[0])
    it, factors = begin(guess, few), no_factors(equations)
    zero, nought = jnp.array(0), jnp.zeros((), state.q.dtype)
    bad = ~(jnp.isfinite(dt) & (dt > 0))
    lagging = None
    structure = setting.system.structure
    if plan.tableau.kick and structure.unknowns + structure.multipliers >= FEWEST:
        lagging = Lagging.begin(
            Velocity(jnp.zeros_like(state.q.reshape(-1, 4, 3)), jnp.zeros_like(state.rates))
        )
    course = RolloutState(
        state=state,
        it=it,
        past=Predictor.of(
            it.y if lagging is None else jnp.concatenate([it.y, in_body_axes(state, lagging.held)])
        ),
        step=zero,
        done=nought,
        fraction=nought + 1.0,
        code=jnp.where(bad, int(Result.BAD_STEP), int(Result.SUCCESSFUL)),
        stopped=bad,
        worst=zero - 1,
        taken=zero,
        rejected=zero,
        iterations=zero,
        iterations_max=zero,
        residual=nought,
        trial=None if setting.tolerance is None else Trial.first(state, left),
        lagging=lagging,
        left=left,
        search=ImpactSearch.first() if plan.tableau.max_events else None,
    )
    return course, factors, equations.start_cache


def _halve(course: RolloutState, after: State, solved: Array, over: Array) -> StepDecision:
    """Substeps without error control: a failed attempt is repeated with half its length."""
    accepted = solved & ~over
    state = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), after, course.state)
    done = course.done + jnp.where(accepted, course.fraction, 0.0)
    halved = 0.5 * course.fraction
    return StepDecision(
        trial=None,
        state=state,
        done=done,
        fraction=jnp.where(accepted | over, course.fraction, halved),
        change=jnp.where(accepted, 1, 0),
        accepted=accepted,
        failed=~solved & ~over,
        hopeless=~solved & ~over & (halved < SMALLEST_FRACTION),
    )


def after_attempt(
    setting: RolloutProblem,
    course: RolloutState,
    inertias: Array,
    found: tuple[State, Array],
    left: Float[Array, " rates"],
    kick: Velocity | None = None,
    ahead: Ahead | None = None,
    failure: Int[Array, ""] | None = None,
) -> RolloutState:
    """The end of an attempt: what is attempted next, and from where.

    Args:
        setting: of the rollout.
        course: with the solved iteration.
        inertias: of the unknowns.
        found: state at the end of the attempt, and its largest half turn.
        left: impulse that it leaves to the next.
        kick: of the attempt.
        ahead: contacts in it, where impacts are located.
        failure: what is wrong with a solution, see `mechanics.failures`.
    """
    plan, it, over = setting.plan, course.it, setting.over(course)
    new, half_turn = found
    finite = jnp.all(jnp.isfinite(new.q)) & jnp.all(jnp.isfinite(new.v))
    code = jnp.where((it.code == 0) & ~finite, int(Result.NONFINITE), it.code)
    code = jnp.where((code == 0) & (half_turn > LARGEST_HALF_TURN), int(Result.DIVERGED), code)
    worst = it.worst
    if failure is not None:
        worst = jnp.where((code == 0) & (failure >= 0), -2 - failure, worst)
        code = jnp.where(worst < -1, result_of(setting.system, -2 - worst), code)
    solved = code == int(Result.SUCCESSFUL)
    origin = course.state
    if course.trial is None or setting.tolerance is None:
        verdict = _halve(course, new, solved, over)
    else:
        origin = course.trial.origin
        verdict = follow(setting.tolerance, course.trial, course.state, new, solved, over, plan.tableau)
        code = jnp.where(solved, int(Result.TOLERANCE_NOT_MET), code)
    search, nearly = course.search, 1e-9
    if search is not None and ahead is not None:
        most = plan.tableau.max_events
        search, verdict = with_impacts(search, ahead, verdict, course, most, solved & ~over)
        nearly = COMPLETE
    complete = verdict.accepted & (verdict.done > 1.0 - nearly)
    stopped = course.stopped | verdict.hopeless
    result = jnp.where(verdict.hopeless, code, course.code)
    if plan.event is not None:
        before, after = (plan.indicator(setting.system, setting.event, x) for x in (origin, verdict.state))
        crossed = verdict.accepted & (before * after <= 0) & (before != 0)
        stopped, result = stopped | crossed, jnp.where(crossed, int(Result.EVENT), result)
    done, fraction, trial = verdict.done, verdict.fraction, verdict.trial
    left = jnp.where(verdict.change > 0, left, course.left)
    done = jnp.where(complete, 0.0, done)
    if trial is None:
        fraction = jnp.where(complete, 1.0, fraction)
    else:
        left = jnp.where(verdict.change < 0, trial.left, left)
        trial = trial.beginning(done, complete).leaving(left, verdict.accepted | verdict.failed)
        fraction = jnp.where(complete, trial.length, fraction)
    kept, worked = verdict.change > 0, jnp.where(over, 0, it.total)
    # Guesses hold for steps of one length: another length begins anew from the last solution.
    solution, size = it.y, it.y.shape[0]
    if kick is not None:
        # What the past says of kicks is measured by the rates that go with them.
        kicks = in_body_axes(course.state, kick)
        solution = jnp.concatenate([it.y, kicks])
        inertias = jnp.concatenate([inertias, jnp.zeros_like(kicks)])
    alone = Predictor(
        course.past.differences, jnp.ones_like(course.past.known), jnp.zeros_like(course.past.order)
    )
    if trial is not None:
        alone = alone.beginning_with(solution, solved)
    followed = course.past.followed_by(solution, inertias)
    past = jax.tree.map(lambda x, y: jnp.where(kept, x, y), followed, alone)
    same = fraction == course.fraction
    past = Predictor(past.differences, jnp.where(same, past.known, 1), jnp.where(same, past.order, 0))
    guess, lagging = past.guess, course.lagging
    sound = jnp.all(jnp.isfinite(guess))
    if lagging is not None:
        lagging = lagging.beginning(from_body_axes(verdict.state, jnp.where(sound, guess[size:], 0.0)))
    return RolloutState(
        state=verdict.state,
        it=begin(jnp.where(sound, guess[:size], it.start), few=trial is not None),
        past=past,
        step=course.step + complete,
        done=done,
        fraction=fraction,
        code=result,
        stopped=stopped,
        worst=jnp.where(verdict.hopeless | verdict.failed, worst, course.worst),
        taken=course.taken + verdict.change,
        rejected=course.rejected + verdict.failed,
        iterations=course.iterations + worked,
        iterations_max=jnp.maximum(course.iterations_max, worked),
        residual=jnp.where(kept, jnp.maximum(course.residual, it.error), course.residual),
        trial=trial,
        lagging=lagging,
        left=left,
        search=search,
    )
