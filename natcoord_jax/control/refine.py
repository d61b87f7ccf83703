"""Mesh refinement: steps as short as the local error asks for, where it asks for it."""

import dataclasses
import sys
import time
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from natcoord_jax.control.attempts import ENDED, NAMES, Search
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.equidistribution import (
    asked_for,
    check_intervals,
    divided,
    longest_of,
    more_of,
    present,
    wished,
    with_own_lengths,
    worth_moving,
)
from natcoord_jax.control.guess import unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.local_error import local_errors
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.resampling import at_middles, ends_of
from natcoord_jax.control.run import FORMS, optimise
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import FLAG, Choice, Concrete, of
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.xla.waiting import Stopwatch

HEADER = (
    f"{'steps':>6} {'error':>9} {'cost':>16} {'shortest [s]':>12} {'iter':>5} {'s':>7} {'compiling [s]':>13}"
)

SCARCELY = 0.8
"""Error after moving steps, in terms of that before, from which on more of them are taken."""


class Round(NamedTuple):
    """One mesh and its solution.

    Attributes:
        steps: their number.
        error: largest local error of a step, estimated, relative.
        cost: whole cost.
        shortest: shortest step [s].
        iterations: of the method.
        seconds: for solving and estimating, without compiling [s].
        compile_seconds: for compiling [s]; none where steps have only been moved.
    """

    steps: int
    error: float
    cost: float
    shortest: float
    iterations: int
    seconds: float
    compile_seconds: float

    def __str__(self) -> str:
        """A line of the table."""
        return (
            f"{self.steps:>6} {self.error:>9.1e} {self.cost:>16.9g} {self.shortest:>12.3g} "
            f"{self.iterations:>5} {self.seconds:>7.2f} {self.compile_seconds:>13.1f}"
        )


class Refinement(NamedTuple):
    """What mesh refinement has found.

    Attributes:
        solution: on the last mesh that was solved.
        errors: estimated local error of each of its steps, relative (steps,).
        rounds: all meshes, the first is that of the problem.
        reason: why errors are not below the tolerance; empty where they are.
    """

    solution: Solution
    errors: Float[np.ndarray, " steps"]
    rounds: list[Round]
    reason: str

    @property
    def ok(self) -> bool:
        """Whether the last mesh is solved, with errors below the tolerance."""
        return not self.reason

    def __str__(self) -> str:
        """A table of the rounds, and why they ended where they should not have."""
        return "\n".join([HEADER, *map(str, self.rounds), *([self.reason] if self.reason else [])])


@checked()
def refine(
    problem: Annotated[Any, Concrete(PROBLEM) | of("an earlier solution", Solution)],
    tolerance: Annotated[float, Concrete(Number("positive"))] = 1e-5,
    *,
    max_rounds: Annotated[int, Whole(0)] = 20,
    max_steps: Annotated[int | None, Whole(1)] = None,
    method: Annotated[str, Choice(FORMS)] = "auto",
    progress: Annotated[bool, FLAG] = True,
    max_iterations: Annotated[int, Whole(1)] = 500,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-8,
    goal_tol: Annotated[float, Concrete(Number("positive"))] = 1e-10,
    time_limit: Annotated[float, Concrete(Number("not negative", infinite=True))] = 600.0,
) -> Refinement:
    """Solve an optimal control problem on meshes that follow its local error (mesh refinement).

    After each solution every step is made again in two halves, with the inputs that the history of all inputs
    asks for in them, and the difference tells its error: relative to the largest extent of scene and motion
    and to the largest speed. Steps are divided where it is large and merged where it is small, to at most
    twice the longest of the problem; ends of phases and waypoints (`nc.goal.At`) stay where they are in time.
    Where no more steps are needed than there are they are only moved, which compiles nothing; each other
    number of steps compiles its programs. Each solve starts from the last one, primal and dual.

    The error of a smooth motion falls with the cube of its step, that of a step within which an input
    switches with the square, and steps gather there: they bracket the switch. Of inputs that are held over
    several steps, or are splines over them (`every`), the intervals are moved, and the motion's error alone
    counts.

    Args:
        problem: a problem, or an earlier solution of one, which is then the first.
        tolerance: largest local error of a step, relative.
        max_rounds: limit of meshes after the first.
        max_steps: limit of steps; None: ten times those of the problem.
        method: as in `optimise`, for the first problem.
        progress: print a line for each mesh to stderr.
        max_iterations: of each solve, as in `optimise`.
        tol: as in `optimise`.
        goal_tol: as in `optimise`.
        time_limit: of the whole [s]; compiling does not count.

    Returns:
        The last solution, its errors, and a row for each mesh; `print` shows them. Where a mesh is not
        solved, the last one that was, and why.

    Raises:
        ValueError: for phases or waypoints that are not at ends of intervals of the inputs.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> from natcoord_jax.gallery import manoeuvres
        >>> found = nc.refine(manoeuvres.two_masses(10), tolerance=1e-2, max_rounds=1, progress=False)
        >>> found.rounds[0].steps, found.solution.ok
        (10, True)
    """
    watch = Stopwatch()
    settings = {"max_iterations": max_iterations, "tol": tol, "goal_tol": goal_tol}
    rounds = _Rounds(tolerance, progress)
    if isinstance(problem, Solution):
        check_intervals(problem.problem)
        solution = problem
    else:
        check_intervals(problem)
        first = with_own_lengths(numeric(problem))
        solution = optimise(first, method=method, progress=False, time_limit=time_limit, **settings)
    if solution.iterate is None or not solution.ok:
        reason = f"the first mesh is not solved: {solution.explain()}"
        return Refinement(solution, np.full(solution.problem.steps, np.nan), [], reason)
    most = max_steps or 10 * solution.problem.steps
    longest = longest_of(solution.problem)
    rounds.noted(solution)
    while rounds.worst > tolerance:
        if len(rounds.rows) > max_rounds:
            return rounds.ended(f"after {max_rounds} rounds")
        again = None
        for finer in _finer(rounds, tolerance, longest, most):
            left = max(0.0, time_limit - watch.seconds)
            again = _again(finer, rounds.solution, left, settings)
            if again.ok or again.outcome in ENDED:
                break
        if again is None:
            return rounds.ended(f"with at most {most} steps")
        if not again.ok:
            return rounds.ended(f"with {again.problem.steps} steps it is not solved ({again.explain()});")
        rounds.noted(again)
    return rounds.ended("")


