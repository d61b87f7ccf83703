"""What is seen of a motion at some times, and the diagram that shows it.

Bodies are the shapes they were given, or boxes of equal inertia; joints are points with axes, beams swept
sections.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import matplotlib
import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.assembly.system import System
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.shapes import FACES
from natcoord_jax.core.kinds import Several, of
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.viz.outline import beam_rims, element_faces, is_node, joint_places, surfaces, with_ground

MOVING = of("a system, as scene.compile() returned it, or nc.Phases(...)", System, Phases)
BEAMS = Several(of("what scene.add(nc.Beam(...)) returned", BeamHandle))


def _frame(axes: Any, points: np.ndarray) -> float:
    """Equal scales around all points; half the edge of the cube."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre, half = 0.5 * (lower + upper), 0.55 * max(float(np.max(upper - lower)), 1e-9)
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
        set_limits(middle - half, middle + half)
    axes.set_box_aspect((1, 1, 1))
    return half


class Picture(NamedTuple):
    """What is drawn at the times of a phase (leading axis of everything but `names`).

    Attributes:
        t: times [s].
        names: of the bodies.
        corners: of what is drawn of each (t, n, 3) [m].
        faces: numbers of the corners around each face, by body.
        pins: ends of the axes of the joints (t, joints, 2, 3) [m].
        beams: quadrilaterals of the beams (t, faces, 4, 3) [m].
    """

    t: np.ndarray
    names: list[str]
    corners: list[np.ndarray]
    faces: list[list[np.ndarray]]
    pins: np.ndarray
    beams: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """Everything that must be seen."""
        drawn = (*self.corners, self.beams, self.pins.mean(axis=2))
        return np.concatenate([x.reshape(-1, 3) for x in drawn])

    def polygons(self, body: int, frame: int) -> list[np.ndarray]:
        """Corners of the faces of a body at one time."""
        return [self.corners[body][frame][face] for face in self.faces[body]]


def picture(system: System, states: State, beams: Sequence[BeamHandle] = ()) -> Picture:
    """What to draw of a system at several states, by the names of its bodies."""
    rows = with_ground(np.asarray(states.q))
    named = system.structure.bodies
    order = [int(k) for k in np.argsort(named) if not is_node(system, named[int(k)])]
    drawn = surfaces(system)
    corners = [np.einsum("ka,tac->tkc", drawn[k][0], rows[:, k]) for k in order]
    points, axes = joint_places(system, rows)
    return Picture(
        np.asarray(states.t),
        [named[k] for k in order],
        corners,
        [drawn[k][1] for k in order],
        np.stack([points - axes, points + axes], axis=2),
        np.concatenate([beam_rims(system, rows, beams), element_faces(system, rows)], axis=1),
    )


class Stage:
    """Figure or diagram on which pictures of a motion are shown, one after the other.

    Attributes:
        axes: three-dimensional, with equal scales.
        parts: what changes.
    """

    def __init__(self, axes: Any, first: Picture, points: np.ndarray, title: str = "t = {:.2f} s"):
        self.axes, self.title = axes, title
        self.half = _frame(axes, points)
        colours = matplotlib.colormaps["tab10"]
        self.solids = []
        for body, name in enumerate(first.names):
            faces = first.polygons(body, 0)
            solid = Poly3DCollection(faces, facecolor=colours(body % 10), edgecolor="k")
            # Edges between the flat pieces of a round body are none of its own.
            solid.set(alpha=0.45, linewidth=0.5 if len(faces) <= len(FACES) else 0.1, label=name)
            self.solids.append(axes.add_collection3d(solid))
        lines = Line3DCollection(np.zeros((1, 2, 3)), colors="k", linewidths=1.5)  # there must be one
        self.pins = axes.add_collection3d(lines)
        self.pins.set_visible(bool(first.pins.shape[1]))
        self.dots = axes.plot(*first.pins[0].mean(axis=1).T, "ko", markersize=3)[0]
        self.beams = []
        if first.beams.shape[1]:
            skin = Poly3DCollection(first.beams[0], facecolor="0.35", edgecolor="k", linewidth=0.1)
            self.beams.append(axes.add_collection3d(skin))

    def show(self, at: Picture, frame: int) -> list[Any]:
        """Move everything to a frame of a picture."""
        for body, solid in enumerate(self.solids):
            solid.set_verts(at.polygons(body, frame))
        middle = at.pins[frame].mean(axis=1)
        if len(middle):
            ends = middle[:, None] + 0.16 * self.half * (at.pins[frame] - middle[:, None])
            self.pins.set_segments(list(ends))
        self.dots.set_data_3d(*middle.T)
        for skin in self.beams:
            skin.set_verts(at.beams[frame])
        self.axes.set_title(self.title.format(at.t[frame]))
        return [*self.solids, self.pins, self.dots, *self.beams]


def pictures(phases: Phases, times: np.ndarray, beams: Sequence[BeamHandle] = ()) -> list[Picture]:
    """Pictures of the saved states next to given times, one a phase; at a change the later phase is shown."""
    found, starts = [], [float(trajectory.t[0]) for trajectory in phases.trajectories]
    owner = np.searchsorted(starts, times + 1e-9 * (1 + np.abs(times)), side="right").clip(1) - 1
    for number, (system, trajectory) in enumerate(phases.pairs):
        saved, wanted = np.asarray(trajectory.t), times[owner == number]
        if wanted.size:
            nearest = np.abs(saved[:, None] - wanted).argmin(axis=0)
            found.append(picture(system, jax.tree.map(lambda x, k=nearest: x[k], trajectory.states), beams))
    return found


def phases_of(system: System | Phases, trajectory: Trajectory | None, user: str) -> Phases:
    """A motion in phases, of which a trajectory is one.

    Raises:
        ValueError: for a trajectory of a batch, or none.
    """
    if isinstance(system, Phases):
        phases = system
    elif trajectory is None:
        raise ValueError(f"{user} needs the system and a trajectory, or nc.Phases")
    else:
        phases = Phases((system,), (trajectory,))
    for part in phases.trajectories:
        if part.t.ndim != 1:
            raise ValueError(f"{user} takes one lane, not a batch of shape {part.t.shape[:-1]}")
    return phases
