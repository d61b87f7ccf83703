"""Whole turns of a guess that its solution has not: an attitude as a goal knows no number of turns."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.goal import Attitude
from natcoord_jax.control.goal_links import Turned
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import Unknowns, roll, simulated
from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import named
from natcoord_jax.maths.rotations import to_rotation_vector

NEARLY = 0.75
"""Part of a turn from which on it counts as one."""
TURN = 2.0 * np.pi

Angles = dict[str, Float[np.ndarray, "3"]]
"""Rotation vectors of the steps in the axes of a body, summed [rad], by its name."""


def uncounted(problem: OptimalControl) -> list[str]:
    """Bodies whose attitude the goal asks for, and not how often they turn."""
    if problem.later:
        return []
    parts = list(problem.goal.everything())
    counted = {named(part.body) for part in parts if isinstance(part, Turned)}
    asked = {named(part.body): None for part in parts if isinstance(part, Attitude)}
    return [name for name in asked if name not in counted]


def turned_by(problem: OptimalControl, unknowns: Unknowns, names: list[str], simulate: bool) -> Angles:
    """How far bodies turn in the motion of unknowns, or of their inputs alone."""
    x, whole = _positions(problem, unknowns, simulate)
    return turned_along(problem, x, names) if bool(whole) else {}


@briefly
def _positions(problem: OptimalControl, unknowns: Unknowns, simulate: bool) -> tuple[Array, Array]:
    unknowns, whole, _ = simulated(problem, unknowns, not simulate)
    return roll(problem, unknowns).nodes.x[:, : problem.state.q.size], whole


def turned_along(problem: OptimalControl, x: Any, names: list[str]) -> Angles:
    """How far bodies turn along states as vectors."""
    rows = by_node(np.asarray(x)[:, : problem.state.q.size].reshape(len(x), -1, 3))
    return {name: _summed(rows[:, problem.system.body_index(name), 1:]) for name in names}


def _summed(directors: np.ndarray) -> np.ndarray:
    return np.asarray(jnp.sum(_steps(directors[:-1], directors[1:]), axis=0))


@eager_numpy
def _steps(before: Any, after: Any) -> Array:
    # Directors are the rows: in the axes of the body a turn is before^T after with columns as directors.
    return jax.vmap(lambda a, b: to_rotation_vector(a @ b.T))(before, after)


def lost(guess: Angles, found: Angles) -> Iterator[str]:
    """What is to be told of turns that the guess makes and the solution does not."""
    for name, angles in guess.items():
        whole = float(np.linalg.norm(angles))
        if whole < NEARLY * TURN or not np.all(np.isfinite(found[name])):
            continue
        axis = angles / whole
        other = float(axis @ found[name])
        if abs(whole - other) < NEARLY * TURN:
            continue
        wanted = other + TURN * round((whole - other) / TURN)
        along = np.round(axis, 3) + 0.0
        about = f"({', '.join(f'{x:g}' for x in along)})"
        yield (
            f"the guess turns {name!r} by {whole / TURN:.2f} turns about its axis {about}, and the solution "
            f"by {other / TURN:.2f}: goal.Attitude knows no number of turns; add "
            f"nc.goal.Turned({name!r}, {about}, {wanted:.4f}) to the goal"
        )
