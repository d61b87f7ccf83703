"""Surfaces that change their shape: swept beams, shells and the outside of solids, coloured by values."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.core.bodies import NODE, by_node
from natcoord_jax.core.names import Names
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.momentum import group_energies
from natcoord_jax.model.groups import Group
from natcoord_jax.model.rows import over_states
from natcoord_jax.system import System
from natcoord_jax.viz.scenery import PALETTE, Skin

RIM = 12
"""Most corners of the rim of a section."""
STOUTEST = 0.02
"""Largest radius of a beam whose section is not known, relative to its length."""
Colouring = str | Mapping[str, Any]
"""What surfaces are coloured by: "energy", "parts", or values of the elements by name."""


def with_ground(q: Float[np.ndarray, "t rows 3"]) -> Float[np.ndarray, "t bodies_and_ground 4 3"]:
    """Rows by body, those of the ground last."""
    ground = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    rows = by_node(q)
    return np.concatenate([rows, np.broadcast_to(ground, (len(q), 1, *NODE))], axis=1)


def markers_of(group: Group) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, k, *m, b, 4) of the markers of a group, and their bodies (n, k, b)."""
    weights, bodies = np.asarray(group.weights), np.asarray(group.bodies)
    each = weights.shape[-1] // 4
    return weights.reshape(*weights.shape[:-1], each, 4), bodies.reshape(*weights.shape[:2], each)


def places_of(group: Group, rows: Float[np.ndarray, "t bodies 4 3"]) -> Float[np.ndarray, "t n k *m 3"]:
    """Where the markers of a group are."""
    weights, bodies = markers_of(group)
    shared = rows[:, bodies]
    if weights.ndim == 5:
        return np.einsum("nkmba,tnkbac->tnkmc", weights, shared)
    return np.einsum("nkba,tnkbac->tnkc", weights, shared)


def _chains(system: System) -> list[Group]:
    """Effects between frames of bodies that make a chain of these and store energy: elements of beams."""
    groups = (g for g in system.effects if g.effect.couples and g.effect.stores)
    return [g for g in groups if g.weights is not None and g.weights.ndim == 4 and not type(g.effect).faces]


def _beam_of(element: str) -> str:
    """Name of the beam that an element belongs to: elements are called "beam/element 0" and so on."""
    return element.rpartition("/")[0]


def drawn_bodies(system: System) -> list[int]:
    """Numbers of the bodies that are drawn as such: not those of the nodes of sets and of beams."""
    names = system.structure.bodies
    beams = {_beam_of(name) for group in _chains(system) for name in group.names}
    found = []
    for number, name in enumerate(names):
        owner, _, rest = name.rpartition("/")
        of_a_set = isinstance(names, Names) and name.endswith("]")
        if not of_a_set and not (owner and owner in beams and rest.startswith("node ")):
            found.append(number)
    return found


def energies(system: System, group: Group, states: State) -> Float[np.ndarray, "t n"]:
    """Energy stored in each element [J]."""
    return np.asarray(over_states(lambda system, state: group_energies(system, group, state))(system, states))


def _sizes(corners: Float[np.ndarray, "n k 3"], faces: np.ndarray) -> Float[np.ndarray, " n"]:
    """Areas of elements with one face [m^2], volumes of those with more [m^3]."""
    around = corners[:, faces]
    areas = 0.5 * np.cross(around[:, :, 2] - around[:, :, 0], around[:, :, 3] - around[:, :, 1])
    if len(faces) == 1:
        return np.linalg.norm(areas[:, 0], axis=-1)
    heights = around.mean(axis=2) - corners.mean(axis=1)[:, None]
    return np.abs(np.sum(areas * heights, axis=-1)).sum(axis=1) / 3


def _values(
    name: str, count: int, states: State, saved: np.ndarray, colouring: Colouring, density: Any, unit: str
) -> tuple[np.ndarray | None, str]:
    """Values of the elements (t, elements) and what they are; None: the colour of the part.

    Raises:
        ValueError: for values of another number of elements or times.
    """
    if isinstance(colouring, str):
        return (density(), f"stored energy [{unit}]") if colouring == "energy" else (None, "")
    if name not in colouring:
        return None, ""
    given = np.asarray(colouring[name], float)
    if given.ndim == 2 and len(given) > saved.max():
        given = given[saved]
    if given.shape not in ((count,), (len(states.t), count)):
        raise ValueError(
            f"colour: {name!r} got values of shape {given.shape}; pass one for each of its {count} elements, "
            f"({count},), or for each saved time as well"
        )
    return np.broadcast_to(given, (len(states.t), count)), name


