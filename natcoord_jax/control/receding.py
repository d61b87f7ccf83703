"""Receding horizons: a problem solved again and again from where a plant is, each time from the last plan.

A plan is shifted by a period with all that belongs to it: inputs, unknowns of the steps, and multipliers of
motion, goal and bounds. From there the second-order method goes on, primal and dual, as in the real-time
iteration of M. Diehl, H. G. Bock and J. P. Schloeder, SIAM J. Control Optim. 43 (2005) 1714-1736.
"""

import time
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.control import sequential
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.guess import GUESS
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.motion import joined
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.run import optimise
from natcoord_jax.control.solution import Solution
from natcoord_jax.control.transcription import Unknowns, held_inputs
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import Choice, Concrete, FunctionOf, of
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System
from natcoord_jax.xla.waiting import Stopwatch

HORIZONS = ("moving", "shrinking")
PAST = 1e-9
"""Length of steps that a shrinking horizon has no more, relative to the others: their number is structure,
and would compile anew."""
MOVED = ("t", "q", "v", "coordinates", "rates")
"""What the model sees of the plant."""
LAST = 1.5
"""Periods left of a plan with free time that is followed to its end."""
DISTURBANCE = FunctionOf("of the number of the update and the state of the plant to its state", 2)


class Horizons(NamedTuple):
    """A closed loop of receding horizons.

    Attributes:
        trajectory: motion of the plant, all its steps, with the inputs of each.
        codes: outcome of each update, see `Outcome`; where it is not zero the last plan went on.
        iterations: of each; the first is that of the plan at the start.
        seconds: wall time of each, without compiling [s].
        compile_seconds: time for compiling, of all together [s].
        costs: of each plan over its horizon, as predicted.
        missing: largest residual of the goal at the end of each, as predicted.
        times: when each begins [s].
        ends: when its horizon ends [s].
    """

    trajectory: Trajectory
    codes: Int[np.ndarray, " updates"]
    iterations: Int[np.ndarray, " updates"]
    seconds: Float[np.ndarray, " updates"]
    compile_seconds: float
    costs: Float[np.ndarray, " updates"]
    missing: Float[np.ndarray, " updates"]
    times: Float[np.ndarray, " updates"]
    ends: Float[np.ndarray, " updates"]


class Plan(eqx.Module):
    """What one update hands to the next."""

    unknowns: Unknowns
    multipliers: Multipliers
    penalty: Array


@checked()
def receding_horizon(
    problem: Annotated[OptimalControl, Concrete(PROBLEM)],
    plant: Annotated[System, SYSTEM],
    *,
    updates: Annotated[int, Whole(1)],
    steps_each: Annotated[int, Whole(1)] = 1,
    horizon: Annotated[str, Choice(HORIZONS)] = "moving",
    iterations: Annotated[int | None, Whole(1)] = None,
    disturbance: Annotated[Callable[[int, State], State] | None, DISTURBANCE] = None,
    plant_steps: Annotated[int, Whole(1)] = 1,
    guess: Annotated[Any, GUESS | of("an earlier solution", Solution)] = None,
    max_iterations: Annotated[int, Whole(1)] = 50,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-6,
    goal_tol: Annotated[float, Concrete(Number("positive"))] = 1e-8,
) -> Horizons:
    """Model predictive control: plan, follow the plan for a period, and plan again from where the plant is.

    The first plan is that of `optimise`. Each later one starts from the last, shifted by a period with its
    multipliers, and all are found by one compiled program in the lifted form. Where an update fails, the last
    plan goes on, and its code tells; nothing is raised.

    Args:
        problem: the problem at the start, with equal steps and inputs held over each.
        plant: the system that really moves: of the same bodies, joints and inputs, with other numbers or
            more loads.
        updates: number of plans.
        steps_each: steps of the problem between two of them.
        horizon: "moving": always as long as that of the problem; "shrinking": to the final time of the
            problem, or with free time to that of the last plan, with which the loop then ends, if not before.
        iterations: Newton iterations of each update, whether they converge or not (real-time iteration);
            code MAX_ITERATIONS then tells that they have not. None: until it has converged.
        disturbance: (k, state) -> state of the plant after the period of plan k, k = 0, 1, ...: pushes, or
            errors of measurement. Lasting ones are effects in the scene of the plant.
        plant_steps: steps of the plant for each step of the problem.
        guess: for the first plan, or the plan itself: an earlier solution of this problem.
        max_iterations: limit for each update.
        tol: largest gradient of the Lagrangian and complementarity, relative.
        goal_tol: largest violation of goal, bounds and equations.

    Returns:
        The motion of the plant, and of each update its outcome, time, iterations and prediction.

    Raises:
        ValueError: for a problem of several phases, with splines, a memory or a free start; for a plant of
            other bodies or inputs; for a moving horizon with free time.
    """
    _check(problem, plant, horizon, updates * steps_each)
    problem, watch, begun = numeric(problem), Stopwatch(), time.perf_counter()
    options = Options(True, max_iterations, tol, goal_tol)
    if isinstance(guess, Solution) and guess.iterate is not None:
        planned = guess
    else:
        planned = optimise(problem, guess, progress=False, tol=tol, goal_tol=goal_tol)
    if planned.iterate is None:
        raise ValueError(f"receding_horizon: there is no plan to begin with: {planned.explain()}")
    period, count = steps_each * float(problem.dt), steps_each * plant_steps
    loop = _Loop(problem, plant, _first(planned), horizon, options)
    loop.noted(planned.code, len(planned.history), watch.seconds, planned.iterate)
    for k in range(updates):
        # The rest of a plan that would be too short for another one.
        ends = problem.free_time and loop.left < LAST * period
        loop.follow(loop.left if ends else period, count)
        if disturbance is not None:
            loop.state = disturbance(k, loop.state)
        if ends or k + 1 == updates:
            break
        loop.update(period, steps_each, iterations or 0)
    return loop.found(time.perf_counter() - begun - watch.seconds)


