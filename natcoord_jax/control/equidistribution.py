"""Choice of the next mesh: as many steps as the error asks for, where it asks for them.

A step whose error falls with a power of its length is to be divided into a number of parts that follows from
its error; they are laid so that every new step gets the same share of these parts: steps are divided where the error is large
and merged where it is small. See J. T. Betts, Practical Methods for Optimal Control and Estimation Using
Nonlinear Programming, 2nd ed., SIAM (2010), chapter 4, and F. Liu, W. W. Hager, A. V. Rao, J. Franklin Inst.
352 (2015) 4081-4106. Where no more steps are asked for than there are, they are only moved, and no program is
compiled for another number.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.control.local_error import ORDER, sections
from natcoord_jax.control.mesh import lengths
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.refinement import with_steps
from natcoord_jax.control.resampling import ends_of

AIM = 0.6
"""Error that is aimed at, in terms of what is tolerated."""
MOST_PARTS = 10.0
"""Parts into which a step is divided at most in one round."""
GROWTH = 3.0
"""Factor on the number of steps in one round at most."""
LONGEST = 2.0
"""Longest step, in terms of the longest of the first mesh: bounds and costs are looked at once a step."""
MORE = 1.3
"""Factor on the number of steps where moving them has not helped."""


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
    every = problem.inputs.every
    for _, last in sections(problem):
        if last % every:
            raise ValueError(
                f"refine: inputs have intervals of every={every} steps, and a phase or waypoint ends after "
                f"step {last}; end them after a multiple of {every} steps"
            )


def parts_of(
    problem: OptimalControl, errors: Float[np.ndarray, " steps"], tolerance: float, longest: Any
) -> list[Float[np.ndarray, " intervals"]]:
    """Into how many parts each interval of the inputs is to be divided, of each section."""
    size = np.diff(ends_of(problem)).reshape(-1, problem.inputs.every).sum(axis=1)
    worst = errors.reshape(-1, problem.inputs.every).max(axis=1)
    parts = np.minimum((worst / (AIM * tolerance)) ** (1.0 / (ORDER + 1)), MOST_PARTS)
    phase = np.repeat(np.arange(len(problem.phases)), np.array(problem.phases) // problem.inputs.every)
    parts = np.maximum(parts, size / np.asarray(longest)[phase])
    every = problem.inputs.every
    return [parts[first // every : last // every] for first, last in sections(problem)]


def longest_of(problem: OptimalControl) -> list[float]:
    """Longest intervals of all phases that are allowed, as parts of the phases."""
    size = np.diff(ends_of(problem)).reshape(-1, problem.inputs.every).sum(axis=1)
    ends = np.cumsum(np.array(problem.phases) // problem.inputs.every)[:-1]
    return [LONGEST * float(np.max(piece)) for piece in np.split(size, ends)]


def numbers_of(parts: list[np.ndarray], most: int, stuck: bool) -> list[int]:
    """Numbers of intervals of all sections.

    Args:
        parts: see `parts_of`.
        most: number of all together.
        stuck: whether moving them has not helped.
    """
    now = np.array([len(piece) for piece in parts])
    asked = np.array([max(1, int(np.ceil(np.sum(piece) - 1e-9))) for piece in parts])
    if np.all(asked <= now):
        if not stuck:
            return now.tolist()
        asked = np.ceil(MORE * now).astype(int)
    limit = max(min(most, int(GROWTH * now.sum())), len(now))
    if asked.sum() > limit:
        asked = np.maximum(1, np.floor(asked * (limit / asked.sum()))).astype(int)
    return asked.tolist()


def divided(problem: OptimalControl, parts: list[np.ndarray], numbers: list[int]) -> OptimalControl:
    """The problem on the mesh of so many intervals, each with the same share of the parts."""
    every, old, given = problem.inputs.every, ends_of(problem), lengths_of(problem)
    time = np.concatenate([[0.0], np.cumsum(given)])
    size, places, phases = [], {0: 0}, [0] * len(problem.phases)
    for (first, last), piece, count in zip(sections(problem), parts, numbers):
        before = np.concatenate([[0.0], np.cumsum(piece)])
        ends = np.interp(np.linspace(0.0, before[-1], count + 1), before, time[first : last + 1 : every])
        size.append(np.repeat(np.diff(ends) / every, every))
        places[last] = places[first] + count * every
        phases[int(np.ceil(old[last] - 0.5)) - 1] += count * every
    return with_steps(problem, tuple(phases), np.concatenate(size), lambda step: places[step])
