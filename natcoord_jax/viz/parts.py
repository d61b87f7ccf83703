"""From a system and its states to what there is to draw: bodies, joints, springs, forces, traces, ground."""

import re
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.shapes import Surface
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.state import Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.arrows import between, links, loads, pushes
from natcoord_jax.viz.outline import ball, bar, bodies_of, centre_of, marked
from natcoord_jax.viz.outline import within as inside_of
from natcoord_jax.viz.scenery import DARK, PALETTE, Scenery, Solid, Trace
from natcoord_jax.viz.skins import (
    Colouring,
    beam_skins,
    drawn_bodies,
    element_skins,
    with_ground,
)

Meshes = dict[int, tuple[Surface, bool] | None]
"""Meshes of the bodies that are drawn, by their numbers, and whether they are round."""


def merged(meshes: Sequence[Surface]) -> Surface:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    faces = [start + np.asarray(face) for start, (_, mesh) in zip(starts, meshes) for face in mesh]
    return np.concatenate([np.zeros((0, 3)), *(points for points, _ in meshes)]), faces


def _named_joints(system: System) -> list[int]:
    return [j for j, name in enumerate(system.structure.joints) if name]


def _natural(name: str) -> list[tuple[int, str]]:
    """For sorting: "link 2" before "link 10"."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def seats(system: System) -> np.ndarray:
    """Frames of the joints where they are drawn: weights (joints, 2, 4, 4), as `system.frames`.

    A hinge may be given anywhere on its axis. Far off, as the head of a bicycle where its axis meets the
    road, it is drawn on the axis where the child is.
    """
    frames, mass = np.array(system.frames), np.asarray(system.mass)
    pairs = np.asarray(system.joint_bodies)
    for group in system.joints:
        joint: Any = group.effect
        if not joint.free or len(joint.rotations) != 1 or joint.translations:
            continue
        for j in (int(j) for j in np.asarray(group.joints).reshape(-1)):
            side = 1 if pairs[j, 1] < len(mass) else 0
            block, own = mass[pairs[j, side]], frames[j, side]
            away = centre_of(block) - own[0, 1:]
            along = float(away @ own[3, 1:])
            if abs(along) > np.linalg.norm(away - along * own[3, 1:]):
                frames[j, :, 0] += along * frames[j, :, 3]
    return frames


def _bodies(system: System, meshes: Meshes, rows: np.ndarray, scale: float) -> list[Solid]:
    """Bodies with arms to their joints, in the order of their names."""
    names, frames = system.structure.bodies, seats(system)
    pairs, mass, found = np.asarray(system.joint_bodies), np.asarray(system.mass), []
    for number, k in enumerate(sorted(meshes, key=lambda k: _natural(names[k]))):
        centre = centre_of(mass[k])
        mesh, colour = meshes[k], PALETTE[number % len(PALETTE)]
        small, faces = ball(0.02 * scale)
        own, is_round = mesh or ((centre + small, faces), False)
        (points, faces), shade = marked(own) if is_round else (own, np.ones(len(own[1])))
        found.append(Solid(names[k], "body", points, faces, rows[:, k], colour, shade))
        sides = [(j, side) for j in _named_joints(system) for side in (0, 1) if pairs[j, side] == k]
        ends = [end for j, side in sides if not inside_of(own, end := frames[j, side, 0, 1:])]
        # A shape somewhere else, as one for contact, hangs on the centre of mass, too.
        ends += [] if inside_of(own, centre) else [0.5 * (own[0].min(axis=0) + own[0].max(axis=0))]
        arms = [bar(0.007 * scale, centre, end) for end in ends]
        if arms:
            points, faces = merged(arms)
            found.append(Solid(names[k], "arm", points, faces, rows[:, k], colour, np.full(len(faces), 0.85)))
    return found


def _glyph(joint: Any, r: float) -> Surface | None:
    """What is drawn of a joint: a ball, or bars along the axes it turns about or slides along."""
    axes = np.eye(3)
    if not joint.free or len(joint.rotations) == 3:
        return ball(1.5 * r)
    meshes = [bar(r, -2.4 * r * axes[a], 2.4 * r * axes[a]) for a in joint.rotations]
    meshes += [bar(0.5 * r, -7 * r * axes[a], 7 * r * axes[a]) for a in joint.translations]
    return merged(meshes) if meshes else None


def _joints(system: System, rows: np.ndarray, scale: float) -> list[Solid]:
    found = []
    names, pairs, frames = system.structure.joints, np.asarray(system.joint_bodies), seats(system)
    for group in system.joints:
        joint: Any = group.effect
        for j in (int(j) for j in np.asarray(group.joints).reshape(-1)):
            if not names[j]:
                continue
            places = [np.einsum("ma,tac->tmc", frames[j, s], rows[:, pairs[j, s]]) for s in (0, 1)]
            if joint.apart:
                found += [between(names[j], places[0][:, 0], places[1][:, 0], 0.006 * scale, coiled=False)]
                continue
            mesh = _glyph(joint, 0.011 * scale)
            if mesh is not None:
                shade = np.ones(len(mesh[1]))
                # A rail is part of the first body; what moves in a plane shows on the second.
                at = places[1 if len(joint.translations) > 1 else 0]
                found.append(Solid(names[j], "joint", *mesh, at, DARK, shade))
    return found


def _up(system: System) -> tuple[np.ndarray, bool]:
    """Direction against gravity, and whether there is any."""
    for group in system.effects:
        if group.effect.kind == "gravity":
            gravity: Any = group.effect
            down = np.asarray(gravity.vector, float).reshape(-1)[:3]
            if np.linalg.norm(down) > 0:
                return -down / np.linalg.norm(down), True
    return np.array([0.0, 0.0, 1.0]), False


def _scale(system: System, meshes: Meshes, rows: np.ndarray, skins: Sequence[Any]) -> float:
    """Diagonal of the box around everything in the first picture [m]."""
    pairs, frames = np.asarray(system.joint_bodies), np.asarray(system.frames)
    points = [rows[:1, : len(system.structure.bodies), 0].reshape(-1, 3)]
    points += [skin.points[0] for skin in skins]
    points += [frames[j, 0, 0] @ rows[:1, pairs[j, 0]][0][None] for j in _named_joints(system)]
    for k, mesh in meshes.items():
        if mesh is not None:
            points.append(rows[0, k, 0] + mesh[0][0] @ rows[0, k, 1:])
    every = np.concatenate([p.reshape(-1, 3) for p in points])
    every = every[np.isfinite(every).all(axis=1)]
    return float(np.linalg.norm(np.ptp(every, axis=0))) or 1.0 if len(every) else 1.0


def _seen(rows: np.ndarray, box: Any) -> np.ndarray:
    """Rows of bodies (t, bodies and ground, 4, 3), those outside of a box not there."""
    if box is None:
        return rows
    lower, upper = np.asarray(box, float)
    inside = ((rows[:, :, 0] >= lower) & (rows[:, :, 0] <= upper)).all(axis=-1)
    inside[:, -1] = True  # the ground, on which the sides of springs and joints may be
    return np.where(inside[:, :, None, None], rows, np.nan)


def scenery_of(
    system: System,
    trajectory: Trajectory,
    saved: np.ndarray,
    *,
    beams: Sequence[BeamHandle] = (),
    traces: Sequence[Marker] = (),
    colour: Colouring = "parts",
    title: str = "",
    within: Any = None,
) -> Scenery:
    """What there is to draw of a trajectory of one lane.

    Args:
        system: compiled system.
        trajectory: computed with it.
        saved: numbers of the saved states that are drawn.
        beams: handles, whose sections are known; the other beams are round.
        traces: points whose paths are drawn.
        colour: "energy", "parts", or values of elements by name, see `nc.view`.
        title: one line.
        within: corners of the box (2, 3) [m] that is looked into; None: all is seen.
    """
    states = jax.tree.map(lambda x: x[saved], trajectory.states)
    rows = _seen(with_ground(np.asarray(states.q)), within)
    skins = [
        *beam_skins(system, states, rows, saved, colour, beams),
        *element_skins(system, states, rows, saved, colour),
    ]
    unknown = set() if isinstance(colour, str) else set(colour) - {skin.name for skin in skins}
    if unknown:
        known = sorted(skin.name for skin in skins)
        raise ValueError(f"colour: nothing with elements is called {sorted(unknown)[0]!r}; there is {known}")
    meshes = bodies_of(system, drawn_bodies(system))
    scale = _scale(system, meshes, rows, skins)
    given = np.asarray(trajectory.inputs)
    inputs = given[np.clip(saved - 1, 0, len(given) - 1)] if len(given) else np.zeros((len(saved), 0))
    solids = [
        *_bodies(system, meshes, rows, scale),
        *_joints(system, rows, scale),
        *links(system, rows, scale),
        *loads(system, states, rows, inputs, scale),
        *pushes(system, trajectory, saved, rows, scale),
    ]
    if within is not None:
        solids = [s for s in solids if np.isfinite(s.rows).any()]
        skins = [s for s in skins if np.isfinite(s.points).any()]
    start = jax.tree.map(lambda x: x[0], trajectory.states)
    paths = [np.asarray(system.sense(states, point, state=start).position) for point in traces]
    lines = [
        Trace(f"path of {point.body.name}", path, PALETTE[(3 + k) % len(PALETTE)])
        for k, (point, path) in enumerate(zip(traces, paths))
    ]
    up, falls = _up(system)
    found = Scenery(np.asarray(states.t), solids, skins, lines, up, None, title)
    if not falls:
        return found
    heights = [np.nanmin(s.corners @ up) for s in solids if s.kind == "body"]
    heights += [np.nanmin(s.points @ up) for s in skins]
    return found._replace(ground=float(min(heights, default=0.0)))
