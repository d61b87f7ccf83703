"""A solution followed while its problem changes along a path."""

import sys
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np

from natcoord_jax.control.attempts import NAMES
from natcoord_jax.control.guess import GUESS, Guess
from natcoord_jax.control.problem import PROBLEM, OptimalControl
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.run import FORMS, optimise
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import FLAG, Choice, Concrete, FunctionOf, of
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.xla.waiting import Stopwatch

QUICK = 6
"""Iterations up to which a step along a path was short."""


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


@checked()
def continuation(
    problem: Annotated[OptimalControl, Concrete(PROBLEM)],
    path: Annotated[Callable[[OptimalControl, float], OptimalControl], FunctionOf("(problem, s) -> problem")],
    guess: Annotated[Any, GUESS | of("an earlier solution", Solution)] = None,
    *,
    first: Annotated[float, Number("positive")] = 0.25,
    least: Annotated[float, Number("positive")] = 1e-3,
    method: Annotated[str, Choice(FORMS)] = "auto",
    progress: Annotated[bool, FLAG] = True,
    max_iterations: Annotated[int, Whole(1)] = 60,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-8,
    goal_tol: Annotated[float, Concrete(Number("positive"))] = 1e-10,
    time_limit: Annotated[float, Concrete(Number("not negative", infinite=True))] = 600.0,
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
        time_limit: of the whole [s]; compiling does not count.

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
    watch, found = Stopwatch(), Continuation()
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
        if length < least or watch.seconds > time_limit:
            limit = f"steps of {length:.1e}" if length < least else f"{time_limit:g} s"
            found.reason = f"at {found.at[-1]:.4f} it was given up, after {limit}: {last.explain()}"
            return found
        s = min(found.at[-1] + length, 1.0)
        form = next(name for name in NAMES.values() if found[-1].method.startswith(name))
        start = _carried_on(found, s)
        left = max(0.0, time_limit - watch.seconds)
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