def _check(problem: OptimalControl, plant: System, horizon: str, steps: int) -> None:
    """Refuse what does not recede."""
    if problem.inputs.degree or problem.inputs.every > 1 or not problem.uniform or problem.stages > 1:
        raise ValueError(
            "receding_horizon needs one phase of equal steps of order two and inputs held over each step"
        )
    if sum(problem.memory_sizes) or problem.looked_back:
        raise ValueError(
            "receding_horizon starts anew at every update: it takes no goals, costs or bounds that look at "
            "the way there (integrals, waypoints, turns, rates of inputs)"
        )
    if any(number.starts or number.moves_geometry for number in problem.free_numbers):
        raise ValueError("receding_horizon starts from where the plant is; leave out parameters of the start")
    if problem.free_time and horizon == "moving":
        raise ValueError("a horizon whose final time is free is what is left: pass horizon='shrinking'")
    if horizon == "shrinking" and not problem.free_time and steps > problem.steps:
        raise ValueError(
            f"updates * steps_each is {steps}, and the shrinking horizon has {problem.steps} steps; pass "
            "fewer"
        )
    model, other = problem.system.structure, plant.structure
    if (model.bodies, model.joints, len(model.inputs)) != (other.bodies, other.joints, len(other.inputs)):
        raise ValueError("the plant has other bodies, joints or inputs than the system of the problem")


def _first(planned: Solution) -> Plan:
    """The plan at the start; multipliers of the motion are what residuals are worth."""
    iterate: Any = planned.iterate
    m = iterate.multipliers
    motion = iterate.derivatives.worth.residuals if m.motion is None else m.motion
    return Plan(iterate.unknowns, Multipliers(m.goal, m.path, m.end, motion), iterate.penalty)


@compiled
def _updated(
    problem: OptimalControl, options: Options, plan: Plan, at: Array, weight: Array, most: Array
) -> tuple[Plan, Array, Iterate]:
    """The plan from where the plant is now, its inputs, and where the method ended.

    Args:
        problem: with the state of the plant, and the steps that are left.
        options: settings.
        plan: the last one.
        at: number of the step of the last plan that each step begins with.
        weight: of the bounds of each step, relative to those of that one.
        most: Newton iterations that count even if they have not converged; zero: none, and no limit.
    """
    last, m = plan.unknowns, plan.multipliers
    motion = None if m.motion is None else m.motion[at]
    unknowns = Unknowns(last.coefficients[at], last.free.at[: problem.times].set(0.0), last.y[at])
    known = Multipliers(m.goal, weight[:, None] * m.path[at], m.end, motion)
    first = sequential.init(problem, options, unknowns, None, known)
    # Multipliers are known: none are estimated, and the first step may be judged.
    first = eqx.tree_at(
        lambda i: (i.iteration, i.penalty), first, (jnp.ones_like(first.iteration), plan.penalty)
    )

    def goes_on(it: Iterate) -> Array:
        return it.running & ((most == 0) | (it.iteration <= most))

    it = jax.lax.while_loop(goes_on, lambda it: sequential.step(problem, options, it), first)
    code = jnp.where(it.running, int(Outcome.MAX_ITERATIONS), it.code)
    it = eqx.tree_at(lambda i: (i.iteration, i.code), it, (it.iteration - 1, code))
    fine = (code == int(Outcome.OPTIMAL)) | ((most > 0) & (code == int(Outcome.MAX_ITERATIONS)))
    kept, found = Plan(unknowns, known, plan.penalty), Plan(it.unknowns, it.multipliers, it.penalty)
    after = jax.tree.map(lambda x, x0: jnp.where(fine, x, x0), found, kept)
    return after, held_inputs(problem, after.unknowns.coefficients), it


