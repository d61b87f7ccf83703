"""The simulated motion of an optimal control problem, with its inputs and what is free."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.mesh import spans
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.core.state import Trajectory
from natcoord_jax.reading.transfer import transfer
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System


def motion(
    problem: OptimalControl, free: Float[Array, " p"], inputs: Any, *, throw: bool = True
) -> Trajectory:
    """The motion of one system as `nc.simulate` finds it; steps of several lengths one piece after the other.

    Args:
        problem: the problem.
        free: what is free besides the inputs, in units of its scale.
        inputs: of all steps (steps, inputs), or of their stages (steps, stages, inputs) [N, N m].
        throw: whether to raise where it fails.

    Raises:
        SimulationError: if it cannot be simulated.
    """
    return joined([piece for _, piece in motions(problem, free, inputs, throw=throw)])


def motions(
    problem: OptimalControl, free: Float[Array, " p"], inputs: Any, *, throw: bool = True
) -> list[tuple[System, Trajectory]]:
    """The motions of all phases, each with its system; arguments as of `motion`."""
    systems, lengths, found = problem.applied_systems(free), problem.lengths(free), []
    system, state = systems[0], problem.start(free)
    for phase, (first, last) in enumerate(spans(problem.phases)):
        if 0 < phase < len(systems):
            system, state = transfer(system, state, systems[phase])
        runs = [(first, last)] if problem.even else [(k, k + 1) for k in range(first, last)]
        pieces = []
        for a, b in runs:
            given = inputs[a:b] if system.structure.inputs else None
            options = {"steps": b - a, "inputs": given, "scheme": problem.scheme, "throw": throw}
            pieces.append(simulate(system, state, dt=lengths[a], **options))
            state = jax.tree.map(lambda x: x[-1], pieces[-1].states)
        found.append((system, joined(pieces)))
    return found


def joined(pieces: list[Trajectory]) -> Trajectory:
    """Trajectories one after the other."""
    if len(pieces) == 1:
        return pieces[0]
    states = [pieces[0].states, *(jax.tree.map(lambda x: x[1:], p.states) for p in pieces[1:])]
    whole = jax.tree.map(lambda *x: jnp.concatenate(x), *states)
    inputs = jnp.concatenate([p.inputs for p in pieces])
    worst = jnp.max(jnp.stack([p.result for p in pieces]))
    return eqx.tree_at(lambda t: (t.states, t.inputs, t.result), pieces[-1], (whole, inputs, worst))
