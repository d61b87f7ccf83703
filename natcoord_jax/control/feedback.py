"""Feedback around a solution: time-varying linear-quadratic regulation, and receding horizons."""

from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.guess import GUESS, unknowns_of
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.motion import joined
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.quadratic import model
from natcoord_jax.control.run import OPTIONS, optimise_jit
from natcoord_jax.control.solution import SOLUTION, Solution
from natcoord_jax.control.tangent import steady_rates
from natcoord_jax.control.transcription import Node, held_inputs, packed, unpacked
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import Several
from natcoord_jax.core.numeric import Number, Numbers, Vector, Whole
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System


class Feedback(eqx.Module):
    """Inputs of a solution plus gains times the deviation from its motion; a policy for `nc.simulate`.

    Attributes:
        inputs: of the solution (steps, inputs).
        gains: (steps, inputs, z) on small numbers z of the deviation: displacements and velocities.
        back: from deviations of state vectors to small numbers (steps, z, x).
        nodes: state vectors of the solution (steps, x).
        dt: step [s].
        start: time at which it begins [s].
        limits: lower and upper bound of the inputs.
    """

    inputs: Float[Array, "steps m"]
    gains: Float[Array, "steps m z"]
    back: Float[Array, "steps z x"]
    nodes: Float[Array, "steps x"]
    dt: Float[Array, ""]
    start: Float[Array, ""]
    limits: tuple[Any, Any]

    def __call__(self, t: Float[Array, ""], state: State) -> Float[Array, " m"]:
        """Inputs at one time, for the step that begins there."""
        # The small part keeps a time that is a step's start in its step.
        number = jnp.floor((t - self.start) / self.dt + 1e-6).astype(int)
        k = jnp.clip(number, 0, self.inputs.shape[0] - 1)
        deviation = self.back[k] @ (packed(state) - self.nodes[k])
        return jnp.clip(self.inputs[k] - self.gains[k] @ deviation, *self.limits)


@compiled
def _gains(problem: OptimalControl, iterate: Iterate, weights: tuple) -> tuple[Array, Array]:
    """Gains of the regulator, and what they act on."""
    d, nodes = iterate.derivatives, iterate.path.nodes
    found = model(problem, iterate.path, iterate.unknowns, iterate.multipliers, d)
    count, x = problem.system.structure.unknowns, nodes.x.shape[1]
    size = found.forward.shape[1] - (d.maps.forth.shape[1] - x)
    A, B = found.forward[:, :size, :size], found.forward[:, :size, -problem.channels :]
    displaced, quick, cost, final = weights

    def weighed(node: Node, forth: Array) -> Array:
        system, _ = problem.applied(node.free)

        def rates(x: Array) -> Array:
            return steady_rates(system, unpacked(problem.state, x, problem.state.t))

        turned = jax.jacfwd(rates)(node.x) @ forth[:x, :size]
        return jnp.diag(jnp.pad(displaced, (0, size - count))) + turned.T @ (quick[:, None] * turned)

    Q, R = jax.vmap(weighed)(nodes, d.maps.forth), jnp.diag(cost)

    def body(P: Array, given: tuple) -> tuple[Array, Array]:
        A, B, Q = given
        K = jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
        return 0.5 * (P + P.T), K

    gains = jax.lax.scan(body, final * Q[-1], (A, B, Q[:-1]), reverse=True)[1]
    return gains, d.maps.back[:-1, :size, :x]


@checked()
def regulator(
    solution: Annotated[Solution, SOLUTION],
    *,
    displacement: Annotated[Any, Number("not negative") | Vector(None)] = 1.0,
    rate: Annotated[Any, Number("not negative") | Vector(None)] = 1.0,
    effort: Annotated[Any, Number("not negative") | Vector(None)] = 1.0,
    final: Annotated[Any, Number("not negative")] = 10.0,
    limits: Annotated[
        tuple[Any, Any], Several(Number(infinite=True) | Numbers((None,), infinite=True), 2)
    ] = (-jnp.inf, jnp.inf),
) -> Feedback:
    """Time-varying linear-quadratic regulator around a solution, from the derivatives of the discrete motion.

    It makes the sum over the steps of displacement |dq|^2 + rate |dw|^2 + effort |du|^2 small, with dq and dw
    the deviations of the free motions and their rates.

    Args:
        solution: what `optimise` returned, with inputs held over the steps.
        displacement: weight of displacements [1/rad^2, 1/m^2], one number or one for each free motion (see
            `goal.Rest.labels` for their order). Where momentum binds motions together, as base and wheels of
            a spacecraft, weigh those that matter.
        rate: weight of rates [s^2/rad^2, s^2/m^2], likewise.
        effort: weight of inputs, one number or one for each channel [1/(N m)^2].
        final: factor on the weights at the end.
        limits: lower and upper bound of the inputs.

    Returns:
        A policy (t, state) -> inputs for `nc.simulate(..., inputs=policy, steps=...)`.

    Raises:
        ValueError: for a solution without an iterate or with splines as inputs.
    """
    problem, iterate = solution.problem, solution.iterate
    if iterate is None or problem.inputs.degree or problem.inputs.every > 1 or not problem.uniform:
        raise ValueError(
            "the regulator needs a solution of `optimise` with equal steps and inputs held over each"
        )
    motions, decided, channels = (
        (problem.system.structure.unknowns, "free motion"),
        (problem.channels, "input that is decided"),
        (len(problem.system.structure.inputs), "input channel"),
    )
    displaced, quick, cost, lower, upper = (
        for_each(value, count, f"regulator: {name}", each)
        for name, value, (count, each) in (
            ("displacement", displacement, motions), ("rate", rate, motions), ("effort", effort, decided),
            ("limits", limits[0], channels), ("limits", limits[1], channels),
        )
    )  # fmt: skip
    weights, limits = (displaced, quick, cost, jnp.asarray(final, float)), (lower, upper)
    gains, back = _gains(problem, iterate, weights)
    if problem.inputs.shared is not None:
        gains = jnp.einsum("cm,kmz->kcz", problem.inputs.shared, gains)
    dt, nodes = jnp.asarray(solution.dt), iterate.path.nodes.x[:-1]
    return Feedback(jnp.asarray(solution.inputs), gains, back, nodes, dt, problem.state.t, limits)


