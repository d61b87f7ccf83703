"""Steps of an optimal control problem: their number, in phases, and how long each is."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Phases = tuple[int, ...]
"""Numbers of steps."""


class Mesh(NamedTuple):
    """Steps in terms of the durations of the phases, one row a step.

    Attributes:
        share: durations of the steps are share @ durations.
        begin: they begin at begin @ durations after the start.
        gap: from the middle of the step before to theirs; of the first step its own duration.
    """

    share: Float[Array, "*steps phases"]
    begin: Float[Array, "*steps phases"]
    gap: Float[Array, "*steps phases"]


def lengths(phases: Phases, dt: Any) -> Float[Array, " steps"]:
    """Durations of all steps, as they are given: one number, one for each phase or one for each step."""
    dt, steps = jnp.asarray(dt, float), sum(phases)
    if dt.ndim == 0:
        return jnp.full(steps, dt)
    if dt.shape[0] == steps:
        return dt
    return jnp.repeat(dt, np.array(phases), total_repeat_length=steps)


def member(phases: Phases) -> np.ndarray:
    """Which phase each step belongs to: one row a step, one column a phase."""
    return np.eye(len(phases))[np.repeat(np.arange(len(phases)), phases)]


def durations(phases: Phases, dt: Any) -> Float[Array, " phases"]:
    """Durations of all phases, as they are given."""
    return lengths(phases, dt) @ member(phases)


def mesh_of(phases: Phases, dt: Any) -> Mesh:
    """The mesh, with the proportions of the steps as they are given."""
    each, belongs = lengths(phases, dt), member(phases)
    share = jnp.asarray(belongs) * (each / (belongs @ durations(phases, dt)))[:, None]
    before = jnp.concatenate([share[:1], share[:-1]])
    begin = jnp.cumsum(share, axis=0) - share
    return Mesh(share, begin, jnp.multiply(0.5, share + before))


def spans(phases: Phases) -> list[tuple[int, int]]:
    """First step of each phase, and the one after its last."""
    ends = np.cumsum([0, *phases]).tolist()
    return list(zip(ends[:-1], ends[1:]))


def refined(phases: Phases, dt: Any, count: int) -> tuple[Phases, Any] | None:
    """Another number of steps over the same durations, and their dt; None where phases do not allow it."""
    steps, dt = sum(phases), jnp.asarray(dt, float)
    if any(number * count % steps or number * count < steps for number in phases):
        return None
    if dt.ndim and dt.shape[0] == steps != len(phases):
        if count % steps:
            return None
        dt = jnp.repeat(dt, count // steps)
    return tuple(number * count // steps for number in phases), steps / count * dt
