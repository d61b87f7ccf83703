"""Derivatives of an optimum with respect to numbers of the problem, by the implicit function theorem."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.run import DEFAULT, optimise_jit
from natcoord_jax.control.transcription import Unknowns, roll, simulated

CUT = 1e-12
"""Singular values of the conditions of optimality below this fraction of the largest are left out."""


class Optimum(eqx.Module):
    """An optimum as a function of numbers of the problem.

    Attributes:
        coefficients: of the inputs.
        free: changes of final time and parameters, in units of their scale.
        cost: whole cost.
    """

    coefficients: Float[Array, "c m"]
    free: Float[Array, " p"]
    cost: Float[Array, ""]


def _motion(problem: OptimalControl, variables: Any, like: Unknowns) -> Any:
    coefficients, free = variables
    unknowns, _, _ = simulated(problem, Unknowns(coefficients, free, like.y))
    return roll(problem, unknowns)


def _conditions(
    problem: OptimalControl, variables: Any, multipliers: Any, like: Unknowns
) -> tuple[Array, Array]:
    """Gradient of the Lagrangian, and all constraints (goal, bounds of steps and of what is free)."""

    def lagrangian(variables: Any) -> tuple[Array, Array]:
        path = _motion(problem, variables, like)
        found = (path.end.missing, path.stages.excess, path.end.excess)
        flat = jnp.concatenate([x.reshape(-1) for x in found])
        nu = jnp.concatenate([x.reshape(-1) for x in multipliers])
        return path.cost + nu @ flat, flat

    gradient, constraints = jax.grad(lagrangian, has_aux=True)(variables)
    return ravel_pytree(gradient)[0], constraints


def optimum(
    make: Callable[[Any], OptimalControl], guess: Unknowns | Iterate, options: Options = DEFAULT
) -> Callable[[Any], Optimum]:
    """The optimum as a differentiable function of the numbers that make the problem.

    The function solves the problem; its first derivatives, forward and reverse, follow from the conditions of
    optimality (implicit function theorem) with the exact second derivatives of the discrete motion, so that
    what is optimised on top of it (a mass, a stiffness, a place) sees how the best inputs change.

    Args:
        make: numbers (an array or a pytree of arrays) -> problem; must be traceable.
        guess: where to start, for example `solution.iterate`.
        options: settings of the method.

    Returns:
        A function of the numbers, for `jax.grad`, `jax.jvp` and `jax.jit`; all NaN where the method fails.

    Example:
        See `tests/test_control.py`, where the mass of an arm is a number of the problem.
    """
    start = guess.unknowns if isinstance(guess, Iterate) else guess

    def solved(numbers: Any) -> tuple[Optimum, Iterate]:
        found = optimise_jit(make(numbers), start, options)
        failed = found.code != 0
        value = Optimum(found.unknowns.coefficients, found.unknowns.free, found.path.cost)
        return jax.tree.map(lambda x: jnp.where(failed, jnp.nan, x), value), found

    @jax.custom_jvp
    def function(numbers: Any) -> Optimum:
        return solved(numbers)[0]

    @function.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Optimum, Optimum]:
        value, found = solved(*primals)
        variables = (found.unknowns.coefficients, found.unknowns.free)
        flat, unflat = ravel_pytree(variables)
        m, s = found.multipliers, found.slacks
        multipliers = (m.goal, m.path, m.end)

        def conditions(numbers: Any, flat: Array) -> tuple[Array, Array]:
            return _conditions(make(numbers), unflat(flat), multipliers, found.unknowns)

        by_numbers = jax.jvp(lambda n: conditions(n, flat), primals, tangents)[1]
        columns = jax.lax.map(
            lambda d: jax.jvp(lambda x: conditions(primals[0], x), (flat,), (d,))[1], jnp.eye(flat.size)
        )
        hessian, jacobian = columns[0], columns[1].T
        # A bound acts as far as it presses: sigma (h + s) = 0 linearised.
        room = jnp.concatenate([jnp.zeros(m.goal.size), s.path.reshape(-1), s.end])
        press = jnp.concatenate([jnp.ones(m.goal.size), m.path.reshape(-1), m.end])
        matrix = jnp.block([[hessian, jacobian.T], [press[:, None] * jacobian, -jnp.diag(room)]])
        right = -jnp.concatenate([by_numbers[0], press * by_numbers[1]])
        scale = jnp.sqrt(jnp.maximum(jnp.max(jnp.abs(matrix), axis=1), 1e-300))
        scaled = matrix / scale[:, None] / scale[None, :]
        moved = jnp.linalg.lstsq(scaled, right / scale, rcond=CUT)[0] / scale
        change = unflat(moved[: flat.size])

        def cost(numbers: Any, flat: Array) -> Array:
            return _motion(make(numbers), unflat(flat), found.unknowns).cost

        point, direction = (primals[0], flat), (tangents[0], moved[: flat.size])
        by_cost = jax.jvp(cost, point, direction)[1]
        return value, Optimum(change[0], change[1], by_cost)

    return function
