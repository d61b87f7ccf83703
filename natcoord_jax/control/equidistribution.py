"""Choice of the next mesh: as many steps as the error asks for, where it asks for them.

A step whose error falls with a power of its length is to be divided into a number of parts that follows from
its error. Steps are laid one after the other so that each makes the same error: where it is large they are
divided, and where it is small merged. See J. T. Betts, Practical Methods for Optimal Control and Estimation
Using Nonlinear Programming, 2nd ed., SIAM (2010), chapter 4, and F. Liu, W. W. Hager, A. V. Rao, J. Franklin
Inst. 352 (2015) 4081-4106. Where no more steps are asked for than there are, they are only moved, and no
program is compiled for another number.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.control.local_error import LocalErrors, sections
from natcoord_jax.control.mesh import lengths
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.refinement import with_steps

AIM = 0.6
"""Error that is aimed at, in terms of what is tolerated."""
FEWEST_PARTS, MOST_PARTS, MOST_ABOUT_JUMPS = 0.5, 100.0, 10.0
"""Parts into which a step is divided in one round; half a part is one with its neighbour. Where an input
jumps is known only as well as the mesh is fine."""
GROWTH = 3.0
"""Factor on the number of steps in one round at most."""
LONGEST = 2.0
"""Longest step, in terms of the longest of the first mesh: bounds and costs are looked at once a step."""
LEAST_PART = 0.05
"""Error of a jump at most, at the edge of its step, in terms of that in the middle, that is counted on."""
RISE = 1.0
"""Length of an interval at most, per way from one that has to be short, in addition to its length."""
MORE = 1.25
"""Factor on the number of steps in one round at least, if they are not only moved."""
HELPED = 0.5
"""Error after moving steps, in terms of that before, that is worth it."""


def with_own_lengths(problem: OptimalControl) -> OptimalControl:
    """The problem with a length for each step, so that moving them compiles nothing."""
    return with_steps(problem, problem.phases, lengths_of(problem), lambda step: step)


def lengths_of(problem: OptimalControl) -> Float[np.ndarray, " steps"]:
    """Lengths of all steps as the problem gives them [s]; those of free durations in proportion."""
    return np.asarray(lengths(problem.phases, problem.dt))


def check_intervals(problem: OptimalControl) -> None:
    """Refuse a mesh whose phases and waypoints are not at ends of intervals of the inputs.

    Raises:
        ValueError: for such a one.
    """
    if problem.later:
        raise ValueError(
            f"refine goes along the motion of one system, and this problem has {len(problem.systems)}; pass "
            "dt for each step where the motion is fast"
        )
    every = problem.inputs.every
    for _, last in sections(problem):
        if last % every:
            raise ValueError(
                f"refine: inputs have intervals of every={every} steps, and a phase or waypoint ends after "
                f"step {last}; end them after a multiple of {every} steps"
            )


def wished(
    problem: OptimalControl, errors: LocalErrors, tolerance: float, longest: Any
) -> list[Float[np.ndarray, " ends"]]:
    """Ends of the intervals that errors ask for, in each section [s]; what is left of the last one counts.

    An interval is as long as the errors about it allow, and no longer than `RISE` times the way from a short
    one besides.

    Args:
        problem: the problem.
        errors: of its steps.
        tolerance: what is tolerated of them.
        longest: interval of each phase [s].
    """
    every, size = problem.inputs.every, intervals_of(problem)
    worst = errors.steps.reshape(-1, every).max(axis=1) / (AIM * tolerance)
    phase = np.repeat(np.arange(len(problem.phases)), np.array(problem.phases) // every)
    # Errors of jumps fall with the square of their step alone, which need be short there only.
    jumps = np.nan_to_num(errors.jumps, nan=-1.0).reshape(len(size), -1)
    jumping = np.max(jumps, axis=1, initial=-1.0) >= 0
    # Errors change their sign here and there, where steps are not to be long for that.
    power = errors.order + 1
    dense = np.pad(np.where(jumping, 0.0, worst / size**power), 1, "edge")
    dense = 0.25 * (dense[:-2] + dense[2:]) + 0.5 * dense[1:-1]
    allowed = size / np.clip(size * dense ** (1.0 / power), FEWEST_PARTS, MOST_PARTS)
    middle = np.maximum(2.0 * np.minimum(jumps, 1.0 - jumps), LEAST_PART)
    allowed = np.minimum(np.where(jumping, size, allowed), np.asarray(longest)[phase])
    found = []
    for first, last in sections(problem):
        here = slice(first // every, last // every)
        ends = np.concatenate([[0.0], np.cumsum(size[here])])
        row, column = np.nonzero(jumps[here] >= 0)
        at = ends[row] + jumps[here][row, column] * size[here][row]
        begin, end = np.concatenate([ends[:-1], at]), np.concatenate([ends[1:], at])
        # In the next mesh it may be in the middle of a step, where the error is largest.
        worse = np.sqrt(worst[here][row] / middle[here][row, column])
        short = size[here][row] / np.clip(worse, FEWEST_PARTS, MOST_ABOUT_JUMPS)
        found.append(_marched(begin, end, np.concatenate([allowed[here], short])))
    return found


def _marched(begin: np.ndarray, end: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Ends of intervals that are laid one after the other, the last one beyond the end of the section.

    Args:
        begin: where intervals begin, and points.
        end: where they end.
        allowed: length of intervals there.
    """

    def length(t: float) -> float:
        away = np.maximum(np.maximum(begin - t, t - end), 0.0)
        return float(np.min(allowed + RISE * away))

    found, whole = [0.0], float(np.max(end))
    while found[-1] < whole * (1.0 - 1e-9):
        h = length(found[-1])
        found.append(found[-1] + min(h, length(found[-1] + h)))
    return np.array(found)


