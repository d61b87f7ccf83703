"""Several optima of one problem, from many guesses at once."""

import time
from collections import Counter
from collections.abc import Sequence
from operator import itemgetter
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.control import sequential
from natcoord_jax.control.attempts import METHOD, NAMES, row_of
from natcoord_jax.control.guess import GUESS, Guess, goal_scale, scattered, scattered_rates, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.results import OUTCOMES, Outcome
from natcoord_jax.control.run import FORMS, chosen
from natcoord_jax.control.solution import Solution, solution_of
from natcoord_jax.control.transcription import Unknowns
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import Choice, Concrete, Several, of
from natcoord_jax.core.numeric import Number, Vector, Whole

SAME = 1e-3
"""Difference of inputs, relative to the largest, below which two optima are taken for one."""


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


@checked()
def multi_start(
    problem: Annotated[OptimalControl, Concrete(PROBLEM)],
    guess: Annotated[
        Any,
        GUESS | of("an earlier solution", Solution) | Several(of("a guess or a solution", Guess, Solution)),
    ] = None,
    *,
    starts: Annotated[int, Whole(1)] = 16,
    spread: Annotated[Any, Number("not negative") | Vector(None)] = 1.0,
    rates: Annotated[Any, Number("not negative") | Vector(None)] = 1.0,
    seed: Annotated[int, Whole(0)] = 0,
    method: Annotated[str, Choice(FORMS)] = "auto",
    max_iterations: Annotated[int, Whole(0)] = 100,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-8,
    goal_tol: Annotated[float, Concrete(Number("positive"))] = 1e-10,
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
    guess = guess.guess_for(problem) if isinstance(guess, Solution) else guess
    options = Options(lifted, max_iterations, tol, goal_tol)
    if isinstance(guess, Sequence) and guess and isinstance(guess[0], Guess | Solution):
        plain = [g.guess_for(problem) if isinstance(g, Solution) else g for g in guess]
        every = [unknowns_of(problem, g, lifted) for g in plain]
        many = jax.tree.map(lambda *x: jnp.stack(x), *every)
    else:
        middle = unknowns_of(problem, guess, lifted)
        spread = for_each(spread, problem.channels, "multi_start: spread", "input channel")
        rates = for_each(rates, scattered_rates(problem, middle), "multi_start: rates", "rate")
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
    return jax.vmap(lambda unknowns: sequential.solved(problem, options, unknowns, scale))(many)


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
