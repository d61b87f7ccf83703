"""Arrows: forces and torques of loads, motors and contacts; and what is stretched between two points."""

import dataclasses
import re
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.analysis.contacts import contacts, touching
from natcoord_jax.analysis.searched_contacts import capsules, near_pairs, searching, touch
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.force import Force
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.effects.contact import DiscreteGap
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.response import gather, motion_between, no_multipliers, respond, situation
from natcoord_jax.model.groups import Group
from natcoord_jax.system import System
from natcoord_jax.viz.outline import arrow, bar, centre_of, coil, turning_arrow
from natcoord_jax.viz.scenery import GREEN, RED, STEEL, Colour, Solid
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


LONGEST, WIDEST = 0.2, 0.09
"""Length of the largest force and radius of the largest torque, relative to the scene."""
NOTHING = 1e-6
"""What is less than this, relative to the largest of its kind, is not drawn."""


STRONGEST = 24
"""Arrows of a contact of surfaces, and of one that looks for its pairs."""


class Acting(NamedTuple):
    """A force [N] or a torque [N m] at a place [m], each (t, 3)."""

    name: str
    place: np.ndarray
    vector: np.ndarray


def _drawn(acting: Sequence[Acting], scale: float, colour: Colour, *, turning: bool = False) -> list[Solid]:
    """Arrows; the largest of all has the full size."""
    sizes = [float(np.nan_to_num(np.abs(a.vector)).max(initial=0.0)) for a in acting]
    largest = max(sizes, default=0.0)
    points, faces = turning_arrow() if turning else arrow()
    found = []
    for (name, place, vector), size in zip(acting, sizes):
        if size > NOTHING * largest:
            along = (WIDEST if turning else LONGEST) * scale / largest * vector
            long = np.linalg.norm(along, axis=1, keepdims=True)
            wide = long if turning else np.minimum(0.014 * scale, 0.2 * long)
            rows = frame_along(place, along, wide)
            found.append(Solid(name, "force", points, faces, rows, colour, np.ones(len(faces)), rigid=False))
    return found


def _of_force(system: System, group: Group, states: State, rows: np.ndarray, inputs: np.ndarray) -> Any:
    """Forces at the points of a load, and torques at the centres of the bodies that it turns."""
    x, given = places_of(group, rows), inputs[:, np.asarray(group.inputs)]
    each = jax.vmap(lambda effect, x, u, t: effect.load(x, 0 * x, u, t),
                    in_axes=(None if group.effect.shared else 0, 0, 0, None))  # fmt: skip
    found = jax.vmap(each, in_axes=(None, 0, 0, 0))(group.effect, x, given, np.asarray(states.t))
    loads, turning = np.asarray(found.forces), np.asarray(found.torques)
    weights, bodies = markers_of(group)
    forces, torques, mass, names = [], [], np.asarray(system.mass), list(group.names)
    if found.forces is not None:
        at = np.isclose(weights[..., 0].sum(axis=-1), 1.0)
        forces = [Acting(names[n], x[:, n, k], loads[:, n, k]) for n, k in np.argwhere(at)]
    for n in range(0 if found.torques is None else group.count):
        on = [k for k in range(x.shape[2]) if bodies[n, k, 0] < len(mass) and np.any(turning[:, n, k])]
        # Of a torque between two bodies, that on the second.
        for k in on[-1:] if np.allclose(turning[:, n].sum(axis=1), 0.0) else on:
            block, body = mass[bodies[n, k, 0]], rows[:, bodies[n, k, 0]]
            centre = np.append(1.0, centre_of(block))
            torques.append(Acting(names[n], centre @ body, turning[:, n, k]))
    return forces, torques


def _of_motor(system: System, group: Group, states: State, inputs: np.ndarray) -> Any:
    """Forces and torques of an input on joint coordinates, on the child of each joint at its point."""

    @eager_numpy
    @partial(jax.vmap, in_axes=(0, 0))
    def on_frames(state: State, u: Any) -> tuple[Any, Any, Any]:
        """In a step of length zero: forces, torques about the points of the frames, and these."""
        still = jnp.zeros(())
        motion = gather(group, motion_between(state, state, still))
        where = situation(system, group, state, u, still)
        answer = respond(group, where, motion, no_multipliers(group, gauss(1), u.dtype), gauss(1))
        body = motion.rows[0]
        points = jnp.einsum("nka,nkac->nkc", where.place[..., 0, :].reshape(*body.shape[:2], 4), body)
        on_rows = jnp.zeros_like(body) if answer.forces is None else answer.forces[:, 0]
        turning = jnp.zeros_like(points) if answer.torques is None else answer.torques[:, 0]
        turning = turning + jnp.sum(jnp.cross(body, on_rows), axis=2) - jnp.cross(points, on_rows[:, :, 0])
        return on_rows[:, :, 0], turning, points

    force, torque, points = map(np.asarray, on_frames(states, jnp.asarray(inputs)))
    children = [(n, k) for n in range(group.count) for k in range(1, points.shape[2], 2)]
    forces, torques = (
        [Acting(group.names[n], points[:, n, k], found[:, n, k]) for n, k in children]
        for found in (force, torque)
    )
    return forces, torques


