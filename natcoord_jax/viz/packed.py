"""A scenery as one HTML file: meshes and motion as compressed numbers, and the script that plays them.

Numbers are whole multiples of a step, 16 bits each: of what is a metre long, a step is 15 micrometres. Along
time their differences are stored, which compress better.
"""

import base64
import json
import re
import zlib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.viz.scenery import STOPS, Scenery, Skin, Solid, limits, rounded

MISSING, MOST = -32768, 32767
SMOOTH, CREASE = np.cos(np.deg2rad(35.0)), np.cos(np.deg2rad(60.0))
"""Faces that meet at less than the first angle look round together; at more than the second is an edge."""


class Blob:
    """Bytes of all arrays, one after the other, and what they are."""

    def __init__(self):
        self.parts: list[bytes] = []
        self.size = 0

    def _place(self, data: np.ndarray) -> dict[str, Any]:
        raw = data.tobytes()
        raw += b"\0" * (-len(raw) % 4)
        found = {"at": self.size, "count": int(data.size)}
        self.parts.append(raw)
        self.size += len(raw)
        return found

    def whole(self, numbers: np.ndarray) -> dict[str, Any]:
        """Whole numbers as they are."""
        return self._place(np.ascontiguousarray(numbers, np.int32))

    def real(self, values: np.ndarray, stride: int = 0) -> dict[str, Any]:
        """Real numbers, as multiples of a step; NaN where there are none.

        Args:
            values: any shape.
            stride: how many numbers a picture has, where there are several.
        """
        flat = np.asarray(values, float).reshape(-1)
        known = flat[np.isfinite(flat)]
        least, most = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
        step = (most - least) / (2 * MOST) or 1.0
        with np.errstate(invalid="ignore"):
            scaled = np.where(np.isfinite(flat), np.round((flat - least) / step) - MOST, MISSING)
        numbers = scaled.astype(np.int16)
        if stride:
            with np.errstate(over="ignore"):
                numbers[stride:] -= numbers[:-stride]
        return {**self._place(numbers), "least": least + MOST * step, "step": step, "stride": stride}

    def text(self) -> str:
        """All of it, compressed, in base 64."""
        return base64.b64encode(zlib.compress(b"".join(self.parts), 9)).decode("ascii")


