"""The diagram that shows a motion: true shapes, joints, ground, title and time."""

from itertools import product
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from natcoord_jax.viz.scenery import Scenery, along_map, rounded

LEAST = 0.3
"""Least edge of the box of the axes, relative to its longest."""
MARGIN = 0.06
FILLED = 0.97
"""Share of a picture that what moves takes at most, from edge to edge."""
AMBIENT = 0.5
GRID = 8
"""Least number of lines of the ground along its longer edge."""


class Faces:
    """The faces of a scenery: which corners, which colours, in one list.

    One collection draws them all: matplotlib sorts faces by distance within one, not across several.
    """

    def __init__(self, scenery: Scenery, eye: np.ndarray):
        self.scenery = scenery
        light = eye + 0.7 * scenery.up + 0.4 * np.cross(scenery.up, eye)
        self.light = light / np.linalg.norm(light)
        start, faces, colours, edges = 0, [np.zeros((0, 4), int)], [np.zeros((0, 4))], [np.zeros(0, bool)]
        for solid in scenery.solids:
            cut = [(four, shade) for face, shade in zip(solid.faces, solid.shade) for four in _fours(face)]
            faces.append(start + np.array([four for four, _ in cut]))
            lit = np.outer([shade for _, shade in cut], solid.colour)
            colours.append(np.pad(lit, ((0, 0), (0, 1)), constant_values=solid.alpha))
            edges.append(np.zeros(len(cut), bool))
            start += len(solid.points)
        self.skins = sum(map(len, faces))
        for skin in scenery.skins:
            faces.append(start + skin.faces)
            colours.append(np.tile((*skin.colour, skin.alpha), (len(skin.faces), 1)))
            edges.append(np.full(len(skin.faces), skin.edges))
            start += skin.points.shape[1]
        self.faces = np.concatenate(faces)
        self.colours, self.edges = np.concatenate(colours), np.concatenate(edges)

    def at(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners of the faces that are there (n, 4, 3), colours of faces and edges in the light (n, 4)."""
        scenery = self.scenery
        corners = [s.rows[frame, 0] + s.points @ s.rows[frame, 1:] for s in scenery.solids]
        corners += [s.points[frame] for s in scenery.skins]
        points = np.concatenate([np.zeros((0, 3)), *corners])[self.faces]
        base, done = self.colours.copy(), self.skins
        for skin in scenery.skins:
            if skin.values is not None:
                base[done : done + len(skin.faces), :3] = along_map(skin.values[frame], skin.values)
            done += len(skin.faces)
        normals = np.cross(points[:, 2] - points[:, 0], points[:, 3] - points[:, 1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        lit = AMBIENT + (1 - AMBIENT) * np.abs(normals @ self.light)
        there = np.isfinite(lit)
        base[:, :3] = np.clip(base[:, :3] * lit[:, None], 0, 1)
        edges = base.copy()
        edges[:, :3] *= np.where(self.edges, 0.6, 1.0)[:, None]
        return points[there], base[there], edges[there]


def _fours(face: np.ndarray) -> list[list[int]]:
    """A face as faces of four corners; matplotlib draws arrays of them faster, and sorts them better."""
    cut = [[face[0], *face[k : k + 3]] for k in range(1, len(face) - 1, 2)]
    return [[int(a) for a in (*four, four[-1])[:4]] for four in cut]


class Stage:
    """A diagram on which pictures of a motion are shown, one after the other.

    Attributes:
        axes: three-dimensional, with equal scales, fitted to the whole motion.
    """

    def __init__(self, axes: Any, scenery: Scenery, *, labelled: bool = True, zoom: float = 1.0):
        self.axes, self.scenery = axes, scenery
        # The vertical axis comes last, in a cyclic order, so that hands are kept.
        self.order = [(int(np.abs(scenery.up).argmax()) + k) % 3 for k in (1, 2, 3)]
        axes.computed_zorder = False
        eye = scenery.eye()
        # Forces are drawn over all else, as in views: those of contacts are between bodies, or inside.
        forces = [s for s in scenery.solids if s.kind == "force"]
        bodies = scenery._replace(solids=[s for s in scenery.solids if s.kind != "force"])
        self.layers = [Faces(bodies, eye), Faces(scenery._replace(solids=forces, skins=[]), eye)]
        eye = eye[self.order]
        axes.set_proj_type("persp", focal_length=1.6)
        self.lattice = Line3DCollection(np.zeros((1, 2, 3)), colors="0.8", linewidths=0.6, zorder=1)
        self.plane = Poly3DCollection([np.zeros((4, 3))], facecolor="0.91", edgecolor="0.75", zorder=0)
        axes.view_init(np.degrees(np.arcsin(eye[2])), np.degrees(np.arctan2(eye[1], eye[0])))
        self._fit(zoom)
        if labelled:
            labels = [f"{'xyz'[k]} [m]" for k in self.order]
            axes.set(xlabel=labels[0], ylabel=labels[1], zlabel=labels[2])
            axes.tick_params(labelsize=7)
            for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
                axis.set_pane_color((0.97, 0.97, 0.98))
                axis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
        else:
            axes.set_axis_off()
        if scenery.ground is not None:
            axes.add_collection3d(self.plane)
            axes.add_collection3d(self.lattice)
            axes.grid(False)
        self.drawn = [
            axes.add_collection3d(Poly3DCollection([np.zeros((3, 3))], linewidths=0.3, zorder=2 + 2 * k))
            for k in range(len(self.layers))
        ]
        self.lines = [
            axes.plot([], [], [], color=trace.colour, linewidth=1.0, zorder=3)[0] for trace in scenery.traces
        ]

    def _fit(self, zoom: float) -> None:
        """Equal scales, and limits round the whole motion; round one picture where that travels far."""
        boxes, along, whole = self.scenery.boxes, self.order[2], self.scenery.extent
        # (What stands below, or is seen from below, has its ground above: then it is only in the way.)
        if self.scenery.ground is not None and self.scenery.up[along] > 0:
            boxes[:, 0, along] = self.scenery.ground
        size, most = np.ptp(whole, axis=0), np.ptp(boxes, axis=1).max(axis=0)
        self.travels = self.scenery.travels
        wanted = 1.2 * most if self.travels else size
        self.edges = (1 + 2 * MARGIN) * np.maximum(wanted, LEAST * max(wanted.max(), 1e-9))
        self.middles = boxes.mean(axis=1) if self.travels else np.tile(whole.mean(axis=0), (len(boxes), 1))
        if self.scenery.ground is not None and self.scenery.up[along] > 0:
            self.middles[:, along] = self.scenery.ground + 0.5 * self.edges[along]
        self.axes.set_box_aspect(self.edges[self.order], zoom=zoom)
        # Boxes are scaled by their diagonal: what is long in one direction would be cut off at its ends.
        self._look_at(0)
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        corners = boxes.mean(axis=1)[0] + signs * most if self.travels else whole.mean(axis=0) + signs * size
        x, y, z = corners[:, self.order].T
        places = np.stack(proj_transform(x, y, z, self.axes.get_proj())[:2], axis=1)
        within = self.axes.transAxes.inverted().transform(self.axes.transData.transform(places))
        too_large = 2 * np.abs(within - 0.5).max() / FILLED
        self.axes.set_box_aspect(self.edges[self.order], zoom=zoom / max(1.0, too_large))

    def _look_at(self, frame: int) -> None:
        """Limits of the axes, and the lattice on the ground."""
        lower = (self.middles[frame] - 0.5 * self.edges)[self.order]
        upper = (self.middles[frame] + 0.5 * self.edges)[self.order]
        for k, set_limits in enumerate((self.axes.set_xlim, self.axes.set_ylim, self.axes.set_zlim)):
            set_limits(lower[k], upper[k])
        height = self.scenery.ground
        if height is None:
            return
        step = rounded(max(upper[:2] - lower[:2]) / GRID)
        segments = []
        for k in (0, 1):
            for x in np.arange(np.ceil(lower[k] / step), np.floor(upper[k] / step) + 1) * step:
                ends = np.array([[lower[0], lower[1], height], [upper[0], upper[1], height]])
                ends[:, k] = x
                segments.append(ends)
        corners = [(lower[0], lower[1]), (upper[0], lower[1]), (upper[0], upper[1]), (lower[0], upper[1])]
        self.plane.set_verts([[(*corner, height) for corner in corners]])
        self.lattice.set_segments(segments)

    def show(self, frame: int, caption: str = "t = {:.2f} s") -> None:
        """Move everything to a picture of the scenery."""
        if self.travels:
            self._look_at(frame)
        for faces, drawn in zip(self.layers, self.drawn):
            corners, colours, edges = faces.at(frame)
            drawn.set_verts(corners[:, :, self.order] if len(corners) else np.zeros((1, 3, 3)))
            drawn.set_facecolor(colours)
            drawn.set_edgecolor(edges)
        for line, trace in zip(self.lines, self.scenery.traces):
            line.set_data_3d(*trace.points[: frame + 1, self.order].T)
        time = caption.format(self.scenery.t[frame])
        title = f"{self.scenery.title}\n{time}" if self.scenery.title else time
        self.axes.set_title(title, fontsize=10)
