"""Several optima of one problem, and problems that change along a path."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.control import sequential
from natcoord_jax.control.attempts import METHOD, NAMES, row_of
from natcoord_jax.control.guess import GUESS, Guess, goal_scale, scattered, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.results import OUTCOMES, Outcome
from natcoord_jax.control.run import METHODS, chosen, optimise
from natcoord_jax.control.solution import Solution, solution_of
from natcoord_jax.control.transcription import Unknowns
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG, Choice, FunctionOf, Several, of
from natcoord_jax.core.numeric import Number, Vector, Whole

SAME = 1e-3
"""Difference of inputs, relative to the largest, below which two optima are taken for one."""
QUICK = 6
"""Iterations below which a step along a path was short."""


class Optima(list[Solution]):
    """The different optima of a problem by cost, or, if there are none, the nearest to one.

    `print` shows how many starts led to which, and why others led to none.

    Attributes:
        outcomes: of every start.
        costs: of every start.
    """

    def __init__(self, solutions: list[Solution], outcomes: list[Outcome], costs: list[float]) -> None:
        super().__init__(solutions)
        self.outcomes, self.costs = outcomes, costs

    def __str__(self) -> str:
        """The tally."""
        good = [cost for cost, outcome in zip(self.costs, self.outcomes) if outcome.ok]
        lines = [f"{len(good)} of {len(self.outcomes)} starts converged"]
        left = list(good)
        for cost in sorted({s.cost for s in self if s.ok}):
            near = [c for c in left if abs(c - cost) <= SAME * max(abs(cost), 1e-300)]
            left = [c for c in left if c not in near]
            if near:
                lines.append(f"  {len(near)} to cost {cost:.8g}")
        bad = Counter(outcome for outcome in self.outcomes if not outcome.ok)
        lines += [f"  {count} not: {OUTCOMES[outcome]}" for outcome, count in bad.most_common()]
        return "\n".join(lines)


@checked(
    problem=PROBLEM,
    guess=GUESS | of("an earlier solution", Solution) | Several(of("a guess or a solution", Guess, Solution)),
    starts=Whole(1),
    spread=Number("not negative") | Vector(None),
    rates=Number("not negative") | Vector(None),
    seed=Whole(0),
    method=Choice(METHODS),
    max_iterations=Whole(0),
    tol=Number("positive"),
    goal_tol=Number("positive"),
)
def multi_start(
    problem: OptimalControl,
    guess: Any = None,
    *,
    starts: int = 16,
    spread: Any = 1.0,
    rates: Any = 1.0,
    seed: int = 0,
    method: str = "auto",
    max_iterations: int = 100,
    tol: float = 1e-8,
    goal_tol: float = 1e-10,
) -> Optima:
    """Solve from many guesses at once, and list all optima that are found.

    With method "auto", starts that get lost go on as in `optimise`, from motions that come near to the goal.

    Args:
        problem: the problem.
        guess: in the middle of the guesses, or a sequence of guesses, which are then taken as they are.
        starts: number of random guesses; the one in the middle is the first.
        spread: standard deviation of the inputs of the guesses [N, N m], a number or one for each channel.
        rates: standard deviation of the rates of the guesses [rad/s, m/s], for the lifted method.
        seed: of the random numbers.
        method: as in `optimise`.
        max_iterations: as in `optimise`.
        tol: as in `optimise`.
        goal_tol: as in `optimise`.

    Returns:
        The different optima by cost, or, if there are none, the one that came nearest; a list, and a tally of
        all starts, which `print` shows.
    """
    problem = numeric(problem)
    lifted = chosen(problem, method)
    options = Options(lifted, max_iterations, tol, goal_tol)
    if isinstance(guess, Sequence) and guess and isinstance(guess[0], Guess | Solution):
        plain = [g.guess(problem.steps) if isinstance(g, Solution) else g for g in guess]
        every = [unknowns_of(problem, g, lifted) for g in plain]
        many = jax.tree.map(lambda *x: jnp.stack(x), *every)
    else:
        middle = unknowns_of(problem, guess, lifted)
        keys = jax.random.split(jax.random.key(seed), starts)
        sizes = jnp.ones(starts).at[0].set(0.0)
        many = jax.vmap(lambda key, size: scattered(problem, middle, key, size * spread, size * rates))(
            keys, sizes
        )
    first = _all_solved(problem, many, options, None)
    ends = [_End(lifted, first, k) for k in range(len(first.code))]
    lost = [end for end in ends if not end.outcome.ok]
    if method == "auto" and lost and first.path.end.missing.size:
        # The program is made for as many starts as there are: the lost ones, and the first of them again.
        which = np.array([lost[k].index if k < len(lost) else lost[0].index for k in range(len(ends))])
        again = jax.tree.map(itemgetter(which), many)
        again = Unknowns(again.coefficients, again.free, jnp.zeros_like(again.y))
        scale = goal_scale(problem, unknowns_of(problem, None, True))
        ways = _all_solved(problem, again, Options(False, max_iterations, tol, goal_tol), scale)
        second = _all_solved(problem, ways.unknowns, Options(True, max_iterations, tol, goal_tol), None)
        for k, end in enumerate(lost):
            ends[end.index] = _End(True, second, k)
    return _distinct(problem, ends)


class _End:
    """How one of a batch of starts ended."""

    def __init__(self, lifted: bool, batch: Iterate, index: int) -> None:
        self.lifted, self.batch, self.index = lifted, batch, index
        self.outcome, self.cost = Outcome(int(batch.code[index])), float(batch.path.cost[index])
        self.missing = float(batch.errors.goal[index])

    @property
    def solved_for(self) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients and what is free."""
        unknowns = self.batch.unknowns
        return np.asarray(unknowns.coefficients[self.index]), np.asarray(unknowns.free[self.index])

    def solution(self, problem: OptimalControl, start: int) -> Solution:
        """What the user sees of it."""
        iterate = jax.tree.map(itemgetter(self.index), self.batch)
        name = f"{NAMES[self.lifted]} {METHOD}, start {start}"
        return solution_of(
            problem, iterate, name, [row_of(problem, iterate, time.perf_counter())], self.outcome
        )


