"""Derivatives against differences: the error must be V-shaped over the step of the difference.

Truncation falls with the square of the step, round-off grows with its inverse. A derivative that is wrong by
anything leaves a plateau instead; one that is right by luck at one step shows on the others.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import tolerances as tol

STEPS = 10.0 ** -np.arange(1.0, 9.5, 0.5)


def along(tree: Any, direction: Any, step: float) -> Any:
    """The point `step` along a direction."""
    return jax.tree.map(lambda x, d: x + step * d, tree, direction)


def flat(tree: Any) -> np.ndarray:
    """All numbers of a tree in one vector."""
    leaves = [np.ravel(np.asarray(x)) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves) if leaves else np.zeros(0)


def difference_errors(f: Callable, x: Any, direction: Any, derivative: Any, steps=STEPS) -> np.ndarray:
    """Errors of central differences of `f` at `x`, relative to the derivative along `direction`."""
    exact = flat(derivative)
    scale = np.max(np.abs(exact))
    assert scale > 0 and np.all(np.isfinite(exact)), "the derivative is zero or not finite: nothing is tested"
    found = []
    for step in steps:
        ahead, behind = flat(f(along(x, direction, step))), flat(f(along(x, direction, -step)))
        found.append(np.max(np.abs((ahead - behind) / (2 * step) - exact)) / scale)
    return np.array(found)


def lanes_along(x: np.ndarray, direction: np.ndarray, steps=STEPS) -> list[np.ndarray]:
    """Points of central differences for a batch: all ahead of `x`, then all behind it."""
    return [x + sign * step * direction for sign in (1.0, -1.0) for step in steps]


def errors_of_lanes(lanes: Any, derivative: Any, steps=STEPS) -> np.ndarray:
    """Errors of central differences by the values at `lanes_along`, relative to the derivative."""
    exact = flat(derivative)
    scale = np.max(np.abs(exact))
    assert scale > 0 and np.all(np.isfinite(exact)), "the derivative is zero or not finite: nothing is tested"
    values = np.concatenate([np.reshape(x, (len(x), -1)) for x in jax.tree.leaves(lanes)], axis=1)
    ahead, behind = np.split(values, 2)
    differences = (ahead - behind) / (2.0 * np.asarray(steps)[:, None])
    return np.max(np.abs(differences - exact), axis=1) / scale


def assert_v_shaped(
    f: Callable, x: Any, direction: Any, derivative: Any, *, polynomial: bool = False, steps=STEPS
) -> None:
    """The error falls by the square of the step to a small value, then grows with round-off.

    Args:
        f: function of a tree.
        x: where.
        direction: along what, a tree like `x`.
        derivative: of `f` at `x` along `direction`, to be judged.
        polynomial: `f` is at most quadratic along the direction: there is no truncation, hence no fall.
        steps: of the differences, falling.
    """
    assert_v_of_errors(difference_errors(f, x, direction, derivative, steps), polynomial, steps)


def assert_v_of_errors(errors: np.ndarray, polynomial: bool = False, steps=STEPS) -> None:
    """The same of errors by step."""
    best = int(np.argmin(errors))
    report = "\n".join(f"  step {s:.0e}: error {e:.1e}" for s, e in zip(steps, errors, strict=True))
    assert errors[best] <= tol.DIFFERENCE_BEST, f"differences disagree with the derivative:\n{report}"
    assert errors[-1] > 5 * errors[best], f"the error does not grow with round-off:\n{report}"
    if not polynomial:
        falling = errors[: best + 1]
        ratios = falling[:-2] / np.maximum(falling[2:], 1e-300)
        assert np.max(ratios, initial=0.0) >= tol.DIFFERENCE_FALL, f"no fall of order two:\n{report}"


def alternation(values, order=4):
    """What changes its sign in every row, in terms of the largest value.

    Args:
        values: shape (rows, columns), equally spaced.
        order: of the differences that leave out what is smooth.
    """
    values = np.asarray(values)
    return np.max(np.abs(np.diff(values, order, axis=0))) / 2.0**order / np.max(np.abs(values))
