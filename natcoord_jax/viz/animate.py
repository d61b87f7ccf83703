"""Animation of a motion."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.assembly.system import System
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.viz.stage import BEAMS, MOVING, Stage, phases_of, pictures

MOST_FRAMES = 250


class Inline(str):
    """HTML text that a notebook shows as such."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return str(self)


def _times(t: np.ndarray, fps: int) -> np.ndarray:
    """An even rate of pictures per second of simulated time."""
    wanted = max(2, min(MOST_FRAMES, int((t[-1] - t[0]) * fps) + 1))
    return np.linspace(t[0], t[-1], wanted)


def _film(
    phases: Phases, times: np.ndarray, beams: Sequence[BeamHandle], fps: int
) -> tuple[FuncAnimation, Figure]:
    shown = pictures(phases, times, beams)
    figure = plt.figure(figsize=(5.5, 5.5))
    axes = figure.add_subplot(projection="3d")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    stage = Stage(axes, shown[0], np.concatenate([at.points for at in shown]))
    frames = [(at, k) for at in shown for k in range(len(at.t))]
    film = FuncAnimation(figure, lambda k: stage.show(*frames[k]), frames=len(frames), interval=1000 // fps)
    return film, figure


@checked(
    system=MOVING,
    trajectory=TRAJECTORY,
    file=of("the name of a gif file", str, Path),
    fps=Whole(1),
    beams=BEAMS,
)
def animate(
    system: System | Phases,
    trajectory: Trajectory | None = None,
    *,
    file: str | Path | None = None,
    fps: int = 25,
    beams: Sequence[BeamHandle] = (),
) -> Inline | Path:
    """Animate a trajectory in real time.

    Args:
        system: compiled system; or a motion in phases, which needs no trajectory.
        trajectory: of one lane, computed with it.
        file: where to write an animated gif; None: return HTML for a notebook instead.
        fps: pictures per second; long runs are shown with at most 250 pictures, faster than real time.
        beams: handles of beams, whose sections are drawn as given; the others are drawn with the ellipse
            that has their mass and inertia.

    Returns:
        HTML that a notebook shows with player controls, or the path of the gif.

    Raises:
        ValueError: for a trajectory of a batch, or none, or a file that is no gif.
    """
    phases = phases_of(system, trajectory, "animate")
    if file is not None and Path(file).suffix.lower() != ".gif":
        raise ValueError(f"animate writes gif files, not {str(file)!r}; pass a name that ends in .gif")
    film, figure = _film(phases, _times(np.asarray(phases.t), fps), beams, fps)
    try:
        if file is None:
            with matplotlib.rc_context({"animation.embed_limit": 100.0}):
                return Inline(film.to_jshtml(fps=fps))
        film.save(str(file), writer=PillowWriter(fps=fps))
        return Path(file)
    finally:
        plt.close(figure)
