"""Springs, dampers and rods between two points: what is stretched from one place to another."""

import numpy as np

from natcoord_jax.system import System
from natcoord_jax.viz.outline import bar, coil
from natcoord_jax.viz.scenery import STEEL, Solid
from natcoord_jax.viz.skins import markers_of, places_of

MOST_COILS = 40
"""More springs than this are drawn as bars."""


def frame_along(start: np.ndarray, along: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
    """Frames (t, 4, 3) whose third vectors are given, the others of this length; NaN where these are zero."""
    length = np.linalg.norm(along, axis=1, keepdims=True)
    there = length > 0
    third = np.where(there, along, np.nan) / np.where(there, length, 1.0)
    # Across from the axis that it stays farthest from.
    reached = np.nan_to_num(np.abs(third)).max(axis=0, initial=0.0)
    first = np.cross(third, np.eye(3)[reached.argmin()])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    rows = np.stack([start, radius * first, radius * np.cross(third, first), along], axis=1)
    rows[np.isnan(rows).any(axis=(1, 2))] = np.nan
    return rows


def between(name: str, start: np.ndarray, end: np.ndarray, radius: float, *, coiled: bool) -> Solid:
    """A coil or a bar from one point to another (t, 3)."""
    points, faces = coil() if coiled else bar(1.0, np.zeros(3), np.array([0.0, 0, 1]))
    rows = frame_along(start, end - start, radius)
    return Solid(name, "link", points, faces, rows, STEEL, np.ones(len(faces)), rigid=False)


def links(system: System, rows: np.ndarray, scale: float) -> list[Solid]:
    """Springs, dampers and rods: whatever sits on two points."""
    found = []
    for group in system.effects:
        if not group.effect.drawn or group.weights is None or group.weights.ndim != 3:
            continue
        if group.weights.shape[1] != 2:
            continue
        if not np.allclose(markers_of(group)[0][..., 0].sum(axis=-1), 1.0):
            continue
        coiled = group.effect.stores and group.count <= MOST_COILS
        ends = places_of(group, rows)
        for k, name in enumerate(group.names):
            radius = scale * (0.018 if coiled else 0.006)
            found.append(between(name, ends[:, k, 0], ends[:, k, 1], radius, coiled=coiled))
    return found