def intervals_of(problem: OptimalControl) -> Float[np.ndarray, " intervals"]:
    """Lengths of the intervals of the inputs as the problem gives them [s]."""
    return lengths_of(problem).reshape(-1, problem.inputs.every).sum(axis=1)


def longest_of(problem: OptimalControl) -> list[float]:
    """Longest intervals of all phases that are allowed [s]."""
    ends = np.cumsum(np.array(problem.phases) // problem.inputs.every)[:-1]
    return [LONGEST * float(np.max(piece)) for piece in np.split(intervals_of(problem), ends)]


def asked_for(problem: OptimalControl, wishes: list[np.ndarray]) -> Float[np.ndarray, " sections"]:
    """Numbers of intervals wished for in each section; of the last one the part that there is room for."""
    time = np.concatenate([[0.0], np.cumsum(lengths_of(problem))])
    wholes = [time[last] - time[first] for first, last in sections(problem)]
    found = [len(w) - 2 + (whole - w[-2]) / (w[-1] - w[-2]) for w, whole in zip(wishes, wholes)]
    return np.array(found)


def present(problem: OptimalControl) -> np.ndarray:
    """Numbers of intervals of all sections."""
    return np.array([(last - first) // problem.inputs.every for first, last in sections(problem)])


def worth_moving(now: np.ndarray, asked: np.ndarray, worst: float, tolerance: float, order: int) -> bool:
    """Whether as many intervals as there are, moved, are expected to do, or to help much."""
    expected = AIM * tolerance * float(np.max(asked / now)) ** (order + 1)
    return expected <= max(tolerance, HELPED * worst)


def more_of(now: np.ndarray, asked: np.ndarray, most: int) -> np.ndarray:
    """Numbers of intervals of all sections where moving them does not do."""
    whole = float(np.clip(np.sum(asked), MORE * now.sum(), GROWTH * now.sum()))
    limit = max(min(whole, most), len(now))
    found = np.maximum(1, np.ceil(asked * (limit / np.sum(asked)) - 1e-6))
    return (
        found.astype(int)
        if found.sum() <= most
        else np.maximum(1, np.floor(found * most / found.sum())).astype(int)
    )


def divided(problem: OptimalControl, wishes: list[np.ndarray], numbers: np.ndarray) -> OptimalControl:
    """The problem on a mesh of so many intervals, in the proportions of those wished for.

    Args:
        problem: the problem.
        wishes: see `wished`.
        numbers: of intervals of all sections.
    """
    every, phase = problem.inputs.every, np.repeat(np.arange(len(problem.phases)), problem.phases)
    size, places, phases = [], {}, [0] * len(problem.phases)
    rows = zip(sections(problem), wishes, asked_for(problem, wishes), numbers)
    for (first, last), wish, count, number in rows:
        ends = np.interp(np.linspace(0.0, count, number + 1), np.arange(len(wish)), wish)
        size.append(np.repeat(np.diff(ends) / every, every))
        phases[phase[first]] += int(number) * every
        places[last] = sum(phases)
    return with_steps(problem, tuple(phases), np.concatenate(size), lambda step: places[step])
