"""The attempts of an optimisation: from the guess, then after feasibility restorations."""

import dataclasses
import math
import sys
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.control import ipopt, sequential
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.guess import Guess, goal_scale, input_ranges, scattered, stretched, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.nlp import program_with_states
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.reach import unreached
from natcoord_jax.control.reasons import nearest, needed, worst_condition
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.solution import Attempt, Row, Solution, solution_of
from natcoord_jax.control.transcription import Unknowns
from natcoord_jax.xla.waiting import Stopwatch

HEADER = (
    f"{'iter':>4} {'cost':>14} {'gradient':>9} {'violation':>9} {'step':>7} {'newton':>7} {'s':>7}  worst"
)
NAMES = {True: "lifted", False: "shooting"}
METHOD = "sequential quadratic programming"
LOST = (
    Outcome.SIMULATION_FAILED, Outcome.STALLED, Outcome.MAX_ITERATIONS, Outcome.NONFINITE, Outcome.SINGULAR,
    Outcome.DIVERGED, Outcome.UNREACHABLE,
)  # fmt: skip
"""Outcomes after which another way is tried, if the choice was ours."""
NOWHERE = (Outcome.SIMULATION_FAILED, Outcome.NONFINITE, Outcome.SINGULAR)
"""Outcomes that leave no motion to go on from."""
IPOPT = "IPOPT"
"""Name of the second method."""
IPOPT_ENDS = {
    "Maximum Iterations Exceeded": Outcome.MAX_ITERATIONS,
    "Maximum WallTime Exceeded": Outcome.TIME_LIMIT,
}
RESTORATION = "feasibility restoration, by motions that may miss the goal"
ENDED = (Outcome.TIME_LIMIT, Outcome.STOPPED)
"""Outcomes after which nothing is tried any more."""
STARTS = 4
"""Starts of feasibility restorations: the guess, and random ones about it."""
SPREAD = 0.25
"""Standard deviation of random inputs, relative to half their range or to the largest of the guess."""
LONGER = 1.5
"""Factor on a free final time from one of these places to the next."""
PART = 0.4
"""Part of the iterations left that an attempt may take where others can follow."""
MANY = 100
"""Iterations that it may take at least."""
CERTAIN = 0.05
"""Part of what is missing that inputs have to leave, to first order, where a goal counts as out of reach."""
WIDER = (1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0)
"""Factors on the limits of the inputs that are tried where none was restored within them."""


def row_of(problem: OptimalControl, iterate: Iterate, start: float) -> Row:
    """A line of the history; `start` is when it began [s]."""
    violation, worst = worst_condition(problem, iterate)
    return Row(
        int(iterate.iteration),
        float(iterate.path.cost),
        float(iterate.errors.stationarity),
        violation,
        worst,
        float(iterate.step),
        int(iterate.newton),
        time.perf_counter() - start,
    )


def printed(row: Row) -> str:
    """One line of the progress table."""
    return (
        f"{row.iteration:>4} {row.cost:>14.8g} {row.stationarity:>9.1e} {row.violation:>9.1e} "
        f"{row.step:>7.2g} {row.newton:>7} {row.seconds:>7.2f}  {row.worst}"
    )