def _finer(rounds: "_Rounds", tolerance: float, longest: list[float], most: int) -> Iterator[OptimalControl]:
    """Problems on meshes that may do: the same steps moved, then more of them."""
    problem = rounds.solution.problem
    wishes = wished(problem, rounds.errors, tolerance, longest)
    now, asked = present(problem), asked_for(problem, wishes)
    more = more_of(now, asked, most // problem.inputs.every)
    full = more.sum() <= now.sum()
    errors = rounds.errors
    if not rounds.stuck and (full or worth_moving(now, asked, rounds.worst, tolerance, errors.order)):
        yield divided(problem, wishes, now)
    if not full:
        yield divided(problem, wishes, more)


class _Rounds:
    """What the rounds have found so far."""

    def __init__(self, tolerance: float, progress: bool) -> None:
        self.tolerance, self.progress = tolerance, progress
        self.begun, self.watch = time.perf_counter(), Stopwatch()
        self.rows: list[Round] = []
        self.solution: Any = None
        self.errors: Any = None

    @property
    def worst(self) -> float:
        """Largest error of the last mesh."""
        return float(np.max(self.errors.steps))

    @property
    def stuck(self) -> bool:
        """Whether moving the steps has not helped."""
        last = self.rows[-2:]
        moved = len(last) == 2 and last[0].steps == last[1].steps
        return moved and last[1].error > SCARCELY * last[0].error

    def noted(self, solution: Solution) -> None:
        """Estimate the errors of a solution and keep it."""
        problem, iterate = solution.problem, _iterate(solution)
        self.solution, self.errors = solution, local_errors(problem, iterate)
        shortest = float(jnp.min(problem.lengths(iterate.unknowns.free)))
        seconds, whole = self.watch.seconds, time.perf_counter() - self.begun
        row = Round(
            problem.steps,
            self.worst,
            solution.cost,
            shortest,
            len(solution.history),
            seconds,
            whole - seconds,
        )
        if self.progress:
            print(row if self.rows else f"{HEADER}\n{row}", file=sys.stderr, flush=True)
        self.rows.append(row)
        self.begun, self.watch = time.perf_counter(), Stopwatch()

    def ended(self, why: str) -> Refinement:
        """All of it."""
        error = f"{why} the largest local error is {self.worst:.1e}, above {self.tolerance:.1e}"
        return Refinement(self.solution, self.errors.steps, self.rows, error if why else "")


def _iterate(solution: Solution) -> Iterate:
    """Where the method ended, of a solution that is optimal."""
    assert solution.iterate is not None
    return solution.iterate


def _again(problem: OptimalControl, last: Solution, time_limit: float, settings: dict[str, Any]) -> Solution:
    """The solution on another mesh: from the last one with its multipliers, else from its motion alone."""
    lifted = last.method.startswith(NAMES[True])
    guess = last.guess_for(problem)
    options = Options(lifted, *(settings[name] for name in ("max_iterations", "tol", "goal_tol")))
    search = Search(problem, options, False, time_limit)
    known = _carried(last.problem, problem, _iterate(last), lifted)
    found = search.run(lifted, unknowns_of(problem, guess, lifted), known=known, last=True)
    if found.ok or found.outcome in ENDED:
        return found
    left = max(0.0, time_limit - search.watch.seconds)
    return optimise(problem, guess, method=NAMES[lifted], progress=False, time_limit=left, **settings)


def _carried(old: OptimalControl, new: OptimalControl, iterate: Iterate, lifted: bool) -> Multipliers:
    """Multipliers on another mesh."""
    m, ends = iterate.multipliers, (ends_of(old), ends_of(new))
    size = np.diff(ends[0])[:, None], np.diff(ends[1])[:, None]
    # Of a bound they are worth a time.
    path = at_middles(np.asarray(m.path) / size[0], *ends) * size[1]
    motion = at_middles(np.asarray(m.motion), *ends) if lifted and m.motion is not None else None
    return dataclasses.replace(m, path=jnp.asarray(path), motion=motion)
