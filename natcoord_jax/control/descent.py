"""First-order optimisation by single shooting, with the optimisers of optax."""

import sys
import time
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from natcoord_jax.control.attempts import HEADER, printed
from natcoord_jax.control.guess import GUESS, unknowns_of
from natcoord_jax.control.iterate import largest
from natcoord_jax.control.motion import motion
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.solution import Row, Solution
from natcoord_jax.control.transcription import Unknowns, followed, held_inputs
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG, Concrete, Kind, is_other
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.xla.waiting import Stopwatch


class Optimiser(Kind):
    """A gradient transformation of optax, which is not imported for this."""

    wanted = "an optax gradient transformation, as optax.adam(0.05)"

    def complaint(self, value: Any) -> str | None:
        """Whether it has what makes one."""
        return None if getattr(value, "_fields", None) == ("init", "update") else is_other(value)


@compiled
def _constraints(
    problem: OptimalControl, variables: tuple[Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Cost, residual of the goal, excesses, and the result code of the simulation."""
    coefficients, free = variables
    inputs = held_inputs(problem, coefficients)
    trajectory = motion(problem, free, inputs, throw=False)
    costs, excess, found = followed(problem, free, trajectory.states, inputs)
    cost = jnp.sum(costs) + found.cost
    return cost, found.missing, jnp.concatenate([excess.reshape(-1), found.excess]), trajectory.result


def _augmented(variables: tuple[Array, Array], problem: OptimalControl, multipliers: tuple, penalty: Array):
    """Augmented Lagrangian of goal and bounds."""
    cost, missing, excess, code = _constraints(problem, variables)
    nu, sigma = multipliers
    equal = nu @ missing + 0.5 * penalty * jnp.sum(missing**2)
    pressed = jnp.maximum(0.0, sigma + penalty * excess)
    bound = 0.5 / penalty * jnp.sum(pressed**2 - sigma**2)
    return cost + equal + bound, (cost, missing, excess, code)


@checked()
def descend(
    problem: Annotated[OptimalControl, Concrete(PROBLEM)],
    guess: Annotated[Any, GUESS] = None,
    *,
    optimiser: Annotated[Any, Optimiser()] = None,
    iterations: Annotated[int, Whole(1)] = 500,
    rounds: Annotated[int, Whole(1)] = 6,
    penalty: Annotated[float, Number("positive")] = 10.0,
    growth: Annotated[float, Number("positive")] = 4.0,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-4,
    progress: Annotated[bool, FLAG] = True,
    time_limit: Annotated[float, Concrete(Number("not negative", infinite=True))] = 600.0,
) -> Solution:
    """Single shooting with a first-order optimiser, for any smooth loss.

    Goals and bounds, if there are any, enter by an augmented Lagrangian; the cost may be any smooth function
    (`nc.cost.Running`, `nc.cost.Terminal`). For precise solutions see `optimise`.

    Args:
        problem: the problem.
        guess: inputs (steps, inputs), a `Guess`, or None.
        optimiser: an optax gradient transformation; default Adam with a learning rate of 0.05 that decays.
        iterations: in each round.
        rounds: updates of the multipliers; one if there is neither goal nor bound.
        penalty: first weight of squared violations.
        growth: factor on it from round to round.
        tol: violation of goal and bounds at which it ends.
        progress: print a line for each round to stderr.
        time_limit: limit of time [s], checked after each round; compiling does not count.

    Returns:
        The solution; `outcome` is MAX_ITERATIONS if goal or bounds are violated by more than `tol`.

    Raises:
        ValueError: for a guess of the wrong shape, for phases with systems of their own, and for motions of
            an order above two.
    """
    import optax

    if problem.later:
        raise ValueError(
            f"descend goes along the motion of one system, and this problem has {len(problem.systems)}; use "
            "nc.optimise"
        )
    if problem.stages > 1:
        raise ValueError(
            f"descend takes motions of order two, and this problem has order {problem.scheme.order}; use "
            "nc.optimise"
        )
    problem = numeric(problem)
    start = unknowns_of(problem, guess, False)
    variables = (start.coefficients, start.free)
    if optimiser is None:
        optimiser = optax.adam(optax.cosine_decay_schedule(0.05, iterations, alpha=0.01))
    cost, missing, excess, code = _constraints(problem, variables)
    multipliers = (jnp.zeros_like(missing), jnp.zeros_like(excess))
    constrained = bool(missing.size or excess.size)

    @compiled
    def one_round(variables: Any, multipliers: Any, penalty: Array) -> Any:
        def body(carry: tuple, _: Any) -> tuple:
            variables, memory = carry
            slope = jax.grad(_augmented, has_aux=True)(variables, problem, multipliers, penalty)[0]
            change, updated = optimiser.update(slope, memory, variables)
            moved = optax.apply_updates(variables, change), updated
            # Where there is no slope it ends, with what was reached.
            sound = jnp.all(jnp.isfinite(ravel_pytree(slope)[0]))
            return jax.tree.map(partial(jnp.where, sound), moved, carry), None

        (variables, _), _ = jax.lax.scan(body, (variables, optimiser.init(variables)), None, iterations)
        slope, found = jax.grad(_augmented, has_aux=True)(variables, problem, multipliers, penalty)
        return variables, slope, found

    began, watch, history, outcome = time.perf_counter(), Stopwatch(), [], Outcome.MAX_ITERATIONS
    if progress:
        print(HEADER, file=sys.stderr)
    for k in range(rounds if constrained else 1):
        variables, slope, (cost, missing, excess, code) = one_round(
            variables, multipliers, jnp.asarray(penalty)
        )
        nu, sigma = multipliers
        multipliers = (nu + penalty * missing, jnp.maximum(0.0, sigma + penalty * excess))
        violation = jnp.max(jnp.concatenate([jnp.zeros(1), jnp.abs(missing), excess]))
        size = float(largest(*slope))
        row = Row((k + 1) * iterations, float(cost), size, float(violation), "", 1.0, 0, 0.0)
        row = row._replace(seconds=time.perf_counter() - began)
        history.append(row)
        if progress:
            print(printed(row), file=sys.stderr, flush=True)
        penalty = growth * penalty
        if not np.isfinite(float(cost) + size) or int(code) != 0:
            outcome = Outcome.SIMULATION_FAILED if int(code) else Outcome.NONFINITE
            break
        if constrained and violation <= tol or not constrained:
            outcome = Outcome.OPTIMAL if constrained else Outcome.MAX_ITERATIONS
            break
        if watch.seconds > time_limit:
            outcome = Outcome.TIME_LIMIT
            break
    unknowns = Unknowns(variables[0], variables[1], start.y)
    free = dict(zip(problem.free, jnp.asarray(problem.values(unknowns.free)).tolist()))
    dt = float(problem.applied(unknowns.free)[1])
    inputs = held_inputs(problem, unknowns.coefficients)
    method = "first-order descent (optax)"
    return Solution(problem, inputs, free, dt, float(cost), int(outcome), method, history=history)