def loads(system: System, states: State, rows: np.ndarray, inputs: np.ndarray, scale: float) -> list[Solid]:
    """Forces and torques of loads and inputs: straight arrows, and turning ones."""
    forces, torques = [], []
    for group in system.effects:
        marked = group.weights is not None and group.weights.ndim == 3
        if isinstance(group.effect, Force) and marked:
            found = _of_force(system, group, states, rows, inputs)
        elif group.effect.inputs and group.source == "coordinates":
            found = _of_motor(system, group, states, inputs)
        else:
            continue
        forces += found[0]
        torques += found[1]
    return _drawn(forces, scale, RED) + _drawn(torques, scale, RED, turning=True)


@eager_numpy
def _touching(effects: Any, places: Any, rows: Any) -> tuple[Any, Any]:
    each = jax.vmap(lambda effect, place, rows: effect.touch(place, rows))
    return jax.vmap(lambda rows: each(effects, places, rows))(rows)


def _touch(group: Group, rows: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where some contacts of a group are, and how what is in front of them is pushed (t, n, 3)."""
    given = group.effect, group.weights
    effects, places = jax.tree.map(lambda x: as_array(np.asarray(x)[chosen]), given)
    place, normal = _touching(effects, places, as_array(rows[:, np.asarray(group.bodies)[chosen]]))
    return np.asarray(place), np.asarray(normal)


def _of_surfaces(group: Group, names: np.ndarray, force: np.ndarray, rows: np.ndarray) -> list[Acting]:
    """The strongest nodes on surfaces: passes push against each other, so that a sum would be none."""
    found, most = [], force.max(axis=0)
    for name in dict.fromkeys(names.tolist()):
        own = np.flatnonzero((names == name) & (most > 0))
        chosen = own[np.argsort(-most[own], kind="stable")[:STRONGEST]]
        if chosen.size:
            places, normals = _touch(group, rows, chosen)
            acting = force[:, chosen, None] * normals
            found += [Acting(name, places[:, k], acting[:, k]) for k in range(chosen.size)]
    return found


def _of_searched(system: System, pairs: Trajectory, states: State, force: np.ndarray) -> list[Acting]:
    """The strongest pairs of each contact that looks for them."""
    acting, begin = [], 0
    every = [ends[:, k] for ends in capsules(system, states) for k in range(ends.shape[1])]
    for found, ends in zip(near_pairs(system, pairs), every):
        own = force[:, begin : begin + len(found.names)]
        begin += len(found.names)
        most = own.max(axis=0)
        chosen = np.argsort(-most, kind="stable")[:STRONGEST]
        chosen = chosen[most[chosen] > 0]
        places, normals = map(np.asarray, touch(found.law, ends, found.pairs[:, chosen]))
        acting += [
            Acting(found.names[n], places[:, k], own[:, n, None] * normals[:, k])
            for k, n in enumerate(chosen)
        ]
    return acting


def _owner(name: str) -> str:
    """The contact that a gap is of: those with several call them "name[0]", or "name[one, other, 0]"."""
    numbered = re.fullmatch(r"(.*)\[\d+\]|(.*\[.+, .+), \d+\]", name)
    return name if numbered is None else numbered[1] or f"{numbered[2]}]"


def _of_gaps(names: np.ndarray, force: np.ndarray, places: np.ndarray, normals: np.ndarray) -> list[Acting]:
    """Of several gaps of a contact their sum, at its middle."""
    acting = []
    for name in dict.fromkeys(names.tolist()):
        own = force[:, names == name, None]
        total = own.sum(axis=1)
        middle = (own * places[:, names == name]).sum(axis=1) / np.where(total > 0, total, np.nan)
        acting.append(Acting(name, middle, (own * normals[:, names == name]).sum(axis=1)))
    return acting


def pushes(
    system: System, trajectory: Trajectory, saved: np.ndarray, rows: np.ndarray, scale: float
) -> list[Solid]:
    """Normal forces of contacts, on average over the step before; of surfaces they are on nodes."""
    groups, searched = touching(system), searching(system)
    unknown = trajectory.states.contacts is None and any(g.effect.unilateral for g in groups)
    if not groups + searched or len(trajectory) < 2 or unknown:
        return []
    steps = np.maximum(saved, 1)[:, None] + np.array([-1, 0])
    pairs = dataclasses.replace(trajectory, states=jax.tree.map(lambda x: x[steps], trajectory.states))
    found = contacts(system, pairs)
    ends = np.cumsum([0, *(group.count for group in groups)])
    owners = np.array([_owner(name) for name in found.names[: ends[-1]]])
    acting, others = [], []
    for group, some in zip(groups, np.split(np.arange(len(owners)), ends[1:-1])):
        if isinstance(group.effect, DiscreteGap):
            acting += _of_surfaces(group, owners[some], found.force[:, 0, some], rows)
        else:
            others.append((some, *_touch(group, rows, np.arange(group.count))))
    if others:
        chosen = np.concatenate([some for some, *_ in others])
        places, normals = (np.concatenate(x, axis=1) for x in list(zip(*others))[1:])
        acting = _of_gaps(owners[chosen], found.force[:, 0, chosen], places, normals) + acting
    if searched:
        states = jax.tree.map(lambda x: x[saved], trajectory.states)
        acting += _of_searched(system, pairs, states, found.force[:, 0, ends[-1] :])
    return _drawn(acting, scale, GREEN)