class Horizons(NamedTuple):
    """A closed loop of receding horizons.

    Attributes:
        trajectory: motion of the plant, all steps.
        codes: outcome of each optimisation, see `Outcome`.
        iterations: of each.
    """

    trajectory: Trajectory
    codes: Float[Array, " updates"]
    iterations: Float[Array, " updates"]


@checked()
def receding_horizon(
    problem: Annotated[OptimalControl, PROBLEM],
    plant: Annotated[System, SYSTEM],
    *,
    updates: Annotated[int, Whole(1)],
    steps_each: Annotated[int, Whole(1)],
    guess: Annotated[Any, GUESS] = None,
    options: Annotated[Options | None, OPTIONS] = None,
) -> Horizons:
    """Solve again and again from where the plant is, over the time that is left, in one compiled program.

    The problem keeps its number of steps and its final time, so that dt shrinks; a changed number does not
    compile anew. The last update looks one period ahead.

    Args:
        problem: the problem from the start, with inputs held over each step and a fixed final time.
        plant: the system that really moves, of the same structure (other masses, for example).
        updates: number of optimisations over the whole time.
        steps_each: steps of the plant between two of them.
        guess: for the first optimisation.
        options: settings of the method.

    Returns:
        The motion of the plant, and how each optimisation ended.

    Raises:
        ValueError: for a problem with free time, splines or a memory, or a plant of another structure.
    """
    if problem.free_time or problem.inputs.degree or problem.inputs.every > 1 or not problem.uniform:
        raise ValueError(
            "receding_horizon needs a fixed final time, equal steps and inputs held over each step"
        )
    if sum(problem.memory_sizes):
        raise ValueError(
            "receding_horizon starts anew at every update: it takes no goals, costs or bounds that look at "
            "the way there (integrals, waypoints, turns)"
        )
    if plant.structure != problem.system.structure:
        raise ValueError("the plant has another structure than the system of the problem")
    problem = numeric(problem)
    options = options or Options(False, 50, 1e-6, 1e-8)
    period = problem.steps * problem.dt / updates
    unknowns, state = unknowns_of(problem, guess, options.lifted), problem.state
    pieces, codes, iterations = [], [], []
    for k in range(updates):
        left = (updates - k) * period
        now = eqx.tree_at(lambda p: (p.dt, p.state), problem, (left / problem.steps, state))
        found = optimise_jit(now, unknowns, options)
        inputs = held_inputs(problem, found.unknowns.coefficients)
        at = (jnp.arange(steps_each) + 0.5) * period / steps_each
        held = inputs[jnp.minimum((at / now.dt).astype(int), problem.steps - 1)]
        piece = simulate(plant, state, dt=period / steps_each, inputs=held)
        state = jax.tree.map(lambda x: x[-1], piece.states)
        unknowns = _shifted(found, updates - k)
        pieces.append(piece)
        codes.append(found.code)
        iterations.append(found.iteration)
    return Horizons(joined(pieces), jnp.stack(codes), jnp.stack(iterations))


def _shifted(found: Iterate, left: int) -> Any:
    """A guess for the time that is left after one of `left` periods."""
    steps = found.unknowns.coefficients.shape[0]
    at = 1.0 / left + (jnp.arange(steps) + 0.5) / steps * (1.0 - 1.0 / left)
    k = jnp.clip((at * steps).astype(int), 0, steps - 1)
    unknowns = found.unknowns
    return eqx.tree_at(lambda u: (u.coefficients, u.y), unknowns, (unknowns.coefficients[k], unknowns.y[k]))
