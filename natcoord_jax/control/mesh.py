"""Steps of an optimal control problem: their number, in phases, and how long each is."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class PhasedSteps(int):
    """Number of all steps of several phases, which knows those of each.

    Attributes:
        phases: number of steps of each.
    """

    phases: tuple[int, ...]

    def __new__(cls, phases: Sequence[int]):
        """The sum."""
        made = super().__new__(cls, sum(phases))
        made.phases = tuple(int(count) for count in phases)
        return made

    def __eq__(self, other: object) -> bool:
        """Whether the phases are the same; a number of steps without phases is another one."""
        return isinstance(other, PhasedSteps) and other.phases == self.phases

    def __hash__(self) -> int:
        return hash(("phases", self.phases))

    def __repr__(self) -> str:
        return repr(self.phases)

    def __getnewargs__(self) -> tuple:
        """For copies."""
        return (self.phases,)


def counted(steps: Any) -> int:
    """A number of steps; those of phases together."""
    if isinstance(steps, PhasedSteps):
        return steps
    return int(steps) if isinstance(steps, int | np.integer) else PhasedSteps(steps)


def phases_of(steps: int) -> tuple[int, ...]:
    """Steps of each phase."""
    return steps.phases if isinstance(steps, PhasedSteps) else (int(steps),)


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


def lengths(steps: int, dt: Any) -> Float[Array, " steps"]:
    """Durations of all steps, as they are given: one number, one for each phase or one for each step."""
    dt, phases = jnp.asarray(dt, float), phases_of(steps)
    if dt.ndim == 0:
        return jnp.full(int(steps), dt)
    if dt.shape[0] == int(steps):
        return dt
    return jnp.repeat(dt, np.array(phases), total_repeat_length=int(steps))


def member(steps: int) -> np.ndarray:
    """Which phase each step belongs to: one row a step, one column a phase."""
    phases = phases_of(steps)
    return np.eye(len(phases))[np.repeat(np.arange(len(phases)), phases)]


def durations(steps: int, dt: Any) -> Float[Array, " phases"]:
    """Durations of all phases, as they are given."""
    return lengths(steps, dt) @ member(steps)


def mesh_of(steps: int, dt: Any) -> Mesh:
    """The mesh, with the proportions of the steps as they are given."""
    each, belongs = lengths(steps, dt), member(steps)
    share = jnp.asarray(belongs) * (each / (belongs @ durations(steps, dt)))[:, None]
    before = jnp.concatenate([share[:1], share[:-1]])
    begin = jnp.cumsum(share, axis=0) - share
    return Mesh(share, begin, jnp.multiply(0.5, share + before))


def runs_of(steps: int, dt: Any) -> list[tuple[int, int]]:
    """First step, and the one after the last, of pieces whose steps are equally long."""
    phases = phases_of(steps)
    if np.ndim(dt) and np.shape(dt)[0] == int(steps):
        return [(k, k + 1) for k in range(int(steps))]
    ends = np.cumsum([0, *phases]).tolist()
    return list(zip(ends[:-1], ends[1:]))


def refined(steps: int, dt: Any, count: int) -> tuple[int, Any] | None:
    """Another number of steps over the same durations, and their dt; None where phases do not allow it."""
    phases = phases_of(steps)
    new = [number * count / int(steps) for number in phases]
    if any(number != round(number) or number < 1 for number in new):
        return None
    dt = jnp.asarray(dt, float)
    if dt.ndim and dt.shape[0] == int(steps) != len(phases):
        if count % int(steps):
            return None
        dt = jnp.repeat(dt, count // int(steps))
    ratio = int(steps) / count
    return (PhasedSteps([round(x) for x in new]) if isinstance(steps, PhasedSteps) else count), ratio * dt
