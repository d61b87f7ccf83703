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
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.transcription import Unknowns, held_inputs, roll
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled


class NonlinearProgram(NamedTuple):
    """Cost and constraints of an optimal control problem as functions of one vector x of size n.

    x holds the coefficients of the inputs, what is free in units of its first value, and the unknowns of the
    equations of all steps: those that `nc.optimise` solves for by its lifted form. States follow from them
    explicitly, so that joints hold at every x. Derivatives are exact and dense.

    Attributes:
        start: the first guess (n,).
        lower: of the constraints (c,).
        upper: of the constraints (c,): zero for every one; equations have lower bounds of zero, too.
        names: of the constraints.
        cost: x to the cost.
        gradient: x to its gradient (n,).
        constraints: x to the residuals of all steps [N, N m], the goal, and the excesses over bounds (c,).
        jacobian: x to their derivative (c, n).
        hessian: (x, weight, multipliers) to that of weight cost + multipliers constraints (n, n).
        inputs: x to the inputs of all steps (steps, inputs) [N, N m].
        free: x to the values of final time [s] and parameters by name.
        multipliers: those of the constraints (c,), as `nc.optimise` has them.
    """

    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    names: tuple[str, ...]
    cost: Callable[[Any], Float[Array, ""]]
    gradient: Callable[[Any], Float[Array, " n"]]
    constraints: Callable[[Any], Float[Array, " c"]]
    jacobian: Callable[[Any], Float[Array, "c n"]]
    hessian: Callable[[Any, Any, Any], Float[Array, "n n"]]
    inputs: Callable[[Any], Float[Array, "steps inputs"]]
    free: Callable[[Any], dict[str, float]]
    multipliers: Callable[[Any], Multipliers]


@checked(problem=PROBLEM, guess=GUESS)
def to_nlp(problem: OptimalControl, guess: Any = None) -> NonlinearProgram:
    """An optimal control problem for another solver of nonlinear programs.

    Args:
        problem: the problem.
        guess: as in `nc.optimise`.

    Returns:
        Functions of one vector, compiled, with exact derivatives.

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
    """
    problem = numeric(problem)
    return program_of(problem, unknowns_of(problem, guess, True))


def program_of(problem: OptimalControl, first: Unknowns) -> NonlinearProgram:
    """The program of a problem with all its numbers as arrays, from given unknowns."""
    start, unflat = ravel_pytree(first)
    path = roll(problem, first)
    equations = path.stages.residual.size + path.end.missing.size
    inequalities = path.stages.excess.size + path.end.excess.size
    system, steps = problem.system, range(problem.steps)
    names = [f"equation {k} of step {step}" for step in steps for k in range(path.stages.residual.shape[1])]
    names += problem.goal.labels(system)
    names += [f"{name}, step {step}" for step in steps for name in problem.path_labels]
    names += problem.end_labels
    # Momenta of short steps are small numbers beside goals and bounds: forces are not.
    short = jnp.repeat(1.0 / problem.lengths(jnp.zeros(len(problem.free))), path.stages.residual.shape[1])
    weights = jnp.ones(equations + inequalities).at[: short.size].set(short)

    def unknowns(x: Any) -> Unknowns:
        return unflat(jnp.asarray(x, float))

    def free(x: Any) -> dict[str, float]:
        return dict(zip(problem.free, np.asarray(problem.values(unknowns(x).free)).tolist()))

    def multipliers(values: Any) -> Multipliers:
        shapes = (path.stages.residual, path.end.missing, path.stages.excess, path.end.excess)
        ends = np.cumsum([x.size for x in shapes])
        parts = jnp.split(weights * jnp.asarray(values, float), ends[:-1])
        motion, goal, along, last = (part.reshape(x.shape) for part, x in zip(parts, shapes))
        return Multipliers(goal, along, last, motion)

    @functools.lru_cache(maxsize=1)
    def slopes(x: bytes) -> tuple[Array, Array]:
        return _first(problem, unknowns(np.frombuffer(x)), weights)

    def at(x: Any) -> tuple[Array, Array]:
        return slopes(np.ascontiguousarray(x, float).tobytes())

    return NonlinearProgram(
        np.asarray(start),
        np.concatenate([np.zeros(equations), np.full(inequalities, -np.inf)]),
        np.zeros(equations + inequalities),
        tuple(names),
        lambda x: _values(problem, unknowns(x), weights)[0],
        lambda x: at(x)[0],
        lambda x: _values(problem, unknowns(x), weights)[1],
        lambda x: at(x)[1],
        lambda x, weight, multipliers: _second(
            problem, unknowns(x), weights, jnp.asarray(weight, float), jnp.asarray(multipliers, float)
        ),
        lambda x: held_inputs(problem, unknowns(x).coefficients),
        free,
        multipliers,
    )


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
