"""The derivative of a rollout, made slowly and simply, for comparison.

The same discrete motion: substeps and solutions are those recorded. Every slot's equations are solved once
more by Newton's iteration with their whole Jacobian, formed by automatic differentiation and decomposed, and
the last corrections are differentiated as they stand. Nothing is carried from slot to slot but the state,
and every mode of JAX goes through. What a correction with a constant exact Jacobian leaves of an error is of
the second order, so `corrections` of them give as many derivatives exactly. Of the engine it needs, by
`hunting_protocol`, what one slot solves: (system, state, inputs, length, unknowns) -> (residual, next state).
"""

from typing import Any

import jax
import jax.numpy as jnp
from hunting_protocol import Plan, Slots, contacts, inputs_of, outcome
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

import natcoord_jax as nc

POLISH = 2
"""Corrections before those that are differentiated: recorded solutions are good to round-off already."""

DEPENDENT = 1e-10
"""Singular values below this part of the largest, after scaling, are of dependent constraints, and of open
contacts."""


def solution(matrix: Array, right: Array, redundant: bool) -> Array:
    """Of a linear system; with dependent rows the smallest one, rows and columns scaled before."""
    if not redundant:
        return jnp.linalg.solve(matrix, right)
    rows = jnp.max(jnp.abs(matrix), axis=1)
    scaled = matrix / rows[:, None]
    columns = jnp.max(jnp.abs(scaled), axis=0)
    return jnp.linalg.pinv(scaled / columns, rtol=DEPENDENT) @ (right / rows) / columns


def states(
    plan: Plan,
    slots: Slots,
    numbers: tuple[nc.System, nc.State, Any, Array],
    *,
    corrections: int = 2,
) -> tuple[nc.State, Array]:
    """States after all slots, and the largest change of a state by what is solved anew.

    Args:
        plan: of the rollout.
        slots: recorded, from the same numbers.
        numbers: system, first state, inputs (or a policy) and dt; all that is differentiated.
        corrections: that are differentiated.
    """
    system, first, parameters, dt = numbers
    redundant = system.structure.rank is not None or bool(contacts(system))
    slots = jax.tree.map(jax.lax.stop_gradient, slots)
    _, unravel = ravel_pytree(first)

    def slot(state: nc.State, recorded: Slots) -> tuple:
        u, h = inputs_of(plan, parameters, state, recorded), recorded.fraction * dt
        y = jnp.where(recorded.accepted, recorded.y, 0.0)

        at = plan, system, state, u, h
        constant = plan, *jax.lax.stop_gradient((system, state, u, h))

        def residual(y: Array) -> tuple[Array, Array]:
            residuals = outcome(*constant, y)[0]
            return residuals, residuals

        def polished(_: int, carry: tuple) -> tuple:
            matrix, residuals = jax.jacfwd(residual, has_aux=True)(carry[0])
            return carry[0] - solution(matrix, residuals, redundant), matrix

        start = y, jnp.zeros((y.size, y.size))
        y, matrix = jax.lax.stop_gradient(jax.lax.fori_loop(0, POLISH, polished, start))

        def corrected(y: Array, _: None) -> tuple[Array, None]:
            return y - solution(matrix, outcome(*at, y)[0], redundant), None

        y, _ = jax.lax.scan(corrected, y, None, length=corrections)
        end, _ = ravel_pytree(outcome(*at, y)[1])
        # Linearised where the recorded motion is: errors of the two do not grow apart.
        motion, _ = ravel_pytree(recorded.states)
        apart = jnp.max(jnp.abs(end - motion) / (1.0 + jnp.abs(motion)))
        end = motion + (end - jax.lax.stop_gradient(end))
        end = jnp.where(recorded.accepted, end, ravel_pytree(state)[0])
        return unravel(end), (unravel(end), jnp.where(recorded.accepted, apart, 0.0))

    _, (after, apart) = jax.lax.scan(slot, first, slots)
    return after, jnp.max(apart)