def element_skins(
    system: System, states: State, rows: np.ndarray, saved: np.ndarray, colouring: Colouring
) -> Iterator[Skin]:
    """Faces of shells, and those of solids that no two of them share, by name of the elements."""
    for number, group in enumerate(
        g for g in system.effects if type(g.effect).faces and g.weights is not None
    ):
        weights, bodies = markers_of(group)
        own = weights if weights.ndim == 4 else weights[:, :, 0]
        places = np.einsum("nkba,tnkbac->tnkc", own, rows[:, bodies])
        corners = np.array(type(group.effect).faces)
        # A node is a body with weights: nodes that are clamped to one body have its number.
        keys = np.concatenate([bodies, own.reshape(*bodies.shape[:2], -1)], axis=-1)
        _, first, back = np.unique(
            keys.reshape(-1, keys.shape[-1]), axis=0, return_index=True, return_inverse=True
        )
        faces = back.reshape(bodies.shape[:2])[:, corners].reshape(-1, 4)
        _, same, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        outer = np.flatnonzero(count[same.reshape(-1)] == 1)
        owner = np.repeat(np.arange(group.count), len(corners))[outer]
        sizes, unit = _sizes(places[0], corners), "J/m²" if len(corners) == 1 else "J/m³"

        def density(group=group, sizes=sizes) -> np.ndarray:
            return energies(system, group, states) / sizes

        name = str(group.labels[0])
        values, label = _values(name, group.count, states, saved, colouring, density, unit)
        used, faces = np.unique(faces[outer], return_inverse=True)
        points = places.reshape(len(rows), -1, 3)[:, first[used]]
        shown = None if values is None else values[:, owner]
        yield Skin(name, points, faces.reshape(-1, 4), PALETTE[number % len(PALETTE)], shown, label)


def _round_section(system: System, beam: str, length: float) -> Float[np.ndarray, "n 2"]:
    """Rim of the full ellipse with the mass and inertia of the beam's nodes, and no thicker than a beam."""
    angles = np.linspace(0.0, 2 * np.pi, RIM, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for number, name in enumerate(system.structure.bodies):
        if name.startswith(f"{beam}/node "):
            block = np.asarray(system.mass)[number]
            return circle * np.minimum(2 * np.sqrt(np.diag(block)[1:3] / block[0, 0]), STOUTEST * length)
    return 0.01 * length * circle


def beam_skins(
    system: System,
    states: State,
    rows: np.ndarray,
    saved: np.ndarray,
    colouring: Colouring,
    beams: Sequence[BeamHandle] = (),
) -> Iterator[Skin]:
    """Swept sections of all beams, as quadrilaterals between the rims of neighbouring nodes.

    Sections of beams without a handle are round.
    """
    known: dict[str, Any] = {b.name: np.asarray(b.outline) for b in beams if b.outline is not None}
    for group in _chains(system):
        frames = places_of(group, rows)
        owners = np.array([_beam_of(name) for name in group.names])
        for number, beam in enumerate(dict.fromkeys(owners)):
            here = frames[:, owners == beam]
            lengths = np.linalg.norm(here[0, :, 1, 0] - here[0, :, 0, 0], axis=-1)
            rim = known[beam] if beam in known else _round_section(system, str(beam), lengths.sum())
            rim = rim[:: -(-len(rim) // RIM)]
            across = np.einsum("ri,tnkic->tnkrc", rim, here[:, :, :, 1:3]) + here[:, :, :, :1]
            count, corner = here.shape[1], np.arange(len(rim))
            following = np.roll(corner, -1)
            piece = np.stack([corner, len(rim) + corner, len(rim) + following, following], axis=1)
            faces = (2 * len(rim) * np.arange(count)[:, None, None] + piece).reshape(-1, 4)

            def density(group=group, mine=owners == beam, lengths=lengths) -> np.ndarray:
                return energies(system, group, states)[:, mine] / lengths

            values, label = _values(str(beam), count, states, saved, colouring, density, "J/m")
            shown = None if values is None else np.repeat(values, len(rim), axis=1)
            colour = PALETTE[(number + 1) % len(PALETTE)]
            yield Skin(str(beam), across.reshape(len(rows), -1, 3), faces, colour, shown, label, edges=False)
