"""Newton's iteration to the round-off floor, in while loops.

One factorisation serves, over many steps, as long as the corrections shrink quickly; then the Jacobian is
formed anew. Rates along body axes make it change little. The loop that forms Jacobians makes no trip in the
usual case, which costs nothing; under vmap all lanes form theirs together when one needs to.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.results import Result
from natcoord_jax.stepping.factorise import FACTORISATIONS

TOLERANCE = 1e-15
"""Predicted error after the last correction, relative to the terms of the equations (energy norm)."""

STALL = 1e4
"""Corrections that stop shrinking below STALL * tolerance have reached the floor of round-off."""

STALL_OLD = 20.0
"""The same with factors of an earlier step, where a stall may be the factors' fault."""

CHORD_ITERATIONS = 10
"""Corrections with one factorisation."""

NEWTON_ROUNDS = 25
"""Factorisations of exact Jacobians."""

SLOWEST_UNSEEN = 0.02
"""Contraction assumed at least: a slow part of the error may hide behind fast ones in the first ratio."""

PATIENCE = 6
"""Corrections that are cheaper than a new Jacobian."""


@jax.custom_batching.custom_vmap
def any_lane(x: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether it holds in any lane of a vmap: keeps the condition of a loop the same for all lanes.

    A loop whose condition differs between lanes would copy all that it carries, in every trip.
    """
    return x


@any_lane.def_vmap
def _any_lane_rule(axis_size: int, in_batched: list[bool], x: Array) -> tuple[Array, bool]:
    return any_lane(jnp.any(x, axis=0)), False


class Solution(eqx.Module):
    """Outcome of the iteration.

    Attributes:
        y: unknowns.
        code: result code.
        iterations: evaluations of the residual.
        error: size of the last correction relative to the terms of the equations.
        worst: unknown with the largest last correction.
        warm: the start of the next step.
    """

    y: Float[Array, " unknowns"]
    code: Int[Array, ""]
    iterations: Int[Array, ""]
    error: Float[Array, ""]
    worst: Int[Array, ""]
    warm: Any


class _Iterate(eqx.Module):
    y: Array
    worst: Array
    correction: Array
    size: Array
    count: Array
    total: Array
    converged: Array
    slow: Array
    finite: Array


def _iterate(
    equations: Any, factors: Any, inertias: Array, tolerance: Any, floor: Any, it: _Iterate
) -> _Iterate:
    """One correction with given factors; a correction that shrinks too slowly is not applied."""
    residual, size = equations.residual(it.y)
    change = factors.solve(residual)
    correction = jnp.sqrt(jnp.sum(inertias * change**2))
    ratio = correction / jnp.where(it.correction > 0, it.correction, 1.0)
    first = it.count == 0
    trusted = jnp.maximum(ratio, SLOWEST_UNSEEN)
    predicted = correction * jnp.where(first, 1.0, trusted / jnp.maximum(1.0 - trusted, 1e-3))
    small = predicted <= tolerance * size
    stalled = ~first & (ratio > 0.5) & (correction <= floor * tolerance * size)
    finite = jnp.isfinite(correction) & jnp.isfinite(size)
    converged = (small | stalled) & finite
    slow = ~first & ~converged & ((ratio > 0.5) | (correction * ratio**PATIENCE > tolerance * size))
    y = jnp.where(finite & ~slow, it.y - change, it.y)
    worst = jnp.argmax(inertias * change**2)
    return _Iterate(y, worst, correction, size, it.count + 1, it.total + 1, converged, slow, finite)


def _chord(
    equations: Any, factors: Any, inertias: Array, tolerance: Any, floor: Any, start: _Iterate
) -> _Iterate:
    """Corrections with one factorisation until they converge or shrink too slowly."""

    def go_on(it: _Iterate) -> Array:
        return ~it.converged & ~it.slow & it.finite & (it.count < CHORD_ITERATIONS)

    again = (jnp.array(0), jnp.zeros_like(start.correction), start.converged)
    restart = eqx.tree_at(lambda it: (it.count, it.correction, it.slow), start, again)
    correct = partial(_iterate, equations, factors, inertias, tolerance, floor)
    return jax.lax.while_loop(go_on, correct, restart)


class Warm(eqx.Module):
    """What one step leaves to the next: where to start, and factors that may still serve.

    Attributes:
        y: guess of the unknowns.
        factors: factors of an earlier Jacobian.
        inertias: inertias of the unknowns that came with them.
        valid: whether the factors are any good.
    """

    y: Float[Array, " unknowns"]
    factors: Any
    inertias: Float[Array, " unknowns"]
    valid: Bool[Array, ""]


def cold(equations: Any, form: str) -> Warm:
    """A start without factors."""
    y = equations.guess()
    shapes = jax.eval_shape(lambda y: FACTORISATIONS[form](equations, equations.jacobian(y)), y)
    factors, inertias = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return Warm(y, factors, inertias, jnp.array(False))


def newton(equations: Any, tolerance: Float[Array, ""] | float, form: str, warm: Warm) -> Solution:
    """Solve the equations of one step.

    Args:
        equations: a prepared step (`residual`, `guess`, `jacobian`).
        tolerance: see `TOLERANCE`.
        form: form of the equations, which decides the factorisation.
        warm: where to start.

    Returns:
        The solution; its code is successful, max_iterations or nonfinite, never an exception.
    """
    zero, no, nought = jnp.zeros((), warm.y.dtype), jnp.array(False), jnp.array(0)
    start = _Iterate(warm.y, nought, zero, zero, nought, nought, no, no, jnp.array(True))

    def fresh(it: _Iterate, factors: Any, inertias: Array) -> tuple[Any, Array]:
        return FACTORISATIONS[form](equations, equations.jacobian(it.y))

    def kept(it: _Iterate, factors: Any, inertias: Array) -> tuple[Any, Array]:
        return factors, inertias

    def round_of_corrections(carry: tuple) -> tuple:
        it, factors, inertias, rounds = carry
        needed = any_lane(~it.converged & ((rounds > 0) | ~warm.valid))
        factors, inertias = jax.lax.cond(needed, fresh, kept, it, factors, inertias)
        floor = jnp.where(needed, STALL, STALL_OLD)
        after = _chord(equations, factors, inertias, tolerance, floor, it)
        lost = ~after.finite & (rounds == 0) & ~needed
        after = eqx.tree_at(
            lambda x: (x.y, x.finite), after, (jnp.where(lost, warm.y, after.y), after.finite | lost)
        )
        return after, factors, inertias, rounds + 1

    def unsolved(carry: tuple) -> Array:
        it, _, _, rounds = carry
        return any_lane(~it.converged & it.finite) & (rounds < NEWTON_ROUNDS)

    with jax.named_scope("newton"):
        carry = (start, warm.factors, warm.inertias, nought)
        it, factors, inertias, _ = jax.lax.while_loop(unsolved, round_of_corrections, carry)
    failed = jnp.where(it.finite, int(Result.MAX_ITERATIONS), int(Result.NONFINITE))
    code = jnp.where(it.converged, int(Result.SUCCESSFUL), failed)
    error = it.correction / jnp.where(it.size > 0, it.size, 1.0)
    left = Warm(it.y, factors, inertias, it.converged)
    return Solution(it.y, code, it.total, error, it.worst, left)
