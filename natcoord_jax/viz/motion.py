"""Which states of a motion are drawn: of one trajectory, or of phases one after the other."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.kinds import Choice, Several, of
from natcoord_jax.core.numeric import Numbers
from natcoord_jax.core.state import Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.parts import scenery_of
from natcoord_jax.viz.scenery import Scenery, joined

MOVING = of(
    "a system, as scene.compile() returned it, nc.Phases(...), or a solution", System, Phases, Solution
)
COLOURS = Choice(("energy", "parts")) | of("values of the elements, by name", Mapping)
BOX = Numbers((2, 3))
BEAMS = Several(of("what scene.add(nc.Beam(...)) returned", BeamHandle))


def phases_of(system: System | Phases | Solution, trajectory: Trajectory | None, user: str) -> Phases:
    """A motion in phases, of which a trajectory is one.

    Raises:
        ValueError: for a trajectory of a batch, or none.
    """
    phases = lanes_of(system, trajectory, user)
    for part in phases.trajectories:
        if part.t.ndim != 1:
            raise ValueError(f"{user} takes one lane, not a batch of shape {part.t.shape[:-1]}")
    return phases


def lanes_of(system: System | Phases | Solution, trajectory: Trajectory | None, user: str) -> Phases:
    """The same, of a batch as well.

    Raises:
        ValueError: for no trajectory.
    """
    if isinstance(system, Phases):
        return system
    if isinstance(system, Solution):
        return Phases((system.system,), (system.trajectory,))
    if trajectory is None:
        raise ValueError(f"{user} needs the system and a trajectory, or nc.Phases")
    return Phases((system,), (trajectory,))


def lane(phases: Phases, number: int) -> Phases:
    """One lane of a batch in phases."""
    picked = tuple(jax.tree.map(lambda x: x[number], part) for part in phases.trajectories)
    return Phases(phases.systems, picked)


def scenery_at(phases: Phases, times: np.ndarray, **options: Any) -> Scenery:
    """What there is to draw of the saved states next to given times; at a change that of the later phase.

    Args:
        phases: of one lane.
        times: increasing [s].
        **options: of `scenery_of`.
    """
    starts = [float(trajectory.t[0]) for trajectory in phases.trajectories]
    owner = np.searchsorted(starts, times + 1e-9 * (1 + np.abs(times)), side="right").clip(1) - 1
    found = []
    for number, (system, trajectory) in enumerate(phases.pairs):
        wanted = times[owner == number]
        if wanted.size:
            nearest = np.abs(np.asarray(trajectory.t)[:, None] - wanted).argmin(axis=0)
            found.append(scenery_of(system, trajectory, nearest, **options))
    return joined(found)


def even_times(t: np.ndarray, count: int) -> np.ndarray:
    """So many times [s] from the first to the last, and no more than there are saved states."""
    return np.linspace(t[0], t[-1], max(1, min(count, len(t))))


def title_of(system: System) -> str:
    """What a motion is called if nobody says."""
    bodies: Sequence[str] = system.structure.bodies
    return f"{len(bodies)} bodies" if len(bodies) != 1 else bodies[0]
