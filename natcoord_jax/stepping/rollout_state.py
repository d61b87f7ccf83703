"""Where a rollout stands, what an attempt at a (sub)step makes of it, and guesses of the next solution."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.frozen_kick import FEWEST, FrozenKick, Lagging, in_body_axes
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.mechanics.tangent_space import Velocity
from natcoord_jax.mechanics.violations import is_open
from natcoord_jax.stepping.checked import check_contacts
from natcoord_jax.stepping.error_control import Tolerance, Trial
from natcoord_jax.stepping.factors import Factors, no_factors
from natcoord_jax.stepping.located import ImpactSearch
from natcoord_jax.stepping.newton import Iterate, any_lane, begin
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.system import System
from natcoord_jax.xla.rows import part

ORDER = 7
"""Largest order of the polynomials that guess the next solution. Orders above three save up to two of six
corrections a step where motion is smooth; elsewhere a lower one is chosen."""


class Predictor(eqx.Module):
    """Solutions of the last steps, as backward differences, from which the next is guessed.

    The sum of the differences up to an order extrapolates by a polynomial of that order; what it misses is
    the next difference.

    Attributes:
        differences: of order 0 (the last solution), 1, ...
        known: how many of them there are.
        order: of the polynomial that would have guessed the last solution best.
    """

    differences: tuple[Float[Array, " unknowns"], ...]
    known: Int[Array, ""]
    order: Int[Array, ""]

    @classmethod
    def of(cls, y: Float[Array, " unknowns"]) -> "Predictor":
        """One solution."""
        rest = (jnp.zeros_like(y),) * ORDER
        return cls((y, *rest), jnp.array(1), jnp.array(0))

    @property
    def guess(self) -> Float[Array, " unknowns"]:
        """Extrapolated by the polynomial that was best last time."""
        terms = [jnp.where(k <= self.order, d, 0.0) for k, d in enumerate(self.differences)]
        return sum(terms[1:], terms[0])

    def followed_by(self, y: Float[Array, " unknowns"], inertias: Float[Array, " unknowns"]) -> "Predictor":
        """The past after a step with the solution `y`."""
        found = [y]
        for difference in self.differences:
            found.append(found[-1] - difference)
        errors = jnp.stack([jnp.sum(inertias * d**2) for d in found[1:]])
        errors = jnp.where(jnp.arange(ORDER + 1) < self.known, errors, jnp.inf)
        return Predictor(tuple(found[:-1]), jnp.minimum(self.known + 1, ORDER + 1), jnp.argmin(errors))


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
        return replace_fields(self, parameters=some, first=first)

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
    code = jnp.where(bad, int(Result.BAD_STEP), int(Result.SUCCESSFUL))
    lagging = None
    structure = setting.system.structure
    if structure.multipliers:
        # (In trees, positions follow from coordinates, which may be any.)
        open_ = is_open(setting.system, state)
        bad, code = bad | open_, jnp.where(open_, int(Result.BAD_START), code)
    if plan.tableau.kick and structure.unknowns + structure.multipliers >= FEWEST:
        lagging = Lagging.begin(Velocity(jnp.zeros_like(state.rows), jnp.zeros_like(state.rates)))
    course = RolloutState(
        state=state,
        it=it,
        past=Predictor.of(
            it.y if lagging is None else jnp.concatenate([it.y, in_body_axes(state, lagging.held)])
        ),
        step=zero,
        done=nought,
        fraction=nought + 1.0,
        code=code,
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
