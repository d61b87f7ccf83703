"""Which states of a motion are drawn: of one trajectory, or of phases one after the other."""

import math
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


MOST_LANES = 16
"""More runs of a batch than this are not shown: every so many are."""
GHOSTLY = 0.07
"""How opaque faces of the other runs of a batch are beside the first: several lie behind each other."""


def lanes_of(system: System | Phases | Solution, trajectory: Trajectory | None, user: str) -> Phases:
    """A motion in phases, of which a trajectory is one; a batch has one axis, whatever it came with.

    Raises:
        ValueError: for no trajectory.
    """
    if isinstance(system, Phases):
        found = system
    elif isinstance(system, Solution):
        found = system.phases
    elif trajectory is None:
        raise ValueError(f"{user} needs the system and a trajectory, or nc.Phases")
    else:
        found = Phases((system,), (trajectory,))
    lanes = found.trajectories[0].t.shape[:-1]
    if len(lanes) <= 1:
        return found

    def flat(x: Any) -> Any:
        return x.reshape(math.prod(lanes), *x.shape[len(lanes) :])

    return Phases(found.systems, tuple(jax.tree.map(flat, part) for part in found.trajectories))


def is_batch(phases: Phases) -> bool:
    """Whether it has several runs."""
    return np.ndim(phases.trajectories[0].t) > 1


def lane(phases: Phases, number: int) -> Phases:
    """One lane of a batch in phases."""
    picked = tuple(jax.tree.map(lambda x: x[number], part) for part in phases.trajectories)
    return Phases(phases.systems, picked)


def runs_of(phases: Phases, most: int = MOST_LANES) -> list[Phases]:
    """The runs of a batch that are shown, evenly chosen; of one run itself."""
    if not is_batch(phases):
        return [phases]
    count = len(phases.trajectories[0].t)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    return [lane(phases, int(k)) for k in chosen]


def longest_of(runs: Sequence[Phases]) -> np.ndarray:
    """Times [s] of the run that ends last."""
    return np.asarray(max((run.t for run in runs), key=lambda t: float(t[-1])))


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


def together(phases: Phases, times: np.ndarray, **options: Any) -> Scenery:
    """The runs of a batch in one picture, the first as it is and the others as ghosts.

    Runs may differ in their ends: all are shown at the same times, and rest at their own ends.
    """
    first, *others = [scenery_at(run, times, **options)._replace(t=times) for run in runs_of(phases)]
    solids = [s._replace(alpha=GHOSTLY) for other in others for s in other.solids if s.kind != "force"]
    skins = [s._replace(alpha=GHOSTLY) for other in others for s in other.skins]
    heights = [s.ground for s in (first, *others) if s.ground is not None]
    return first._replace(
        solids=first.solids + solids, skins=first.skins + skins, ground=min(heights, default=None)
    )


def even_times(t: np.ndarray, count: int) -> np.ndarray:
    """So many times [s] from the first to the last, and no more than there are saved states."""
    return np.linspace(t[0], t[-1], max(1, min(count, len(t))))
