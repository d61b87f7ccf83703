"""Derivatives of an optimum with respect to numbers of the problem, by the implicit function theorem."""

from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control import sequential
from natcoord_jax.control.costates import Multipliers, direct_slopes, scored_end, step_jacobians, through_step
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.linearisation import first_gradient
from natcoord_jax.control.newton import as_unknowns
from natcoord_jax.control.problem import OptimalControl, numeric
from natcoord_jax.control.proposal import formed, unshifted
from natcoord_jax.control.riccati import Right, Weighted, solve
from natcoord_jax.control.run import DEFAULT, OPTIONS, optimise_jit
from natcoord_jax.control.transcription import (
    Unknowns,
    corrected,
    each_step,
    entering,
    enters_in,
    slices,
)
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import at_top_level
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FunctionOf, of

START = of("an iterate, as the `iterate` of a solution, or its `unknowns`", Unknowns, Iterate)

ROUNDS = 3
"""Solutions of the quadratic model, each of which takes some seven digits off what is left."""


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


class Conditions(eqx.Module):
    """What vanishes or is balanced at an optimum, and its cost."""

    first: Float[Array, " f"]
    w: Float[Array, "steps m"]
    missing: Float[Array, " c"]
    excess: Float[Array, "steps h"]
    end_excess: Float[Array, " e"]
    cost: Float[Array, ""]


def _conditions(
    problem: OptimalControl, unknowns: Unknowns, multipliers: Multipliers, inverses: Array
) -> Conditions:
    """Gradient of the Lagrangian by costates, and goal, bounds of steps and bounds of what is free."""
    # One Newton correction with a given Jacobian changes nothing at a motion, and has the derivatives of the
    # solution: of the motion and its unknowns as functions of inputs and of what is free.
    path, unknowns = corrected(problem, unknowns, inverses)
    jacobians = step_jacobians(problem, path, unknowns)
    before, last = (jax.tree.map(itemgetter(s), path.nodes) for s in (slice(None, -1), -1))
    worth = ravel_pytree(jax.grad(lambda node: scored_end(problem, multipliers, node))(last))[0]

    def body(after: Array, given: tuple) -> tuple[Array, Array]:
        at, node, w, y, jacobian, (by_node, by_w, by_y) = given
        worth, through_w, _ = through_step(problem, at, node, w, y, jacobian)(after, by_y)
        return worth + by_node, through_w + by_w

    w = entering(problem, unknowns.coefficients)
    each = (slices(problem), before, w, unknowns.y)
    slopes = each_step(problem, partial(direct_slopes, problem), *each, multipliers.path)
    given = (*each, jacobians, slopes)
    worth, by_w = jax.lax.scan(body, worth, given, reverse=True)
    by_first = first_gradient(problem, unknowns, worth)
    by_w = jnp.where(enters_in(problem), by_w, 0.0)
    return Conditions(by_first, by_w, path.end.missing, path.stages.excess, path.end.excess, path.cost)


@compiled
def _jacobian(make: Callable[[Any], OptimalControl], numbers: Any, found: Iterate) -> Float[Array, "o p"]:
    """How coefficients, what is free and the cost change with the numbers, one column each.

    The model of the optimum solves its linearised conditions, linear in the number of steps; what it leaves
    of the exact ones is solved for again.
    """
    given, unflat = ravel_pytree(numbers)
    problem, m, s = make(numbers), found.multipliers, found.slacks
    inverses = found.derivatives.jacobians.inverses
    quadratic = formed(problem, found)
    nothing = jax.tree.map(jnp.zeros_like, (m.path, m.end))
    bounds = Weighted(m.path / s.path, nothing[0], m.end / s.end, nothing[1])
    factors = unshifted(problem, found, quadratic, bounds)

    def conditions(number: Array, point: tuple) -> Conditions:
        coefficients, free, *multipliers = point
        unknowns = Unknowns(coefficients, free, found.unknowns.y)
        return _conditions(make(unflat(number)), unknowns, Multipliers(*multipliers), inverses)

    def correction(left: Conditions, change: tuple) -> tuple:
        # A bound acts as far as it presses: sigma (h + s) = 0 linearised.
        path, end = bounds.path * left.excess - change[3], bounds.end * left.end_excess - change[4]
        gradient = jnp.pad(left.w, ((0, 0), (quadratic.forward.shape[1], 0)))
        gradient = gradient + jnp.einsum("khz,kh->kz", quadratic.excess, path)
        last = quadratic.last_excess.T @ end + quadratic.goal.T @ (factors.penalty * left.missing)
        move = solve(factors, Right(gradient, last, left.first, left.missing))
        moved, both = as_unknowns(problem, found, move), jnp.concatenate([move.z[:-1], move.w], axis=1)
        path = path + bounds.path * jnp.einsum("khz,kz->kh", quadratic.excess, both)
        end = end + bounds.end * (quadratic.last_excess @ move.z[-1])
        return moved.coefficients, moved.free, move.goal, path, end

    point = (found.unknowns.coefficients, found.unknowns.free, m.goal, m.path, m.end)

    def one(direction: Array) -> Array:
        def left(change: tuple) -> Conditions:
            return jax.jvp(conditions, (given, point), (direction, change))[1]

        def again(_: Any, change: tuple) -> tuple:
            return jax.tree.map(jnp.add, change, correction(left(change), change))

        change = jax.lax.fori_loop(0, ROUNDS, again, jax.tree.map(jnp.zeros_like, point))
        return jnp.concatenate([ravel_pytree(change[:2])[0], left(change).cost[None]])

    return jax.lax.map(one, jnp.eye(given.size)).T


@checked(make=FunctionOf("(numbers) -> problem"), guess=START, options=OPTIONS)
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
        found = _solved(numeric(make(numbers)), start, options)
        failed = found.code != 0
        value = Optimum(found.unknowns.coefficients, found.unknowns.free, found.path.cost)
        return jax.tree.map(lambda x: jnp.where(failed, jnp.nan, x), value), found

    @jax.custom_jvp
    def function(numbers: Any) -> Optimum:
        return solved(numbers)[0]

    @function.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Optimum, Optimum]:
        value, found = solved(*primals)
        changes = _jacobian(make, primals[0], found) @ ravel_pytree(tangents[0])[0]
        return value, ravel_pytree(value)[1](changes)

    return function


def _solved(problem: OptimalControl, start: Unknowns, options: Options) -> Iterate:
    """The last iterate; outside of other programs by those that `nc.optimise` has compiled."""
    if not at_top_level(eqx.filter((problem, start), eqx.is_array)):
        return optimise_jit(problem, start, options)
    iterate = sequential.init(problem, options, start)
    while not sequential.done(iterate):
        iterate = sequential.step(problem, options, iterate)
    return iterate