def _face_normals(points: np.ndarray, faces: Sequence[np.ndarray]) -> Float[np.ndarray, "faces 3"]:
    normals = np.stack(
        [np.cross(points[f], points[np.roll(f, -1)]).sum(axis=0) for f in map(np.asarray, faces)]
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def triangles(solid: Solid) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners and normals of the triangles of a mesh (n, 3), brightness (n,), ends of its edges (m, 3)."""
    points, faces = solid.points, [np.asarray(face) for face in solid.faces]
    normals = _face_normals(points, faces)
    around: dict[int, list[int]] = {}
    sides: dict[tuple[int, int], list[int]] = {}
    for k, face in enumerate(faces):
        for a, b in zip(face.tolist(), np.roll(face, -1).tolist()):
            around.setdefault(a, []).append(k)
            sides.setdefault((min(a, b), max(a, b)), []).append(k)
    corners, smooth, shade = [], [], []
    for k, face in enumerate(faces):
        own = []
        for a in face.tolist():
            near = normals[around[a]]
            along = near @ normals[k]
            # Faces need not be listed in one sense of turning.
            own.append((np.sign(along) * (np.abs(along) > SMOOTH)) @ near)
        fan = [n for j in range(1, len(face) - 1) for n in (0, j, j + 1)]
        corners.append(points[face[fan]])
        smooth.append(np.stack(own)[fan])
        shade.append(np.full(len(fan), solid.shade[k]))
    sharp = [
        side for side, own in sides.items()
        if side[0] != side[1] and (len(own) != 2 or abs(normals[own[0]] @ normals[own[1]]) < CREASE)
    ]  # fmt: skip
    lines = points[np.array(sharp, int).reshape(-1)] if sharp else np.zeros((0, 3))
    directions = np.concatenate(smooth)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
    return np.concatenate(corners), directions, np.concatenate(shade), lines


@cache
def _asset(name: str) -> str:
    return resources.files("natcoord_jax.viz").joinpath(name).read_text("utf-8")


def bytes_of_a_picture(scenery: Scenery) -> int:
    """What one time more takes, before compression."""
    skins = sum(
        2 * s.points[0].size + (0 if s.values is None else 2 * s.values.shape[1]) for s in scenery.skins
    )
    return 24 * len(scenery.solids) + 6 * len(scenery.traces) + skins


def page(lanes: Sequence[Scenery], pace: float, follow: str) -> str:
    """The HTML file of a motion.

    Args:
        lanes: one, or several of one batch, with the same parts and times.
        pace: seconds of the motion in a second of the reader's.
        follow: name of a body that the camera follows; "" for none.
    """
    first, blob = lanes[0], Blob()
    meshes: dict[bytes, int] = {}
    listed: list[dict[str, Any]] = []
    solids = [_solid([s.solids[k] for s in lanes], blob, meshes, listed) for k in range(len(first.solids))]
    skins = [_skin([s.skins[k] for s in lanes], blob) for k in range(len(first.skins))]
    traces = []
    for k, trace in enumerate(first.traces):
        every = np.stack([s.traces[k].points for s in lanes])
        traces.append({"name": trace.name, "colour": trace.colour, "points": blob.real(every, 3)})
    extents = np.stack([s.extent for s in lanes])
    size = float(np.linalg.norm(extents[:, 1].max(axis=0) - extents[:, 0].min(axis=0))) or 1.0
    span = float(first.t[-1] - first.t[0])
    travels = len(lanes) == 1 and first.travels
    reach = first.reach if travels or follow else size
    scene = {
        "title": first.title,
        "times": [float(f"{t:.9g}") for t in first.t],
        "digits": max(2, 2 - int(np.floor(np.log10(span)))) if span > 0 else 2,
        "pace": pace,
        "lanes": len(lanes),
        "up": first.up.tolist(),
        "ground": None if first.ground is None else min(s.ground for s in lanes if s.ground is not None),
        "extent": [extents[:, 0].min(axis=0).tolist(), extents[:, 1].max(axis=0).tolist()],
        "size": size,
        "reach": reach,
        "cell": rounded(0.2 * reach),
        "eye": first.eye().tolist(),
        "follow": follow or (_largest(first) if travels else ""),
        "bodies": first.bodies,
        "colours": STOPS.tolist(),
        "meshes": listed,
        "solids": solids,
        "skins": skins,
        "traces": traces,
    }
    title = first.title.replace("&", "&amp;").replace("<", "&lt;")
    # What ends a script, in the name of a body, must not end this one.
    text = json.dumps(scene, ensure_ascii=False, allow_nan=False).replace("</", "<\\/")
    filled = {"TITLE": title, "SCENE": text, "PACKED": blob.text(), "PLAYER": _asset("player.js")}
    return re.sub("|".join(filled), lambda found: filled[found[0]], _asset("player.html"))


def _largest(scenery: Scenery) -> str:
    """Name of the body or surface that takes most room: what the eye goes along with."""
    sizes = {s.name: float(np.ptp(s.points, axis=0).max()) for s in scenery.solids if s.kind == "body"}
    sizes |= {s.name: float(np.ptp(s.points[0], axis=0).max()) for s in scenery.skins}
    return max(sizes, key=lambda name: sizes[name], default="")


def _solid(
    same: list[Solid], blob: Blob, meshes: dict[bytes, int], listed: list[dict[str, Any]]
) -> dict[str, Any]:
    """A solid of all lanes; meshes that are alike are stored once."""
    solid = same[0]
    faces = np.concatenate([np.append(face, -1) for face in solid.faces])
    key = b"".join(x.tobytes() for x in (np.round(solid.points, 12), faces, solid.shade))
    if key not in meshes:
        place, normal, shade, lines = triangles(solid)
        meshes[key] = len(listed)
        arrays = {"place": place, "normal": normal, "shade": shade, "lines": lines}
        listed.append({name: blob.real(array) for name, array in arrays.items()})
    return {
        "name": solid.name,
        "kind": solid.kind,
        "colour": solid.colour,
        "rigid": solid.rigid,
        "mesh": meshes[key],
        "centre": solid.points.mean(axis=0).tolist(),
        "rows": blob.real(np.stack([s.rows for s in same]), 12),
    }


def _skin(same: list[Skin], blob: Blob) -> dict[str, Any]:
    """A surface of all lanes, its values on one scale."""
    skin, size = same[0], int(same[0].points[0].size)
    found: dict[str, Any] = {
        "name": skin.name,
        "colour": skin.colour,
        "edges": skin.edges,
        "size": size,
        "faces": blob.whole(skin.faces),
        "points": blob.real(np.stack([s.points for s in same]), size),
        "values": None,
        "label": skin.label,
    }
    if skin.values is not None:
        values = np.stack([s.values for s in same if s.values is not None])
        found |= {"values": blob.real(values, len(skin.faces)), "range": limits(values)}
    return found
