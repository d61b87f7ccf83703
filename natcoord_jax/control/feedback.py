"""Feedback around a solution: time-varying linear-quadratic regulation."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.quadratic import model
from natcoord_jax.control.solution import SOLUTION, Solution
from natcoord_jax.control.tangent import steady_rates
from natcoord_jax.control.transcription import Node, packed, unpacked
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import Several
from natcoord_jax.core.numeric import Number, Numbers, Vector
from natcoord_jax.core.state import State


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
    # Held over each step they are the same at all of its stages.
    inputs = jnp.asarray(solution.inputs).reshape(len(nodes), problem.stages, -1)[:, 0]
    return Feedback(inputs, gains, back, nodes, dt, problem.state.t, limits)
