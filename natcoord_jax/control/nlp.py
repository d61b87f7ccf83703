"""The discrete problem as a nonlinear program in one vector, for solvers of others."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.guess import GUESS, unknowns_of
from natcoord_jax.control.pieces import first_derivatives, second_derivatives, values
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.simultaneous import simultaneous
from natcoord_jax.control.transcription import Unknowns, held_inputs, roll
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG


class NonlinearProgram(NamedTuple):
    """Cost and constraints of an optimal control problem as functions of one vector x of size n.

    x holds the coefficients of the inputs, what is free in units of its first value, and the unknowns of the
    equations of all steps: those that `nc.optimise` solves for by its lifted form. States follow from them
    explicitly, so that joints hold at every x. With `states` they are unknowns as well, and that each leads
    to the next is a condition. Derivatives are exact.

    Attributes:
        start: the first guess (n,).
        lower: of the constraints (c,).
        upper: of the constraints (c,): zero for every one; equations have lower bounds of zero, too.
        names: of the constraints.
        cost: x to the cost.
        gradient: x to its gradient (n,).
        constraints: x to the residuals of all steps [N, N m], the goal, and the excesses over bounds (c,).
        jacobian: x to their derivative (c, n); with states to its entries (j,), see `jacobian_structure`.
        hessian: (x, weight, multipliers) to that of weight cost + multipliers constraints (n, n); with states
            to the entries of its lower triangle (h,), see `hessian_structure`.
        inputs: x to the inputs of all steps (steps, inputs) [N, N m].
        free: x to the values of final time [s] and parameters by name.
        multipliers: those of the constraints (c,), as `nc.optimise` has them.
        unknowns: x to coefficients, what is free and unknowns of the steps, as `nc.optimise_jit` starts from.
        jacobian_structure: rows and columns of its entries (j,), each place once; None: all.
        hessian_structure: the same of the lower triangle (h,); None: all of the whole matrix.
    """

    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    names: tuple[str, ...]
    cost: Callable[[Any], Float[Array, ""]]
    gradient: Callable[[Any], Float[Array, " n"]]
    constraints: Callable[[Any], Float[Array, " c"]]
    jacobian: Callable[[Any], Float[Array, "c n"] | Float[Array, " j"]]
    hessian: Callable[[Any, Any, Any], Float[Array, "n n"] | Float[Array, " h"]]
    inputs: Callable[[Any], Float[Array, "steps inputs"]]
    free: Callable[[Any], dict[str, float]]
    multipliers: Callable[[Any], Multipliers]
    unknowns: Callable[[Any], Unknowns]
    jacobian_structure: tuple[np.ndarray, np.ndarray] | None = None
    hessian_structure: tuple[np.ndarray, np.ndarray] | None = None


@checked(problem=PROBLEM, guess=GUESS, states=FLAG)
def to_nlp(problem: OptimalControl, guess: Any = None, *, states: bool = False) -> NonlinearProgram:
    """An optimal control problem for another solver of nonlinear programs.

    Args:
        problem: the problem.
        guess: as in `nc.optimise`.
        states: whether the states between the steps, and all that one step hands to the next, are unknowns
            as well (direct multiple shooting, the simultaneous approach). Jacobian and Hessian are then
            sparse, banded over the steps but for columns of what is free, and are given by their entries,
            in time and memory linear in the steps. Without, they are full matrices of fewer unknowns.

    Returns:
        Functions of one vector, compiled, with exact derivatives. Multipliers of goal, bounds and equations
        of the steps are the same in both forms.

    Raises:
        ValueError: for a guess of the wrong shape.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> from natcoord_jax.gallery import manoeuvres
        >>> problem = manoeuvres.beanie(4)
        >>> program = nc.to_nlp(problem)
        >>> program.jacobian(program.start).shape == (program.lower.size, program.start.size)
        True
        >>> sparse = nc.to_nlp(problem, states=True)
        >>> rows, columns = sparse.jacobian_structure
        >>> sparse.jacobian(sparse.start).shape == rows.shape == columns.shape
        True
    """
    problem = numeric(problem)
    first = unknowns_of(problem, guess, True)
    return program_with_states(problem, first) if states else program_of(problem, first)


def program_with_states(problem: OptimalControl, first: Unknowns) -> NonlinearProgram:
    """The sparse program of a problem with all its numbers as arrays, from given unknowns."""
    path = motion_of(problem, first)
    form = simultaneous(problem, first, path)
    pieces, weights = form.pieces, form.weights

    def first_of(x: Array) -> tuple[Array, Array]:
        return first_derivatives(pieces, problem, x, weights)

    def second_of(x: Array, weight: Array, multipliers: Array) -> Array:
        return second_derivatives(pieces, problem, x, weights, weight, multipliers)

    program = _program(
        problem,
        np.asarray(form.start(first, path)),
        (form.names(problem), form.bounds),
        (lambda x: values(pieces, problem, x, weights), first_of, second_of),
        (form.unknowns, form.multipliers),
    )
    structures = ((entries.rows, entries.columns) for entries in (pieces.jacobian, pieces.hessian))
    return program._replace(**dict(zip(("jacobian_structure", "hessian_structure"), structures)))


def program_of(problem: OptimalControl, first: Unknowns) -> NonlinearProgram:
    """The program of a problem with all its numbers as arrays, from given unknowns."""
    start, unflat = ravel_pytree(first)
    path = motion_of(problem, first)
    shapes = (path.stages.residual, path.end.missing, path.stages.excess, path.end.excess)
    ends = np.cumsum([x.size for x in shapes])
    steps = range(problem.steps)
    names = [f"equation {k} of step {step}" for step in steps for k in range(path.stages.residual.shape[1])]
    names += problem.goal_labels
    names += [f"{name}, step {step}" for step in steps for name in problem.path_labels]
    names += problem.end_labels
    # Momenta of short steps are small numbers beside goals and bounds: forces are not.
    short = jnp.repeat(1.0 / problem.lengths(jnp.zeros(len(problem.free))), path.stages.residual.shape[1])
    weights = jnp.ones(ends[-1]).at[: short.size].set(short)

    def multipliers(values: Any) -> Multipliers:
        parts = jnp.split(weights * jnp.asarray(values, float), ends[:-1])
        motion, goal, along, last = (part.reshape(x.shape) for part, x in zip(parts, shapes))
        return Multipliers(goal, along, last, motion)

    def second_of(x: Array, weight: Array, multipliers: Array) -> Array:
        return _second(problem, unflat(x), weights, weight, multipliers)

    return _program(
        problem,
        np.asarray(start),
        (tuple(names), np.arange(ends[-1]) >= ends[1]),
        (
            lambda x: _values(problem, unflat(x), weights),
            lambda x: _first(problem, unflat(x), weights),
            second_of,
        ),
        (lambda x: unflat(jnp.asarray(x, float)), multipliers),
    )


def _program(
    problem: OptimalControl,
    start: np.ndarray,
    constraints: tuple[tuple[str, ...], np.ndarray],
    functions: tuple[Callable, Callable, Callable],
    back: tuple[Callable, Callable],
) -> NonlinearProgram:
    """What both forms have in common.

    Args:
        problem: the problem.
        start: first vector.
        constraints: their names, and which of them are inequalities.
        functions: values, first and second derivatives of one vector.
        back: unknowns and multipliers from vectors.
    """
    (names, bounded), (values, first, second), (unknowns, multipliers) = constraints, functions, back

    def seldom(function: Callable) -> Callable:
        """One value is kept: solvers ask for each part of it alone."""
        known = functools.lru_cache(maxsize=1)(lambda x: function(jnp.asarray(np.frombuffer(x))))
        return lambda x: known(np.ascontiguousarray(x, float).tobytes())

    def free(x: Any) -> dict[str, float]:
        return dict(zip(problem.free, np.asarray(problem.values(unknowns(x).free)).tolist()))

    values, first = seldom(values), seldom(first)
    return NonlinearProgram(
        start,
        np.where(bounded, -np.inf, 0.0),
        np.zeros(bounded.size),
        names,
        lambda x: values(x)[0],
        lambda x: first(x)[0],
        lambda x: values(x)[1],
        lambda x: first(x)[1],
        lambda x, weight, multipliers: second(*(jnp.asarray(a, float) for a in (x, weight, multipliers))),
        lambda x: held_inputs(problem, unknowns(x).coefficients),
        free,
        multipliers,
        unknowns,
    )


motion_of = compiled(roll)


def _both(problem: OptimalControl, unknowns: Unknowns, weights: Array) -> tuple[Array, Array]:
    path = roll(problem, unknowns)
    parts = (path.stages.residual, path.end.missing, path.stages.excess, path.end.excess)
    return path.cost, weights * jnp.concatenate([part.reshape(-1) for part in parts])


_values = compiled(_both)


@compiled
def _first(problem: OptimalControl, unknowns: Unknowns, weights: Array) -> tuple[Array, Array]:
    x, unflat = ravel_pytree(unknowns)
    return jax.jacfwd(lambda x: _both(problem, unflat(x), weights))(x)


@compiled
def _second(
    problem: OptimalControl, unknowns: Unknowns, weights: Array, weight: Array, multipliers: Array
) -> Array:
    x, unflat = ravel_pytree(unknowns)

    def lagrangian(x: Array) -> Array:
        cost, constraints = _both(problem, unflat(x), weights)
        return weight * cost + multipliers @ constraints

    return jax.jacfwd(jax.grad(lagrangian))(x)