class _Loop:
    """The closed loop: where the plant is, the plan that it follows, and what has been noted."""

    def __init__(self, problem: OptimalControl, plant: System, first: Plan, horizon: str, options: Options):
        self.problem, self.plant, self.plan, self.options = problem, plant, first, options
        self.shrinks = horizon == "shrinking" and not problem.free_time
        self.inputs = held_inputs(problem, first.unknowns.coefficients)
        # Loads of the plant have their own accounts of work.
        self.state = replace_fields(problem.state, work=jnp.zeros(len(plant.structure.works)))
        self.steps, self.dt = problem.steps, float(problem.applied(first.unknowns.free)[1])
        self.pieces: list[Trajectory] = []
        self.notes: list[tuple] = []

    def noted(self, code: Any, iterations: Any, seconds: float, iterate: Iterate) -> None:
        """Keep what there is to tell of an update."""
        end, begin = iterate.path.end.missing, float(self.state.t)
        numbers = int(code), int(iterations), seconds, float(iterate.path.cost)
        self.notes.append((*numbers, float(jnp.max(jnp.abs(end), initial=0.0)), begin, begin + self.left))

    @property
    def left(self) -> float:
        """Duration of the plan [s]."""
        return self.steps * self.dt

    def follow(self, period: float, count: int) -> None:
        """Let the plant follow the plan for a time, in so many steps."""
        at = (np.arange(count) + 0.5) * period / count / self.dt
        held = self.inputs[np.minimum(at.astype(int), self.steps - 1)]
        piece = simulate(self.plant, self.state, dt=period / count, inputs=held, throw=False)
        self.pieces.append(piece)
        self.state = jax.tree.map(lambda x: x[-1], piece.states)

    def update(self, period: float, steps_each: int, most: int) -> None:
        """Plan again, a period after the last plan began."""
        problem, count, weight = self.problem, self.problem.steps, np.ones(self.problem.steps)
        watch, dt = Stopwatch(), self.problem.dt
        if problem.free_time:
            gone = period / self.left
            at = np.minimum(
                ((gone + (np.arange(count) + 0.5) / count * (1 - gone)) * count).astype(int), count - 1
            )
            self.dt = (self.left - period) / count
            dt, weight = jnp.asarray(self.dt), (1 - gone) * weight
        else:
            at = np.minimum(np.arange(count) + steps_each, self.steps - 1)
        if self.shrinks:
            self.steps -= steps_each
            exists = np.arange(count) < self.steps
            dt = jnp.asarray(np.where(exists, self.dt, PAST * self.dt))
            weight = np.where(exists, 1.0, PAST)
        state = replace_fields(problem.state, **{name: getattr(self.state, name) for name in MOVED})
        now = eqx.tree_at(lambda p: (p.dt, p.state), problem, (dt, state))
        given = jnp.asarray(at), jnp.asarray(weight), jnp.asarray(most)
        self.plan, self.inputs, iterate = jax.block_until_ready(
            _updated(now, self.options, self.plan, *given)
        )
        seconds = watch.seconds
        if problem.free_time:
            self.dt = float(now.applied(self.plan.unknowns.free)[1])
        self.noted(iterate.code, iterate.iteration, seconds, iterate)

    def found(self, compiling: float) -> Horizons:
        """What there is to tell of all."""
        codes, iterations, *rest = (np.array(x) for x in zip(*self.notes))
        seconds, costs, missing, times, ends = rest
        return Horizons(
            joined(self.pieces), codes, iterations, seconds, compiling, costs, missing, times, ends
        )
