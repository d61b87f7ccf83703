"""Histories of one mesh on another one."""

from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.control.mesh import lengths
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.maths.collocation import gauss

Ends = Float[np.ndarray, " ends"]
"""Where steps begin and end: the number of the phase and the part of it that has gone by."""
ROUNDING = 1e-14
"""Relative difference of meshes that are the same."""


def ends_of(problem: OptimalControl) -> Ends:
    """Those of a problem; free durations of phases change nothing of them."""
    each, found = np.asarray(lengths(problem.phases, problem.dt)), [np.zeros(1)]
    for number, piece in enumerate(np.split(each, np.cumsum(problem.phases)[:-1])):
        gone = np.cumsum(piece)
        found.append(number + gone / gone[-1])
    return np.concatenate(found)


def in_proportion(ends: Ends, steps: int) -> Ends:
    """Those of another number of steps, of the same proportions."""
    count = len(ends) - 1
    return np.interp(np.linspace(0.0, count, steps + 1), np.arange(count + 1), ends)


def in_phases(ends: Ends) -> list[Ends]:
    """Those of each phase by itself."""
    count = round(ends[-1])
    edges = np.searchsorted(ends, np.arange(count + 1) - 1e-9)
    return [ends[a : b + 1] for a, b in zip(edges[:-1], edges[1:])]


def middles(ends: Ends) -> np.ndarray:
    """Middles of the steps."""
    return 0.5 * (ends[1:] + ends[:-1])


def _same(old: Ends, new: Ends) -> bool:
    return len(old) == len(new) and bool(np.all(np.abs(old - new) <= ROUNDING * old[-1]))


def _means(values: np.ndarray) -> np.ndarray:
    """Means over the steps of what is known at their stages."""
    if values.ndim == 2:
        return values
    return np.einsum("s,ksm->km", np.array(gauss(values.shape[1]).b), values)


def averaged(values: np.ndarray, old: Ends, new: Ends) -> np.ndarray:
    """Means of a history held over steps, or known at their stages, over others; the same over the same."""
    if _same(old, new):
        return values
    values = _means(values)
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(np.diff(old)[:, None] * values, axis=0)])
    return np.diff(_looked_up(new, old, sums), axis=0) / np.diff(new)[:, None]


def at_middles(values: np.ndarray, old: Ends, new: Ends) -> np.ndarray:
    """Values at the middles of steps, at those of others."""
    if _same(old, new):
        return values
    return _looked_up(middles(new), middles(old), values)


def _looked_up(at: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation of columns."""
    found = np.zeros((len(at), values.shape[1]))
    for k, column in enumerate(values.T):
        found[:, k] = np.interp(at, known, column)
    return found


def interpolated(values: np.ndarray, old: Ends, new: Ends) -> np.ndarray:
    """Mean rates of steps, for others; a staircase would shake the motion. Those of stages over the same."""
    if _same(old, new):
        return values
    found = at_middles(_means(values), old, new)
    # The kinks between the old middles excite swings from step to step.
    size, first = np.diff(new), found[:1]
    if len(found) > 1:
        first = first + size[0] / (size[0] + size[1]) * (first - found[1:2])
    return free_of_swings(np, first, found, size)


def free_of_swings(xp: Any, first: Any, rates: Any, lengths: Any = None) -> Any:
    """Means of rates at the ends of steps that are themselves means of the given ones, by JAX or NumPy.

    Args:
        xp: `jax.numpy` or `numpy`.
        first: rates at the start (1, n).
        rates: mean rates of the steps (steps, n).
        lengths: of the steps; None: equal ones.
    """
    size = xp.ones(len(rates)) if lengths is None else lengths
    part = (size[:-1] / (size[:-1] + size[1:]))[:, None]
    inner = part * rates[1:] + (1.0 - part) * rates[:-1]
    last = rates[-1:] if len(rates) < 2 else rates[-1:] + (1.0 - part[-1:]) * (rates[-1:] - rates[-2:-1])
    ends = xp.concatenate([first, inner, last])
    return 0.5 * (ends[1:] + ends[:-1])
