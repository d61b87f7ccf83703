"""What is no number, or acts on nothing, where a motion starts: seen before anything is compiled."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.control.memory import Step
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import standing_excess
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.stepping.step import advance

TRIED = (0.0, 1.0, -1.0, 0.1, -0.1)
"""Inputs that are tried: some functions are defined for some of them only."""
LARGE = 60
"""Unknowns from which on inputs are not looked at: that takes longer there."""


def refuse_undefined(problem: OptimalControl, inputs: Any) -> None:
    """Refuse running costs and bounds that have no value or no slope where the motion starts.

    Args:
        problem: the problem.
        inputs: those of the guess in the first step, which are tried first; None: there are none.

    Raises:
        ValueError: where they have none with any of several inputs.
    """
    count = len(problem.system.structure.inputs)
    tried = [np.full(count, x) for x in TRIED]
    tried = tried if inputs is None else [np.asarray(inputs, float), *tried]
    found = []
    for u in tried:
        found.append(_standing(problem, jnp.asarray(u)))
        if all(np.all(np.isfinite(np.asarray(x))) for x in found[-1]):
            return
    when = f"at the start, t = {float(problem.state.t):g} s, whatever the inputs"
    for k, what in enumerate(("running cost", "slope of the running cost")):
        if not any(np.all(np.isfinite(np.asarray(one[k]))) for one in found):
            raise ValueError(
                f"the {what} is no finite number {when}; look for roots, logarithms and quotients of what is "
                "zero or negative there, and guard them with jnp.where inside and outside"
            )
    for row, name in enumerate(problem.path_labels):
        if not any(np.isfinite(np.asarray(one[2])[row]) for one in found):
            raise ValueError(f"the bound {name!r} is no finite number {when}; make it defined there")


@eager_numpy
def _standing(problem: OptimalControl, u: Array) -> tuple[Array, Array, Array]:
    """Running cost of a step that stays at the start, its slopes, and excesses over bounds."""
    free = jnp.zeros(len(problem.free))
    system, dt = problem.applied(free)
    last, memory = (u if problem.looked_back else u[:0]), jnp.zeros(sum(problem.memory_sizes))

    def parts(state: State) -> tuple[Array, ...]:
        return state.q, state.v, state.coordinates, state.rates

    def cost(at: tuple[Array, ...], u: Array) -> Array:
        state = eqx.tree_at(parts, problem.state, at)
        step = Step(jnp.array(1), dt, state, state, u, last, dt, problem.named(free))
        return problem.cost.of_step(system, problem.memories(memory)[1], step)

    at = parts(problem.state)
    slopes = jax.tree.leaves(jax.jacfwd(cost, argnums=(0, 1))(at, u))
    slope = jnp.concatenate([x.reshape(-1) for x in slopes])
    return cost(at, u), slope, standing_excess(problem, problem.state, u, free)


def idle_inputs(problem: OptimalControl) -> tuple[str, ...]:
    """Names of input channels that act on no free motion, whatever the motion is."""
    structure = problem.system.structure
    if not structure.inputs or structure.solver != "reduced" or structure.unknowns > LARGE:
        return ()
    felt = np.asarray(_felt(problem))
    return tuple(name for name, size in zip(structure.inputs, felt) if size == 0)


@eager_numpy
def _felt(problem: OptimalControl) -> Array:
    """Largest change of a step's equations per input, in a motion without symmetries."""
    structure = problem.system.structure
    system, dt = problem.applied(jnp.zeros(len(problem.free)))
    unknowns = structure.unknowns + structure.multipliers
    y = jnp.asarray(np.sin(1.0 + np.arange(unknowns)))

    def residual(u: Array) -> Array:
        return advance(system, problem.state, u, dt, y, gauss(1))[0]

    return jnp.max(jnp.abs(jax.jacfwd(residual)(jnp.zeros(len(structure.inputs)))), axis=0)
