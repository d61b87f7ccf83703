"""Derivatives of one random scene in every mode, and how far each is from what it should be."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tolerances as tol
from differences import along
from hunting import KINDS, Case, Template, case_of, plainly, recorded, score, simulated

import natcoord_jax as nc

STEPS = 10.0 ** -np.arange(2.0, 8.5, 0.5)
"""Of the differences."""

compiled = partial(jax.jit, static_argnums=0)


@compiled
def reverse(template: Template, case: Case, numbers: Any) -> tuple:
    """Value, what the runs say, and the gradient."""
    f = simulated(template)
    return jax.value_and_grad(f, has_aux=True)(numbers, case.static, case.weights)


@compiled
def checkpointed(template: Template, case: Case) -> tuple:
    """The gradient where the way back recomputes, and what the runs say."""
    f = simulated(template, checkpoint=True)
    return jax.grad(f, has_aux=True)(case.numbers, case.static, case.weights)


@compiled
def batch(template: Template, cases: Case) -> Any:
    """Gradients of stacked cases."""

    def gradient(case):
        return jax.grad(simulated(template), has_aux=True)(case.numbers, case.static, case.weights)[0]

    return jax.vmap(gradient)(cases)


@compiled
def forward(template: Template, case: Case, direction: Any) -> tuple:
    """Value, its change, and the record of all slots."""

    def f(numbers):
        return recorded(template)(numbers, case.static, case.weights)

    return jax.jvp(f, (case.numbers,), (direction,), has_aux=True)


@compiled
def directions(template: Template, case: Case) -> Any:
    """Changes along all directions at once."""

    def f(numbers):
        return simulated(template)(numbers, case.static, case.weights)[0]

    return jax.vmap(lambda d: jax.jvp(f, (case.numbers,), (d,))[1])(case.directions)


@compiled
def second(template: Template, case: Case, direction: Any) -> tuple:
    """Second derivative along a direction, forward over reverse."""

    def slope(numbers):
        result = jax.grad(simulated(template), has_aux=True)(numbers, case.static, case.weights)[0]
        parts = zip(jax.tree.leaves(result), jax.tree.leaves(direction))
        return sum(jnp.vdot(g, d) for g, d in parts)

    return jax.jvp(slope, (case.numbers,), (direction,))


@compiled
def plain(template: Template, case: Case, records: Any) -> tuple:
    """Changes along all directions, the largest term of each, and how far solutions are apart.

    Terms are those of the derivative of the loss by all saved states.
    """

    def f(numbers):
        total, said = plainly(template, records)(numbers, case.static, case.weights)
        return (total, [x for x, _ in said]), [apart for _, apart in said]

    def change(direction):
        (_, seen), (slope, changes), apart = jax.jvp(f, (case.numbers,), (direction,), has_aux=True)
        largest = jnp.zeros(())
        for x, dx, weights in zip(seen, changes, case.weights):
            largest = jnp.maximum(largest, jnp.max(jnp.abs(jax.grad(score)(x, weights) * dx)))
        return slope, largest, jnp.max(jnp.stack(apart))

    return jax.vmap(change)(case.directions)


@compiled
def plain_second(template: Template, case: Case, records: Any, direction: Any) -> Any:
    """Second derivative along a direction."""

    def f(numbers):
        return plainly(template, records, 3)(numbers, case.static, case.weights)[0]

    def slope(numbers):
        return jax.jvp(f, (numbers,), (direction,))[1]

    return jax.jvp(slope, (case.numbers,), (direction,))[1]


def contracted(gradient: Any, directions: Any) -> np.ndarray:
    """Changes along stacked directions by a gradient."""
    parts = zip(jax.tree.leaves(gradient), jax.tree.leaves(directions))
    return sum(np.asarray(d).reshape(len(d), -1) @ np.ravel(g) for g, d in parts)


def differences(template: Template, case: Case, direction: Any, steps: np.ndarray, said: Any) -> np.ndarray:
    """Central ones, of runs that end alike and repeat as many steps: other substeps are another motion."""
    result = []
    for step in steps:
        (ahead, one), _ = reverse(template, case, along(case.numbers, direction, step))
        (behind, other), _ = reverse(template, case, along(case.numbers, direction, -step))
        if np.all(np.array([one, other]) == np.array(said)):
            result.append(float(ahead - behind) / (2.0 * step))
    return np.array(result)


def missed(quotients: np.ndarray, exact: float) -> float:
    """Error by the differences that know best, in terms of their noise where that is more than tolerated.

    Long steps see what is not linear, or beyond a kink; short ones are noise. How much is known from three
    neighbours, which have to agree to some digits.
    """
    three = np.stack([quotients[:-2], quotients[1:-1], quotients[2:]])
    spread = np.max(three, axis=0) - np.min(three, axis=0)
    error = np.min(np.abs(three - exact), axis=0)
    noise = np.maximum(spread / tol.DIFFERENCE_OF_A_SUDDEN_MOTION, 1.0)
    return float(np.min(np.where(spread <= tol.SPREAD_OF_DIFFERENCES, error / noise, np.inf)))


def examined(template: Template, seed: int) -> dict[str, tuple[float, float]]:
    """By mode: the error relative to the largest term, and what it may be."""
    case = case_of(template, seed)
    sum_of_all = jax.tree.map(lambda x: jnp.sum(x, axis=0), case.directions)
    value, slope, records = forward(template, case, sum_of_all)
    (again, said), gradient = reverse(template, case, case.numbers)
    ended = all(int(result) in (nc.Result.SUCCESSFUL, nc.Result.EVENT) for result, _ in said)
    exact, terms, left = (np.asarray(x) for x in plain(template, case, records))
    largest = np.max(terms)
    scales = np.maximum(terms, tol.SMALL_PART * largest)
    assert largest > 0 and np.all(np.isfinite(exact)), "nothing is tested"
    total, same = np.sum(exact), tol.SAME_DERIVATIVE

    def worst(result: Any) -> float:
        return float(np.max(np.abs(np.asarray(result) - exact) / scales))

    errors = {"solutions": (float(np.max(left)), tol.SAME_SOLUTION)}
    # Two programs of a run that is cut off may have repeated other steps, by rounding: another motion.
    apart = float(abs(again - value) / max(abs(value), largest))
    if ended or apart <= same:
        errors["value"] = apart, same
        for kind, x, y, scale in zip(KINDS, contracted(gradient, case.directions), exact, scales):
            errors[f"reverse, {kind}"] = float(abs(x - y) / scale), same
    errors["forward"] = float(abs(slope - total) / largest), same
    if "checkpointed" in template.more and ended:  # Its segments have substeps of their own to use up.
        result, segments = checkpointed(template, case)
        # Which steps are repeated may be a matter of rounding: other substeps are another motion.
        if np.all(np.array(segments) == np.array(said)):
            errors["checkpointed"] = worst(contracted(result, case.directions)), same
    if "directions" in template.more:
        errors["directions"] = worst(directions(template, case)), same
    if "batch" in template.more:
        cases = jax.tree.map(lambda *x: jnp.stack(x), case_of(template, seed + 1), case)
        result = jax.tree.map(lambda x: x[1], batch(template, cases))
        errors["batch"] = worst(contracted(result, case.directions)), same
    if "second" in template.more:
        (_, result), bent = (
            second(template, case, sum_of_all),
            plain_second(template, case, records, sum_of_all),
        )
        errors["second"] = float(abs(result - bent) / max(abs(bent), largest)), same
    # Derivatives hold lengths of substeps, which change with the motion; where these were used up, rounding
    # says in which step.
    if template.rtol is None and ended:
        result = differences(template, case, sum_of_all, STEPS / np.sqrt(max(1.0, largest)), said)
        if len(result) >= 3:
            error = missed(result / largest, total / largest)
            errors["differences"] = error, tol.DIFFERENCE_OF_A_SUDDEN_MOTION
    return errors