class Search:
    """The attempts of one optimisation: they share limits, the history, and the lines that are printed."""

    def __init__(self, problem: OptimalControl, options: Options, progress: bool, time_limit: float) -> None:
        self.problem, self.options, self.progress = problem, options, progress
        self.start, self.watch, self.time_limit = time.perf_counter(), Stopwatch(), time_limit
        self.history: list[Row] = []
        self.attempts: list[Attempt] = []

    @property
    def left(self) -> int:
        """Iterations left."""
        return self.options.max_iterations - len(self.history)

    def run(
        self,
        lifted: bool,
        unknowns: Unknowns,
        *,
        scale: Any = None,
        known: Multipliers | None = None,
        last: bool = False,
        problem: OptimalControl | None = None,
    ) -> Solution:
        """One attempt: the method's loop in Python, a line for each iteration, and a way out.

        Args:
            lifted: the form of the method.
            unknowns: where it starts.
            scale: of a soft goal, see `sequential.init`.
            known: multipliers to begin with.
            last: whether no other attempt follows, so that it may take all iterations that are left.
            problem: another one of the same structure.
        """
        problem = self.problem if problem is None else problem
        before, begun = len(self.history), time.perf_counter()
        method = RESTORATION if scale is not None else f"{NAMES[lifted]} {METHOD}"
        count = self.left if last else min(self.left, max(MANY, math.ceil(PART * self.left)))
        o = self.options
        options = Options(lifted, count, o.tol, o.goal_tol)
        iterate = sequential.init(problem, options, unknowns, scale, known)
        outcome = Outcome.RUNNING
        if self.progress:
            print(f"{method}\n{HEADER}", file=sys.stderr)
        try:
            while not sequential.done(iterate):
                if self.watch.seconds > self.time_limit:
                    outcome = Outcome.TIME_LIMIT
                    break
                iterate = sequential.step(problem, options, iterate)
                if iterate.iteration < 1:
                    continue
                row = row_of(problem, iterate, self.start)
                self.history.append(row._replace(iteration=len(self.history) + 1))
                if self.progress:
                    print(printed(self.history[-1]), file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            outcome = Outcome.STOPPED
        if outcome is Outcome.RUNNING:
            outcome = Outcome(int(iterate.code))
        taken, seconds = len(self.history) - before, time.perf_counter() - begun
        found = solution_of(problem, iterate, method, list(self.history), outcome)
        soft = scale is not None and outcome is Outcome.UNREACHABLE
        reason = nearest(problem, iterate) if soft else found.reason
        found = dataclasses.replace(found, reason=reason, attempts=list(self.attempts))
        self.attempts.append(Attempt(method, outcome, taken, seconds, reason))
        return found

    def by_ipopt(self, unknowns: Unknowns) -> Solution:
        """IPOPT on the whole program, then the lifted method from where it ends, to its own tolerances.

        Args:
            unknowns: where it starts.
        """
        problem, begun, before = self.problem, time.perf_counter(), len(self.history)
        program = program_with_states(problem, unknowns)
        left = max(0.0, self.time_limit - self.watch.seconds)
        try:
            answer = ipopt.solved(program, self.left, max_wall_time=max(left, 1e-3))
        except KeyboardInterrupt:
            iterate = sequential.init(problem, Options(True), unknowns)
            return solution_of(problem, iterate, IPOPT, list(self.history), Outcome.STOPPED)
        for cost, slope, violation, length in answer.table[1:]:
            seconds = time.perf_counter() - self.start
            row = Row(len(self.history) + 1, cost, slope, violation, IPOPT, length, 0, seconds)
            self.history.append(row)
            if self.progress:
                print(printed(row), file=sys.stderr, flush=True)
        found = program.unknowns(answer.x)
        outcome = Outcome.OPTIMAL if answer.ok else IPOPT_ENDS.get(answer.status, Outcome.STALLED)
        count, seconds = len(self.history), time.perf_counter() - begun
        reason = "" if answer.ok else answer.status
        self.attempts.append(Attempt(IPOPT, outcome, count - before, seconds, reason))
        ended = self.run(True, found, known=program.multipliers(answer.multipliers))
        if len(self.history) > count or not ended.ok:
            return ended
        # It is a solution as it is.
        return dataclasses.replace(ended, method=f"{NAMES[True]}, by {IPOPT}", attempts=ended.attempts[:-1])


def over(found: Solution) -> bool:
    """Whether nothing follows: it is solved, the user or a limit stops it, or nothing can be done."""
    return found.outcome not in LOST


def after_restoration(search: Search, found: Solution, guess: Guess) -> Solution:
    """Attempts after one that has got lost.

    A motion of the equations that comes near to the goal is looked for first, by simulations that may miss
    it, from the guess and then from random inputs about it and longer times, where time is free; the lifted
    form goes on from there.
    """
    problem = search.problem
    begin = unknowns_of(problem, guess, False)
    scale = goal_scale(problem, unknowns_of(problem, None, True))
    if not scale.size:
        lifted = not found.method.startswith(NAMES[True])
        inputs = Guess(found.inputs, free=found.guess().free)
        return search.run(lifted, unknowns_of(problem, inputs, lifted), last=True)
    tried, missing = [found], list[Solution]()
    for k in range(STARTS):
        start = begin
        if k:
            spread = SPREAD * input_ranges(problem, begin)
            start = scattered(problem, stretched(problem, begin, LONGER**k), jax.random.key(k), spread, 0.0)
        restored = search.run(False, start, scale=scale)
        tried.append(restored)
        missing += [restored] if restored.outcome is Outcome.UNREACHABLE else []
        if restored.outcome in NOWHERE or restored.iterate is None:
            begin = eqx.tree_at(lambda u: u.coefficients, begin, jnp.zeros_like(begin.coefficients))
        elif restored.outcome not in ENDED and search.left > 0:
            tried.append(search.run(True, restored.iterate.unknowns, last=k == STARTS - 1))
        # What one method cannot reach and another one neither, needs no more starts.
        agreed = found.outcome is Outcome.UNREACHABLE and len(missing) > 0
        if over(tried[-1]) and tried[-1] is not restored or search.left <= 0 or agreed:
            break
        if tried[-1].outcome in ENDED:
            break
    found = _concluded(search, tried, missing, scale)
    others = [a for k, a in enumerate(search.attempts) if k != len(found.attempts)]
    return dataclasses.replace(found, history=search.history, attempts=others)


def _concluded(search: Search, tried: list[Solution], missing: list[Solution], scale: Any) -> Solution:
    """What is solved; else that the goal is out of reach, where that is certain; else the best of all."""
    problem, last = search.problem, tried[-1]
    solved = [one for one in tried if one.method != RESTORATION and one.ok]
    if solved:
        return solved[-1]
    agreed = tried[0].outcome is Outcome.UNREACHABLE and len(missing) > 0
    if agreed or len(missing) == STARTS:
        misses = [float(jnp.sum((i.path.end.missing / scale) ** 2)) for i in _iterates(missing)]
        best = int(np.argmin(misses))
        if unreached(problem, _iterates(missing)[best], scale) > CERTAIN:
            return (
                tried[0] if agreed else _unreachable(search, missing[best], _iterates(missing)[best], scale)
            )
    # Restorations that come near are no solutions, and nothing has shown the goal to be out of reach.
    ends = [one.outcome for one in tried if one.method != RESTORATION]
    outcome = last.outcome if last.outcome in ENDED else ends[-1]
    outcome = Outcome.STALLED if outcome is Outcome.UNREACHABLE else outcome
    return best_of(problem, tried, outcome)


def best_of(problem: OptimalControl, tried: list[Solution], outcome: Outcome) -> Solution:
    """What violates least of some attempts of which none has solved the problem, and how they ended."""
    known = [one for one in tried if one.iterate is not None] or tried[-1:]
    best = min(known, key=lambda one: _badness(problem, one))
    if best.method == RESTORATION and best.iterate is not None:
        best = dataclasses.replace(best, reason=nearest(problem, best.iterate))
    return dataclasses.replace(best, code=int(outcome))


def _iterates(found: list[Solution]) -> list[Iterate]:
    return [one.iterate for one in found if one.iterate is not None]


def _badness(problem: OptimalControl, found: Solution) -> tuple[float, float]:
    """Largest violation, then cost; what is no number is worst."""
    violation = math.inf if found.iterate is None else worst_condition(problem, found.iterate)[0]
    whole = not math.isnan(violation) and not math.isnan(found.cost)
    return (violation, found.cost) if whole else (math.inf, math.inf)


def _unreachable(search: Search, found: Solution, iterate: Iterate, scale: Any) -> Solution:
    """The nearest motion that misses the goal, and the limits of inputs that would lead to it."""
    problem, begin = search.problem, iterate.unknowns
    reason, attempts, rows = found.reason, len(search.attempts), len(search.history)
    if problem.bounds.widened(WIDER[0]) is not problem.bounds:
        for factor in WIDER:
            wider = eqx.tree_at(lambda p: p.bounds, problem, problem.bounds.widened(factor))
            # (What pushes at its limits would as well at wider ones.)
            start = eqx.tree_at(lambda u: u.coefficients, begin, factor * begin.coefficients)
            restored = search.run(False, start, scale=scale, problem=wider)
            if restored.ok:
                reason += f"; with {factor:g} times the limits of the inputs it comes near: "
                reason += needed(wider, problem)
            if restored.outcome is not Outcome.UNREACHABLE or search.left <= 0:
                break
    del search.attempts[attempts:], search.history[rows:]
    return dataclasses.replace(found, reason=reason)
