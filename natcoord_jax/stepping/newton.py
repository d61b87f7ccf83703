"""Newton's iteration to the round-off floor, in two loops that compile to while loops.

The first loop applies one approximate inverse (of the inertia matrix, or of the Jacobian at the guess) and
watches its contraction. Where that is poor, the second loop takes over with exact Jacobians; in the usual
case it makes no trip, which costs nothing, also under vmap.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.core.results import Result
from natcoord_jax.stepping.factorise import FACTORISATIONS

TOLERANCE = 5e-15
"""Predicted error after the last correction, relative to the terms of the equations (energy norm)."""

STALL = 2000.0
"""Corrections that stop shrinking below STALL * tolerance have reached the floor of round-off."""

CHORD_ITERATIONS = 16
NEWTON_ITERATIONS = 25
CONTRACTION = 0.35
"""Slowest contraction at which the first loop goes on."""


class Solution(eqx.Module):
    """Outcome of the iteration.

    Attributes:
        y: unknowns.
        code: result code.
        iterations: evaluations of the residual.
        error: size of the last correction relative to the terms of the equations.
    """

    y: Float[Array, " unknowns"]
    code: Int[Array, ""]
    iterations: Int[Array, ""]
    error: Float[Array, ""]


class _Iterate(eqx.Module):
    y: Array
    correction: Array
    size: Array
    count: Array
    converged: Array
    failed: Array


def _iterate(equations: Any, it: _Iterate, factors: Any, weights: Array, tolerance: Array | float, slowest: float):
    residual, size = equations.residual(it.y)
    change = factors.solve(residual)
    correction = jnp.sqrt(jnp.sum(weights * change**2))
    ratio = correction / jnp.where(it.correction > 0, it.correction, 1.0)
    first = it.count == 0
    predicted = jnp.where(first, correction, correction * ratio / jnp.maximum(1.0 - ratio, 1e-3))
    small = jnp.where(ratio < 1.0, predicted, correction) <= tolerance * size
    stalled = ~first & (ratio > 0.5) & (correction <= STALL * tolerance * size)
    converged = small | stalled
    finite = jnp.isfinite(correction) & jnp.isfinite(size)
    slow = ~first & (ratio > slowest)
    return _Iterate(
        jnp.where(finite, it.y - change, it.y),
        correction,
        size,
        it.count + 1,
        converged & finite,
        ~finite | (slow & ~converged),
    )


def newton(equations: Any, tolerance: Float[Array, ""] | float, form: str) -> Solution:
    """Solve the equations of one step.

    Args:
        equations: a prepared step (`residual`, `guess`, `approximate`, `jacobian`).
        tolerance: see `TOLERANCE`.
        form: form of the equations, which decides the factorisation.

    Returns:
        The solution; its code is successful, max_iterations, diverged or nonfinite, never an exception.
    """
    guess = equations.guess()
    factorise = FACTORISATIONS[form]
    inverse, weights = factorise(equations, equations.approximate(guess))
    zero, no = jnp.zeros((), guess.dtype), jnp.array(False)
    start = _Iterate(guess, zero, zero, jnp.array(0), no, no)

    def go_on(it: _Iterate) -> Array:
        return ~it.converged & ~it.failed & (it.count < CHORD_ITERATIONS)

    with jax.named_scope("chord"):
        first = jax.lax.while_loop(
            go_on, lambda it: _iterate(equations, it, inverse, weights, tolerance, CONTRACTION), start
        )

    def body(carry: tuple[_Iterate, Array]) -> tuple[_Iterate, Array]:
        it, largest = carry
        after = _iterate(equations, it, factorise(equations, equations.jacobian(it.y))[0], weights, tolerance, jnp.inf)
        diverged = after.correction > 1e6 * largest
        failed = after.failed | (diverged & (it.count > 0))
        after = eqx.tree_at(lambda x: x.failed, after, failed)
        return after, jnp.where(it.count == 0, after.correction, largest)

    def newton_on(carry: tuple[_Iterate, Array]) -> Array:
        it, _ = carry
        return ~it.converged & ~it.failed & (it.count < NEWTON_ITERATIONS)

    restart = _Iterate(guess, zero, zero, jnp.array(0), first.converged, no)
    restart = eqx.tree_at(lambda x: x.y, restart, jnp.where(first.converged, first.y, guess))
    with jax.named_scope("newton"):
        second, _ = jax.lax.while_loop(newton_on, body, (restart, jnp.asarray(jnp.inf, guess.dtype)))
    done = first.converged
    y = jnp.where(done, first.y, second.y)
    correction = jnp.where(done, first.correction, second.correction)
    size = jnp.where(done, first.size, second.size)
    failed_code = jnp.where(
        ~jnp.isfinite(correction) | ~jnp.all(jnp.isfinite(y)),
        int(Result.NONFINITE),
        jnp.where(second.failed, int(Result.DIVERGED), int(Result.MAX_ITERATIONS)),
    )
    code = jnp.where(done | second.converged, int(Result.SUCCESSFUL), failed_code)
    return Solution(y, code, first.count + second.count, correction / jnp.where(size > 0, size, 1.0))
