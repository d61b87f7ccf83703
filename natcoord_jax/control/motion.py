"""The simulated motion of an optimal control problem, with its inputs and what is free."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.mesh import runs_of
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.core.state import Trajectory
from natcoord_jax.stepping.simulate import simulate


def motion(
    problem: OptimalControl, free: Float[Array, " p"], inputs: Any, *, throw: bool = True
) -> Trajectory:
    """The motion as `nc.simulate` finds it; steps of several lengths one piece after the other.

    Args:
        problem: the problem.
        free: what is free besides the inputs, in units of its scale.
        inputs: of all steps (steps, inputs) [N, N m].
        throw: whether to raise where it fails.

    Raises:
        SimulationError: if it cannot be simulated.
    """
    system, dt = problem.applied(free)
    state = problem.start(free)
    if problem.uniform:
        return _piece(problem, system, state, dt, inputs, throw)
    lengths, pieces = problem.lengths(free), []
    for first, last in runs_of(problem.phases, problem.dt):
        pieces.append(_piece(problem, system, state, lengths[first], inputs[first:last], throw))
        state = jax.tree.map(lambda x: x[-1], pieces[-1].states)
    return joined(pieces)


def _piece(problem: OptimalControl, system: Any, state: Any, dt: Any, inputs: Any, throw: bool) -> Trajectory:
    given = inputs if problem.system.structure.inputs else None
    return simulate(system, state, dt=dt, steps=len(inputs), inputs=given, throw=throw)


def joined(pieces: list[Trajectory]) -> Trajectory:
    """Trajectories one after the other."""
    states = [pieces[0].states, *(jax.tree.map(lambda x: x[1:], p.states) for p in pieces[1:])]
    whole = jax.tree.map(lambda *x: jnp.concatenate(x), *states)
    inputs = jnp.concatenate([p.inputs for p in pieces])
    worst = jnp.max(jnp.stack([p.result for p in pieces]))
    return eqx.tree_at(lambda t: (t.states, t.inputs, t.result), pieces[-1], (whole, inputs, worst))
