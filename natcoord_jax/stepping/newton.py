"""Newton's iteration to the round-off floor, in while loops.

One factorisation serves as long as the corrections shrink quickly; then the Jacobian is formed anew. Where
the inertia matrix alone will do (no springs, dampers or loops), it serves first, and the loop over exact
Jacobians makes no trip in the usual case, which costs nothing, also under vmap.
"""

from functools import partial
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
"""Corrections with one factorisation."""

NEWTON_ROUNDS = 25
"""Factorisations of exact Jacobians."""

CONTRACTION = 0.35
"""Slowest contraction at which a factorisation is kept."""


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
    total: Array
    converged: Array
    slow: Array
    finite: Array


def _iterate(equations: Any, factors: Any, inertias: Array, tolerance: Any, it: _Iterate) -> _Iterate:
    """One correction with given factors; a correction that shrinks too slowly is not applied."""
    residual, size = equations.residual(it.y)
    change = factors.solve(residual)
    correction = jnp.sqrt(jnp.sum(inertias * change**2))
    ratio = correction / jnp.where(it.correction > 0, it.correction, 1.0)
    first = it.count == 0
    predicted = correction * jnp.where(first, 1.0, ratio / jnp.maximum(1.0 - ratio, 1e-3))
    small = predicted <= tolerance * size
    stalled = ~first & (ratio > 0.5) & (correction <= STALL * tolerance * size)
    finite = jnp.isfinite(correction) & jnp.isfinite(size)
    converged = (small | stalled) & finite
    slow = ~first & (ratio > CONTRACTION) & ~converged
    y = jnp.where(finite & ~slow, it.y - change, it.y)
    return _Iterate(y, correction, size, it.count + 1, it.total + 1, converged, slow, finite)


def _chord(equations: Any, factors: Any, inertias: Array, tolerance: Any, start: _Iterate) -> _Iterate:
    """Corrections with one factorisation until they converge or shrink too slowly."""

    def go_on(it: _Iterate) -> Array:
        return ~it.converged & ~it.slow & it.finite & (it.count < CHORD_ITERATIONS)

    restart = eqx.tree_at(
        lambda it: (it.count, it.slow, it.correction),
        start,
        (jnp.array(0), jnp.array(False), jnp.zeros_like(start.correction)),
    )
    return jax.lax.while_loop(go_on, partial(_iterate, equations, factors, inertias, tolerance), restart)


def newton(equations: Any, tolerance: Float[Array, ""] | float, form: str) -> Solution:
    """Solve the equations of one step.

    Args:
        equations: a prepared step (`residual`, `guess`, `approximate`, `jacobian`).
        tolerance: see `TOLERANCE`.
        form: form of the equations, which decides the factorisation.

    Returns:
        The solution; its code is successful, max_iterations, diverged or nonfinite, never an exception.
    """
    factorise = FACTORISATIONS[form]
    guess = equations.guess()
    zero, no, nought = jnp.zeros((), guess.dtype), jnp.array(False), jnp.array(0)
    it = _Iterate(guess, zero, zero, nought, nought, no, no, jnp.array(True))
    cheap = equations.approximate()
    if cheap is not None:
        with jax.named_scope("chord"):
            it = _chord(equations, *factorise(equations, cheap), tolerance, it)
        lost = ~it.finite
        it = eqx.tree_at(lambda x: (x.y, x.finite), it, (jnp.where(lost, guess, it.y), jnp.array(True)))

    def refactor(carry: tuple[_Iterate, Array]) -> tuple[_Iterate, Array]:
        it, rounds = carry
        factors, inertias = factorise(equations, equations.jacobian(it.y))
        return _chord(equations, factors, inertias, tolerance, it), rounds + 1

    def unsolved(carry: tuple[_Iterate, Array]) -> Array:
        it, rounds = carry
        return ~it.converged & it.finite & (rounds < NEWTON_ROUNDS)

    with jax.named_scope("newton"):
        it, rounds = jax.lax.while_loop(unsolved, refactor, (it, nought))
    failed = jnp.where(it.finite, int(Result.MAX_ITERATIONS), int(Result.NONFINITE))
    code = jnp.where(it.converged, int(Result.SUCCESSFUL), failed)
    error = it.correction / jnp.where(it.size > 0, it.size, 1.0)
    return Solution(it.y, code, it.total, error)