@compiled
def _all_solved(problem: OptimalControl, many: Unknowns, options: Options, scale: Any) -> Iterate:
    """The method from many guesses at once; one program for all calls of the same structure."""

    def one(unknowns: Unknowns) -> Iterate:
        first = sequential.init(problem, options, unknowns, scale)
        return jax.lax.while_loop(
            lambda iterate: iterate.running,
            lambda iterate: sequential.step(problem, options, iterate),
            first,
        )

    return jax.vmap(one)(many)


def _distinct(problem: OptimalControl, ends: list[_End]) -> Optima:
    """Different optima of all starts, by cost.

    Two are the same if what is solved for is: mirror images cost the same and are two.
    """

    def same(a: _End, b: _End) -> bool:
        pairs = zip(a.solved_for, b.solved_for)
        return all(np.all(np.abs(x - y) <= SAME * np.max(np.abs(y), initial=0.0)) for x, y in pairs)

    kept: list[int] = []
    for k in sorted((k for k, end in enumerate(ends) if end.outcome.ok), key=lambda k: ends[k].cost):
        if not any(same(ends[k], ends[n]) for n in kept):
            kept.append(k)
    nearest = int(np.argmin([np.nan_to_num(end.missing, nan=np.inf) for end in ends]))
    solutions = [ends[k].solution(problem, k) for k in kept or [nearest]]
    return Optima(solutions, [end.outcome for end in ends], [end.cost for end in ends])


class Continuation(list[Solution]):
    """Solutions along a path of problems, the last one as far as it was got.

    Attributes:
        at: where along the path they are, from 0 to 1.
        reason: why it did not get to the end; empty where it did.
    """

    def __init__(self) -> None:
        super().__init__()
        self.at: list[float] = []
        self.reason = ""

    @property
    def ok(self) -> bool:
        """Whether the end of the path was reached."""
        return bool(self.at) and self.at[-1] == 1.0

    def __str__(self) -> str:
        """Costs along the path, and where it ended."""
        lines = [f"{s:8.4f}  cost {found.cost:.8g}" for s, found in zip(self.at, self)]
        return "\n".join(lines + ([self.reason] if self.reason else []))


