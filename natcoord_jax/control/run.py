"""The entrances: an optimisation with progress and a way out, and one that compiles into other programs."""

import math
import sys
import time
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.control import sequential
from natcoord_jax.control.guess import GUESS, Guess, scattered, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.solution import Row, Solution, outside_at_start, solution_of, worst_condition
from natcoord_jax.control.transcription import Unknowns, held_inputs
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG, Choice, Several, of
from natcoord_jax.core.numeric import Number, Vector, Whole

METHODS = ("auto", "shooting", "lifted")
HEADER = (
    f"{'iter':>4} {'cost':>14} {'gradient':>9} {'violation':>9} {'step':>7} {'newton':>7} {'s':>7}  worst"
)
DEFAULT = Options()
UNKNOWNS = of("unknowns, as the `unknowns` of an iterate", Unknowns)
OPTIONS = of("natcoord_jax.control.iterate.Options(...)", Options)
WEIGHTS = Number("not negative") | Vector(None)
NAMES = {True: "lifted", False: "shooting"}
METHOD = "sequential quadratic programming"
FOR_THE_OTHER = (
    Outcome.SIMULATION_FAILED, Outcome.STALLED, Outcome.MAX_ITERATIONS, Outcome.NONFINITE, Outcome.SINGULAR
)  # fmt: skip
"""Outcomes after which the other form of the method is tried, if the choice was ours."""
SAME = 1e-3
"""Difference of inputs, relative to the largest, below which two optima are taken for one."""


def _chosen(problem: OptimalControl, method: str, guess: Any = None) -> bool:
    """Whether to lift: where time or parameters are free or the path is bounded, simulations lead astray."""
    if method != "auto":
        return method == "lifted"
    if problem.free_time:
        return True
    if isinstance(guess, Solution) and guess.iterate is not None:
        # What it was found by has been compiled, and led to it.
        return guess.method.startswith(NAMES[True])
    inputs = all(label.startswith("input ") for label in problem.bounds.labels(problem.system))
    return bool(problem.free) or not inputs


def _row(problem: OptimalControl, iterate: Iterate, start: float) -> Row:
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


