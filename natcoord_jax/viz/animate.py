"""Animation: bodies as boxes of equal inertia, joints as points with axes."""

from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from natcoord_jax.assembly.system import System
from natcoord_jax.core.state import Trajectory
from natcoord_jax.viz.outline import FACES, inertia_boxes, joint_places, with_ground

MOST_FRAMES = 250


class Inline(str):
    """HTML text that a notebook shows as such."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return str(self)


def _frame_indices(t: np.ndarray, fps: int) -> np.ndarray:
    """Saved states closest to an even rate of pictures per second of simulated time."""
    wanted = max(2, min(MOST_FRAMES, int((t[-1] - t[0]) * fps) + 1))
    return np.searchsorted(t, np.linspace(t[0], t[-1], wanted)).clip(0, len(t) - 1)


def _stage(points: np.ndarray) -> tuple[Figure, Any, float]:
    """Figure and axes with equal scales around all points, and the length to draw axes with."""
    figure = plt.figure(figsize=(5.5, 5.5))
    axes = figure.add_subplot(projection="3d")
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre, half = 0.5 * (lower + upper), 0.55 * max(float(np.max(upper - lower)), 1e-9)
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
        set_limits(middle - half, middle + half)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    return figure, axes, 0.16 * half


def _film(system: System, t: np.ndarray, q: np.ndarray, fps: int) -> tuple[FuncAnimation, Figure]:
    rows = with_ground(q)
    bodies = len(system.structure.bodies)
    corners = np.einsum("bka,tbac->tbkc", inertia_boxes(system), rows[:, :bodies])
    points, directions = joint_places(system, rows)
    figure, axes, length = _stage(np.concatenate([corners.reshape(-1, 3), points.reshape(-1, 3)]))
    colours = matplotlib.colormaps["tab10"]
    boxes = []
    for body, name in enumerate(system.structure.bodies):
        box = Poly3DCollection(corners[0, body][FACES], facecolor=colours(body % 10), edgecolor="k")
        box.set(alpha=0.45, linewidth=0.5, label=name)
        boxes.append(axes.add_collection3d(box))
    ends = np.stack([points - length * directions, points + length * directions], axis=2)
    pins = axes.add_collection3d(Line3DCollection(list(ends[0]), colors="k", linewidths=1.5))
    dots = axes.plot(*points[0].T, "ko", markersize=3)[0]

    def show(frame: int) -> list[Any]:
        for body, box in enumerate(boxes):
            box.set_verts(corners[frame, body][FACES])
        pins.set_segments(list(ends[frame]))
        dots.set_data_3d(*points[frame].T)
        axes.set_title(f"t = {t[frame]:.2f} s")
        return [*boxes, pins, dots]

    return FuncAnimation(figure, show, frames=len(t), interval=1000 // fps), figure


def animate(
    system: System, trajectory: Trajectory, *, file: str | Path | None = None, fps: int = 25
) -> Inline | Path:
    """Animate a trajectory in real time.

    Args:
        system: compiled system.
        trajectory: of one lane, computed with it.
        file: where to write an animated gif; None: return HTML for a notebook instead.
        fps: pictures per second; long runs are shown with at most 250 pictures, faster than real time.

    Returns:
        HTML that a notebook shows with player controls, or the path of the gif.

    Raises:
        ValueError: for a trajectory of a batch, or a file that is no gif.
    """
    if trajectory.t.ndim != 1:
        raise ValueError(f"animate takes one lane, not a batch of shape {trajectory.t.shape[:-1]}")
    if file is not None and Path(file).suffix.lower() != ".gif":
        raise ValueError(f"animate writes gif files, not {str(file)!r}; pass a name that ends in .gif")
    t = np.asarray(trajectory.t)
    picked = _frame_indices(t, fps)
    film, figure = _film(system, t[picked], np.asarray(trajectory.q)[picked], fps)
    try:
        if file is None:
            with matplotlib.rc_context({"animation.embed_limit": 100.0}):
                return Inline(film.to_jshtml(fps=fps))
        film.save(str(file), writer=PillowWriter(fps=fps))
        return Path(file)
    finally:
        plt.close(figure)