@checked(
    problem=PROBLEM,
    path=FunctionOf("(problem, s) -> problem"),
    guess=GUESS | of("an earlier solution", Solution),
    first=Number("positive"),
    least=Number("positive"),
    method=Choice(METHODS),
    progress=FLAG,
    max_iterations=Whole(1),
    tol=Number("positive"),
    goal_tol=Number("positive"),
    time_limit=Number("not negative", infinite=True),
)
def continuation(
    problem: OptimalControl,
    path: Callable[[OptimalControl, float], OptimalControl],
    guess: Any = None,
    *,
    first: float = 0.25,
    least: float = 1e-3,
    method: str = "auto",
    progress: bool = True,
    max_iterations: int = 60,
    tol: float = 1e-8,
    goal_tol: float = 1e-10,
    time_limit: float = 600.0,
) -> Continuation:
    """Follow a solution while a goal, a bound or any other number of its problem moves.

    The problem at s = 0 is solved as by `optimise`; every other one starts from the solution before it,
    carried on in the direction of the last step. Steps that fail are halved, quick ones doubled.

    Args:
        problem: where it begins.
        path: (problem, s) to the problem at s, which goes from 0 to 1; of the same structure, so that nothing
            is compiled anew.
        guess: for the first problem, as in `optimise`.
        first: length of the first step.
        least: length below which it is given up.
        method: as in `optimise`; for the first problem.
        progress: print a line for each solution to stderr.
        max_iterations: of each solution but the first.
        tol: as in `optimise`.
        goal_tol: as in `optimise`.
        time_limit: of the whole [s].

    Returns:
        The solutions, a list, with `at` and `ok`; `print` shows the costs.

    Raises:
        ValueError: if the path leads to no problem.

    Example:
        >>> import dataclasses, jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> from natcoord_jax.gallery import manoeuvres
        >>> problem = manoeuvres.two_masses(10)
        >>> def slower(problem, s):
        ...     return dataclasses.replace(problem, dt=problem.dt * (1.0 + s))
        >>> found = nc.continuation(problem, slower, progress=False)
        >>> found.ok, found[-1].cost < found[0].cost
        (True, True)
    """
    begun, found = time.perf_counter(), Continuation()
    shared = {"progress": False, "tol": tol, "goal_tol": goal_tol}
    last = optimise(_at(path, problem, 0.0), guess, method=method, time_limit=time_limit, **shared)
    length, s = min(first, 1.0), 0.0
    while True:
        if last.ok:
            found.append(last)
            found.at.append(s)
            if progress:
                print(f"{s:8.4f}  cost {last.cost:.8g}, {len(last.history)} iterations", file=sys.stderr)
            length = 2.0 * length if len(found) > 1 and len(last.history) <= QUICK else length
        elif not found:
            found.append(last)
            found.reason = f"the first problem is not solved: {last.explain()}"
            return found
        elif last.outcome in (Outcome.STOPPED, Outcome.TIME_LIMIT):
            found.reason = f"at {found.at[-1]:.4f}: {last.explain()}"
            return found
        else:
            length *= 0.5
        if found.ok:
            return found
        if length < least or time.perf_counter() - begun > time_limit:
            limit = f"steps of {length:.1e}" if length < least else f"{time_limit:g} s"
            found.reason = f"at {found.at[-1]:.4f} it was given up, after {limit}: {last.explain()}"
            return found
        s = min(found.at[-1] + length, 1.0)
        form = next(name for name in NAMES.values() if found[-1].method.startswith(name))
        start = _carried_on(found, s)
        left = max(0.0, time_limit - (time.perf_counter() - begun))
        last = optimise(
            _at(path, problem, s),
            start,
            method=form,
            max_iterations=max_iterations,
            time_limit=left,
            **shared,
        )


def _at(path: Callable, problem: OptimalControl, s: float) -> OptimalControl:
    found = path(problem, s)
    if not isinstance(found, OptimalControl):
        raise ValueError(f"the path returned {type(found).__name__} at s = {s}; return a problem")
    return found


def _carried_on(found: Continuation, s: float) -> Guess:
    """A guess at s, on the straight line through the last two solutions."""
    last = found[-1].guess()
    if len(found) < 2:
        return last
    before, part = found[-2].guess(), (s - found.at[-1]) / (found.at[-1] - found.at[-2])

    def line(a: Any, b: Any) -> Any:
        return None if a is None or b is None else np.asarray(b) + part * (np.asarray(b) - np.asarray(a))

    rates = line(before.rates, last.rates)
    return Guess(line(before.inputs, last.inputs), rates=rates, free=line(before.free, last.free))
