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

from natcoord_jax.control import sequential
from natcoord_jax.control.guess import Guess, goal_scale, input_ranges, scattered, stretched, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.reasons import nearest, worst_condition
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
    Outcome.DIVERGED,
)  # fmt: skip
"""Outcomes after which another way is tried, if the choice was ours."""
NOWHERE = (Outcome.SIMULATION_FAILED, Outcome.NONFINITE, Outcome.SINGULAR)
"""Outcomes that leave no motion to go on from."""
RESTORATION = "feasibility restoration, by motions that may miss the goal"
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
WIDER = (1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
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
        last: bool = False,
        problem: OptimalControl | None = None,
    ) -> Solution:
        """One attempt: the method's loop in Python, a line for each iteration, and a way out.

        Args:
            lifted: the form of the method.
            unknowns: where it starts.
            scale: of a soft goal, see `sequential.init`.
            last: whether no other attempt follows, so that it may take all iterations that are left.
            problem: another one of the same structure.
        """
        problem = self.problem if problem is None else problem
        before, begun = len(self.history), time.perf_counter()
        method = RESTORATION if scale is not None else f"{NAMES[lifted]} {METHOD}"
        count = self.left if last else min(self.left, max(MANY, math.ceil(PART * self.left)))
        o = self.options
        options = Options(lifted, count, o.tol, o.goal_tol)
        iterate = sequential.init(problem, options, unknowns, scale)
        outcome = Outcome.RUNNING
        if self.progress:
            print(f"{method}\n{HEADER}", file=sys.stderr)
        try:
            while not sequential.done(iterate):
                if self.watch.seconds > self.time_limit:
                    outcome = Outcome.TIME_LIMIT
                    break
                iterate = sequential.step(problem, options, iterate)
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
    failed: list[Solution] = []
    for k in range(STARTS):
        start = begin
        if k:
            spread = SPREAD * input_ranges(problem, begin)
            start = scattered(problem, stretched(problem, begin, LONGER**k), jax.random.key(k), spread, 0.0)
        restored = search.run(False, start, scale=scale)
        if restored.outcome in (Outcome.TIME_LIMIT, Outcome.STOPPED):
            return restored
        failed += [restored] if restored.outcome is Outcome.UNREACHABLE else []
        if restored.outcome in NOWHERE:
            begin = eqx.tree_at(lambda u: u.coefficients, begin, jnp.zeros_like(begin.coefficients))
        elif search.left > 0 and restored.iterate is not None:
            found = search.run(True, restored.iterate.unknowns, last=k == STARTS - 1)
            if over(found):
                return found
        if search.left <= 0:
            break
    if len(failed) == STARTS:
        found = _unreachable(search, failed, scale)
    others = [a for k, a in enumerate(search.attempts) if k != len(found.attempts)]
    return dataclasses.replace(found, history=search.history, attempts=others)


def _unreachable(search: Search, failed: list[Solution], scale: Any) -> Solution:
    """The nearest of motions that all miss the goal, and the limits of inputs that would lead to it."""
    problem = search.problem
    iterates = [one.iterate for one in failed if one.iterate is not None]
    misses = [float(jnp.sum((i.path.end.missing / scale) ** 2)) for i in iterates]
    best = int(np.argmin(misses))
    nearest_one, begin = failed[best], iterates[best].unknowns
    reason, attempts, rows = nearest_one.reason, len(search.attempts), len(search.history)
    if problem.bounds.widened(WIDER[0]) is not problem.bounds:
        for factor in WIDER:
            wider = eqx.tree_at(lambda p: p.bounds, problem, problem.bounds.widened(factor))
            # (What pushes at its limits would as well at wider ones.)
            start = eqx.tree_at(lambda u: u.coefficients, begin, factor * begin.coefficients)
            restored = search.run(False, start, scale=scale, problem=wider)
            if restored.ok:
                reason += f"; with {factor:g} times the limits of the inputs it comes near"
            if restored.outcome is not Outcome.UNREACHABLE or search.left <= 0:
                break
    del search.attempts[attempts:], search.history[rows:]
    return dataclasses.replace(nearest_one, reason=reason)