def _run(
    problem: OptimalControl, options: Options, unknowns: Unknowns, progress: bool, time_limit: float
) -> tuple[Iterate, list[Row], Outcome]:
    """The method's loop in Python: a line for each iteration, and a way out."""
    start = time.perf_counter()
    history: list[Row] = []
    iterate = sequential.init(problem, options, unknowns)
    outcome = Outcome.RUNNING
    if progress:
        print(HEADER, file=sys.stderr)
    try:
        while not sequential.done(iterate):
            if time.perf_counter() - start > time_limit:
                outcome = Outcome.TIME_LIMIT
                break
            iterate = sequential.step(problem, options, iterate)
            history.append(_row(problem, iterate, start))
            if progress:
                print(printed(history[-1]), file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        outcome = Outcome.STOPPED
    if outcome is Outcome.RUNNING:
        outcome = Outcome(int(iterate.code))
    return iterate, history, outcome


@checked(
    problem=PROBLEM,
    guess=GUESS | of("an earlier solution", Solution),
    method=Choice(METHODS),
    progress=FLAG,
    max_iterations=Whole(0),
    tol=Number("positive"),
    goal_tol=Number("positive"),
    time_limit=Number("not negative", infinite=True),
)
def optimise(
    problem: OptimalControl,
    guess: Any = None,
    *,
    method: str = "auto",
    progress: bool = True,
    max_iterations: int = 100,
    tol: float = 1e-8,
    goal_tol: float = 1e-10,
    time_limit: float = 600.0,
) -> Solution:
    """Solve an optimal control problem by the second-order method.

    Sequential quadratic programming on the discrete motion with exact gradients, an interior point for the
    bounds and linear algebra that is linear in the number of steps. "shooting" simulates every iterate;
    "lifted" takes the equations of all steps as constraints (as in discrete mechanics and optimal control),
    for swing-ups, minimum time and bounded paths. For any smooth loss without these, see `nc.descend`.

    Args:
        problem: the problem.
        guess: inputs (steps, inputs), a `Guess`, an earlier `Solution`, or None.
        method: "shooting", "lifted" or "auto": that of an earlier solution as guess, else lifted if
            parameters are free or more than inputs is bounded; with free time always lifted.
        progress: print a line for each iteration to stderr.
        max_iterations: limit of iterations.
        tol: largest gradient of the Lagrangian and complementarity, relative.
        goal_tol: largest violation of goal, bounds and equations.
        time_limit: limit of time [s]; checked between iterations.

    Returns:
        The solution; `outcome` and `explain()` say how it ended. An interruption by the keyboard returns
        what was reached.

    Raises:
        ValueError: for a guess of the wrong shape or an unknown method.
    """
    problem = numeric(problem)
    lifted = _chosen(problem, method, guess)
    if isinstance(guess, Solution):
        guess = guess.guess(problem.steps)

    def solved(lifted: bool, guess: Any) -> Solution:
        options = Options(lifted, max_iterations, tol, goal_tol)
        start = unknowns_of(problem, guess, lifted)
        iterate, history, outcome = _run(problem, options, start, progress, time_limit)
        return solution_of(problem, iterate, f"{NAMES[lifted]} {METHOD}", history, outcome)

    if outside_at_start(problem):
        start = unknowns_of(problem, guess, lifted)
        names, values = problem.free, np.asarray(problem.values(start.free)).tolist()
        inputs, dt = held_inputs(problem, start.coefficients), float(problem.applied(start.free)[1])
        code = int(Outcome.INFEASIBLE_START)
        return Solution(problem, inputs, dict(zip(names, values)), dt, math.nan, code, NAMES[lifted])
    found = solved(lifted, guess)
    if method == "auto" and found.outcome in FOR_THE_OTHER:
        # A motion that nearly is one is a start for simulations; a failed simulation is one for neither.
        other = solved(
            not lifted, Guess(found.inputs, rates=None, free=found.guess().free) if lifted else guess
        )
        found = other if other.ok or not found.ok and other.outcome not in FOR_THE_OTHER else found
    return found


@checked(problem=PROBLEM, unknowns=UNKNOWNS, options=OPTIONS)
@compiled
def optimise_jit(problem: OptimalControl, unknowns: Unknowns, options: Options = DEFAULT) -> Iterate:
    """The method as one program, for `jax.vmap`, receding horizons and other programs around it.

    Args:
        problem: the problem; every number of it may be traced.
        unknowns: where to start; see `unknowns_of`.
        options: settings.

    Returns:
        The last iterate; its `code` says how it ended.
    """
    first = sequential.init(problem, options, unknowns)
    return jax.lax.while_loop(
        lambda iterate: iterate.running, lambda iterate: sequential.step(problem, options, iterate), first
    )


@checked(
    problem=PROBLEM,
    guess=GUESS | of("an earlier solution", Solution) | Several(of("a guess or a solution", Guess, Solution)),
    starts=Whole(1),
    spread=WEIGHTS,
    rates=WEIGHTS,
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
) -> list[Solution]:
    """Solve from many guesses at once, and list all optima that are found.

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
        The different optima by cost, or, if there are none, the one that came nearest.
    """
    problem = numeric(problem)
    lifted = _chosen(problem, method)
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
    return _distinct(problem, _all_solved(problem, many, options), lifted)


@compiled
def _all_solved(problem: OptimalControl, many: Unknowns, options: Options) -> Iterate:
    """The method from many guesses at once; one program for all calls of the same structure."""
    return jax.vmap(lambda unknowns: optimise_jit(problem, unknowns, options))(many)


def _distinct(problem: OptimalControl, found: Iterate, lifted: bool) -> list[Solution]:
    """Different optima of a batch, by cost.

    Two are the same if what is solved for is: mirror images cost the same and are two.
    """
    codes, costs = np.asarray(found.code), np.asarray(found.path.cost)
    solved = [np.asarray(x) for x in (found.unknowns.coefficients, found.unknowns.free)]

    def same(k: int, n: int) -> bool:
        return all(np.all(np.abs(x[k] - x[n]) <= SAME * np.max(np.abs(x[n]), initial=0.0)) for x in solved)

    kept: list[int] = []
    for k in (int(k) for k in np.argsort(costs) if Outcome(int(codes[k])).ok):
        if not any(same(k, n) for n in kept):
            kept.append(k)
    kept = kept or [int(np.nanargmin(np.asarray(found.errors.goal)))]
    name = f"{NAMES[lifted]} {METHOD}, start"
    solutions = []
    for k in kept:
        iterate = jax.tree.map(itemgetter(k), found)
        row = _row(problem, iterate, time.perf_counter())
        solutions.append(solution_of(problem, iterate, f"{name} {k}", [row], Outcome(int(codes[k]))))
    return solutions
