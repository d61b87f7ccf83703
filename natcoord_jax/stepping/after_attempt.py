"""What an attempt at a (sub)step makes of the state of a rollout."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.failures import result_of
from natcoord_jax.mechanics.frozen_kick import from_body_axes, in_body_axes
from natcoord_jax.mechanics.tangent_space import Velocity
from natcoord_jax.stepping.error_control import StepDecision, Trial, follow
from natcoord_jax.stepping.located import COMPLETE, Ahead, with_impacts
from natcoord_jax.stepping.newton import Iterate, begin
from natcoord_jax.stepping.rollout_state import Predictor, RolloutProblem, RolloutState
from natcoord_jax.system import System

SMALLEST_FRACTION = 1.0 / 2**16
"""A step is given up when a substep of this fraction of it fails, if slots have not run out before."""

LARGEST_HALF_TURN = 10.0
"""Tangent of half the largest rotation of a body in one (sub)step, 169 degrees: beyond lies the pole."""


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


def _looked_at(
    system: System, it: Iterate, new: State, half_turn: Float[Array, ""], failure: Array | None
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Code of an attempt, and the number of what is worst about it, with what its end says."""
    finite = jnp.all(jnp.isfinite(new.q)) & jnp.all(jnp.isfinite(new.v))
    code = jnp.where((it.code == 0) & ~finite, int(Result.NONFINITE), it.code)
    code = jnp.where((code == 0) & (half_turn > LARGEST_HALF_TURN), int(Result.DIVERGED), code)
    worst = it.worst
    if failure is not None:
        # (A drive that jumps does so whether or not equations have a solution then.)
        names = (code == 0) | (result_of(system, failure) == int(Result.JUMPED))
        worst = jnp.where((failure >= 0) & names, -2 - failure, worst)
        code = jnp.where(worst < -1, result_of(system, -2 - worst), code)
    return code, worst


def _followed(
    course: RolloutState,
    it: Iterate,
    inertias: Array,
    kick: Velocity | None,
    trial: Trial | None,
    solved: Array,
    kept: Array,
    fraction: Array,
) -> Predictor:
    """What the next guess is made of: solutions so far, if the next step is as long as these.

    Guesses hold for steps of one length: another length begins anew from the last solution.
    """
    solution = it.y
    if kick is not None:
        # What the past says of kicks is measured by the rates that go with them.
        kicks = in_body_axes(course.state, kick)
        solution = jnp.concatenate([it.y, kicks])
        inertias = jnp.concatenate([inertias, jnp.zeros_like(kicks)])
    first, *more = course.past.differences
    if trial is not None:
        # An attempt that was made for comparison has a solution, too, if there is one.
        first = jnp.where(solved, solution, first)
    alone = Predictor((first, *more), jnp.ones_like(course.past.known), jnp.zeros_like(course.past.order))
    followed = course.past.followed_by(solution, inertias)
    past = jax.tree.map(lambda x, y: jnp.where(kept, x, y), followed, alone)
    same = fraction == course.fraction
    return Predictor(past.differences, jnp.where(same, past.known, 1), jnp.where(same, past.order, 0))


def _ended(
    setting: RolloutProblem, course: RolloutState, verdict: StepDecision, code: Array
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Whether the run is over, for good or by its event, and its code."""
    plan, stopped = setting.plan, course.stopped | verdict.hopeless
    result = jnp.where(verdict.hopeless, code, course.code)
    if plan.event is not None:
        origin = course.state if course.trial is None else course.trial.origin
        before, after = (plan.indicator(setting.system, setting.event, x) for x in (origin, verdict.state))
        crossed = verdict.accepted & (before * after <= 0) & (before != 0)
        stopped, result = stopped | crossed, jnp.where(crossed, int(Result.EVENT), result)
    return stopped, result


def _next_part(
    course: RolloutState, verdict: StepDecision, complete: Array, left: Array
) -> tuple[Array, Array, Trial | None, Array]:
    """What is done of the step, the part that comes next, its trial, and the impulse left to it."""
    fraction, trial = verdict.fraction, verdict.trial
    left = jnp.where(verdict.change > 0, left, course.left)
    done = jnp.where(complete, 0.0, verdict.done)
    if trial is None:
        return done, jnp.where(complete, 1.0, fraction), None, left
    left = jnp.where(verdict.change < 0, trial.left, left)
    before = jnp.where(verdict.accepted | verdict.failed, left, trial.left)
    trial = replace_fields(trial.beginning(done, complete), left=before)
    return done, jnp.where(complete, trial.length, fraction), trial, left


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
    tableau, it, over = setting.plan.tableau, course.it, setting.over(course)
    code, worst = _looked_at(setting.system, it, *found, failure)
    solved = code == int(Result.SUCCESSFUL)
    if course.trial is None or setting.tolerance is None:
        verdict = _halve(course, found[0], solved, over)
    else:
        verdict = follow(setting.tolerance, course.trial, course.state, found[0], solved, over, tableau)
        code = jnp.where(solved, int(Result.TOLERANCE_NOT_MET), code)
    search = course.search
    if search is not None and ahead is not None:
        search, verdict = with_impacts(search, ahead, verdict, course, tableau.max_events, solved & ~over)
    complete = verdict.accepted & (verdict.done > 1.0 - (1e-9 if search is None else COMPLETE))
    stopped, result = _ended(setting, course, verdict, code)
    done, fraction, trial, left = _next_part(course, verdict, complete, left)
    kept, size = verdict.change > 0, it.y.shape[0]
    past, lagging = _followed(course, it, inertias, kick, trial, solved, kept, fraction), course.lagging
    guess, worked = past.guess, jnp.where(over, 0, it.total)
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
