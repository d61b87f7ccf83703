"""Springs, dampers and rods between two points, and forces: what is stretched from one place to another."""

from typing import Any

import jax
import numpy as np

from natcoord_jax.core.force import Force
from natcoord_jax.core.state import State
from natcoord_jax.system import System
from natcoord_jax.viz.outline import arrow, bar, coil
from natcoord_jax.viz.scenery import RED, STEEL, Solid
from natcoord_jax.viz.skins import markers_of, places_of

MOST_COILS = 40
"""More springs than this are drawn as bars."""


def between(
    name: str, start: np.ndarray, end: np.ndarray, radius: float, *, coiled: bool, kind: str = "link"
) -> Solid:
    """A coil, a bar or an arrow from one point to another (t, 3)."""
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    third = along / np.where(length > 0, length, np.nan)
    first = np.cross(third, np.eye(3)[np.abs(np.nan_to_num(third[0])).argmin()])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    rows = np.stack([start, radius * first, radius * np.cross(third, first), along], axis=1)
    rows[np.isnan(rows).any(axis=(1, 2))] = np.nan
    if kind == "force":
        points, faces = arrow()
        return Solid(name, kind, points, faces, rows, RED, np.ones(len(faces)), rigid=False)
    points, faces = coil() if coiled else bar(1.0, np.zeros(3), np.array([0.0, 0, 1]))
    return Solid(name, kind, points, faces, rows, STEEL, np.ones(len(faces)), rigid=False)


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


def _loads(group: Any, x: np.ndarray, inputs: np.ndarray, t: np.ndarray) -> np.ndarray | None:
    """Forces [N] on the markers of the instances of a group (t, n, k, 3); None: torques only."""

    def one(effect: Any, x: Any, u: Any, t: Any) -> Any:
        return effect.load(x, 0 * x, u, t).forces

    each = jax.vmap(one, in_axes=(None if group.effect.shared else 0, 0, 0, None))
    found = jax.vmap(each, in_axes=(None, 0, 0, 0))(group.effect, x, inputs[:, np.asarray(group.inputs)], t)
    return None if found is None else np.asarray(found)


def forces(system: System, states: State, rows: np.ndarray, inputs: np.ndarray, scale: float) -> list[Solid]:
    """Forces at points, as arrows: the largest is a fifth of the scene long."""
    drawn = []
    for group in system.effects:
        if not isinstance(group.effect, Force) or group.weights is None or group.weights.ndim != 3:
            continue
        x = places_of(group, rows)
        loads = _loads(group, x, inputs, np.asarray(states.t))
        if loads is not None:
            at = np.isclose(markers_of(group)[0][..., 0].sum(axis=-1), 1.0)
            drawn += [(group.names[n], x[:, n, k], loads[:, n, k]) for n, k in np.argwhere(at)]
    largest = max((float(np.abs(force).max()) for _, _, force in drawn), default=0.0)
    found = []
    for name, start, force in drawn:
        if np.abs(force).max() > 1e-6 * largest:
            end = start + 0.2 * scale / largest * force
            found.append(between(name, start, end, 0.014 * scale, coiled=False, kind="force"))
    return found
