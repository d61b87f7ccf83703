"""Films of a motion."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import NAME, Concrete, Several, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.motion import (
    BEAMS,
    BOX,
    COLOURS,
    MOVING,
    even_times,
    lanes_of,
    longest_of,
    runs_of,
    together,
)
from natcoord_jax.viz.scenery import STOPS, Scenery, limits
from natcoord_jax.viz.skins import Colouring
from natcoord_jax.viz.stage import Stage

LONGEST, SHORTEST = 10.0, 2.0
"""Shown time of a film [s]; longer and shorter motions are shown faster or slower than they are."""
LIMIT = 2_400_000
"""Bytes that the pictures of a film may have by their first one; later ones may be larger."""
DOTS = 90
SUFFIXES = (".gif", ".mp4", ".html")
POINTS = Several(of("nc.Point(body, (x, y, z))", Marker))


class Inline(str):
    """HTML text that a notebook shows as such."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return str(self)


def pace_of(t: np.ndarray) -> float:
    """Seconds of the motion in a second of the film: one, unless it would be too long or too short."""
    span = float(t[-1] - t[0])
    shown = min(max(span, SHORTEST), LONGEST)
    return span / shown if span > 0 else 1.0


def caption_of(pace: float) -> str:
    """Time as it is written below the title, with the pace where it is not that of the clock."""
    digits = max(2, 2 - int(np.floor(np.log10(pace))))
    note = "" if abs(pace - 1) < 0.01 else f"   ({pace:.2g} × real time)"
    return f"t = {{:.{digits}f}} s{note}"


def _bytes_of_a_picture(figure: Figure, suffix: str) -> int:
    """About what a picture takes in a file."""
    found = io.BytesIO()
    figure.savefig(found, format="png", dpi=DOTS)
    # HTML holds pictures in base 64; a gif has fewer colours, and only what changes.
    return int(len(found.getvalue()) * (1.4 if suffix == ".html" else 0.9))


def _stage(scenery: Scenery) -> tuple[Figure, Stage]:
    figure = plt.figure(figsize=(5.6, 4.8), dpi=DOTS)
    coloured = any(s.values is not None for s in scenery.skins)
    place = (0.0, 0.14, 0.96, 0.77) if coloured else (0.0, 0.05, 0.96, 0.85)
    axes: Any = figure.add_axes(place, projection="3d")
    for skin, values in [(s, s.values) for s in scenery.skins if s.values is not None][:1]:
        scale = ScalarMappable(Normalize(*limits(values)), LinearSegmentedColormap.from_list("", STOPS))
        bar = figure.colorbar(scale, cax=figure.add_axes((0.3, 0.09, 0.4, 0.018)), orientation="horizontal")
        bar.ax.tick_params(labelsize=7)
        bar.set_label(f"{skin.name}: {skin.label}", fontsize=7, labelpad=1)
    return figure, Stage(axes, scenery, zoom=1.05)


def _write(film: FuncAnimation, file: Path, fps: int) -> None:
    """Write a gif or an mp4.

    Raises:
        RuntimeError: for an mp4 without ffmpeg.
    """
    if file.suffix.lower() == ".gif":
        film.save(str(file), writer=PillowWriter(fps=fps), dpi=DOTS)
        return
    if not FFMpegWriter.isAvailable():
        raise RuntimeError(f"animate: {file} needs the program ffmpeg, which is not found; install it, or "
                           "pass a name that ends in .gif")  # fmt: skip
    # Even numbers of pixels and this format are what every player takes.
    options = ["-pix_fmt", "yuv420p", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]
    film.save(str(file), writer=FFMpegWriter(fps=fps, extra_args=options), dpi=2 * DOTS)


@checked()
def animate(
    system: Annotated[System | Phases | Solution, MOVING],
    trajectory: Annotated[Trajectory | None, Concrete(TRAJECTORY)] = None,
    *,
    file: Annotated[
        str | Path | None, of("the name of a file that ends in .gif, .mp4 or .html", str, Path)
    ] = None,
    fps: Annotated[int, Whole(1)] = 25,
    beams: Annotated[Sequence[BeamHandle], BEAMS] = (),
    traces: Annotated[Sequence[Marker], POINTS] = (),
    title: Annotated[str, NAME] = "",
    colour: Annotated[Colouring, COLOURS] = "energy",
    within: Annotated[Any, BOX] = None,
) -> Inline | Path:
    """A film of a trajectory: true shapes, joints, ground, and the time.

    In real time, unless it takes more than 10 s or less than 2 s: then the caption tells the pace. To look at
    a motion from all sides there is `nc.view`.

    Args:
        system: compiled system; or a motion in phases or a solution of an optimal control problem, which need
            no trajectory.
        trajectory: computed with it; of a batch the first run is shown and the others are its ghosts, 16
            of them at most.
        file: where to write it, a .gif, a .mp4 (by the program ffmpeg) or a .html with a player, below 3 MB;
            None: return HTML for a notebook instead.
        fps: pictures per second; fewer where the file would become too large.
        beams: handles of beams, whose sections are drawn as given; the others are drawn with the ellipse
            that has their mass and inertia.
        traces: points whose paths are drawn.
        title: above the film.
        colour: of beams, shells and solids, see `nc.view`.
        within: two corners of the box (2, 3) [m] that is looked into: what is outside is not drawn then, as a
            ball on its way; None: all is seen.

    Returns:
        HTML that a notebook shows with player controls, or the path of the file.

    Raises:
        ValueError: for no trajectory, or another kind of file.
        RuntimeError: for an mp4 without ffmpeg.
    """
    phases = lanes_of(system, trajectory, "animate")
    suffix = ".html" if file is None else Path(file).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(
            f"animate writes {', '.join(SUFFIXES)}, not {str(file)!r}; pass a name that ends in one of these"
        )
    t = longest_of(runs_of(phases))
    pace = pace_of(t)
    wanted = max(2, int((t[-1] - t[0]) / pace * fps) + 1)
    options = {"beams": beams, "traces": traces, "title": title, "colour": colour, "within": within}
    scenery = together(phases, even_times(t, wanted), **options)
    figure, stage = _stage(scenery)
    try:
        stage.show(0, caption_of(pace))
        most = len(scenery.t) if suffix == ".mp4" else LIMIT // _bytes_of_a_picture(figure, suffix)
        # Every so many pictures, and the last one.
        kept = np.unique(np.linspace(0, len(scenery.t) - 1, min(len(scenery.t), most)).round().astype(int))
        rate = max(1, round(len(kept) / max((t[-1] - t[0]) / pace, 1e-9)))
        film = FuncAnimation(figure, lambda k: stage.show(int(kept[k]), caption_of(pace)), frames=len(kept),
                             interval=1000 / rate)  # fmt: skip
        if file is not None and suffix != ".html":
            _write(film, Path(file), rate)
            return Path(file)
        with matplotlib.rc_context({"animation.embed_limit": 100.0, "savefig.dpi": DOTS}):
            text = Inline(film.to_jshtml(fps=rate))
        if file is None:
            return text
        Path(file).write_text(text, "utf-8")
        return Path(file)
    finally:
        plt.close(figure)
