"""Nodes of one surface on the facets of another, as arrays."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from natcoord_jax.bodies.contact_sides import MeshSide
from natcoord_jax.core.elements import Elements
from natcoord_jax.core.nodes import NodeUnion
from natcoord_jax.effects.contact import FrictionalNodeOnFacets, NodeOnFacets

CANDIDATES = 16
"""Facets that a node may touch, by default."""


def surface_gaps(one: MeshSide, other: MeshSide, law: dict[str, Any], name: str) -> Elements:
    """Gaps of the nodes of each of two surfaces on the facets of the other, with half the stiffness of each.

    So no surface has a part of its own. In one pass, nodes of the first on facets of the second only.

    Args:
        one: surface.
        other: surface.
        law: numbers of the contact; stiffness None: that of the elements; "candidates": facets of each node;
            "one_pass": whether nodes of the first surface only are touched.
        name: of the contact.
    """
    law = dict(law)
    most = min(law.pop("candidates", None) or CANDIDATES, max(len(s.surface.faces) for s in (one, other)))
    given = law.pop("stiffness")
    passes = 1 if law.pop("one_pass", False) else 2
    sides = ((one, other), (other, one))[:passes]
    first = 0, len(one.numbers)
    found = [patches(a, b, most, first, k) for k, (a, b) in enumerate(sides)]
    width = max(table.shape[1] for table, *_ in found)
    # What fills up repeats the last node, so that both ways are alike.
    tables = [np.pad(table, ((0, 0), (0, width - table.shape[1])), mode="edge") for table, *_ in found]
    fields = "facets", "open", "beyond", "patch", "depth", "thickness", "stiffness", "two_sided"
    each: dict[str, list[Any]] = {field: [] for field in fields}
    for (slave, master), (_, facets, ends, beyond, near) in zip(sides, found):
        sharp, patch = _smooth(master)
        thick = slave.half_thickness
        stiff = slave.stiffness if given is None else np.full(len(thick), float(given))
        each["facets"].append(facets)
        each["open"].append(np.maximum(ends, sharp[near]))
        each["beyond"].append(beyond)
        each["patch"].append(patch[near])
        each["depth"].append(master.depth[near])
        each["thickness"].append(thick + master.half_thickness.max())
        each["stiffness"].append(stiff / passes)
        each["two_sided"].append(np.full(len(thick), float(master.two_sided)))
    union = NodeUnion(tuple(s.surface.handle.nodes[s.numbers] for s in (one, other)))
    numbers = {key: np.concatenate(values) for key, values in each.items()}
    if not numbers["patch"].any():
        del numbers["patch"]
    kind = FrictionalNodeOnFacets if "friction" in law else NodeOnFacets
    return kind.on(union, np.concatenate(tables), each=numbers, **law)


def _smooth(master: MeshSide) -> tuple[np.ndarray, np.ndarray]:
    """Sharp edges of facets, and patches between them; of what has two sides there are none."""
    facets = np.searchsorted(master.numbers, master.surface.faces)
    if master.two_sided:
        return np.zeros(facets.shape, bool), np.zeros(len(facets), int)
    return sharp_edges(facets, np.asarray(master.surface.handle.nodes.positions)[master.numbers])


def _nearest(
    nodes: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "f 4 3"], most: int
) -> Int[np.ndarray, "n k"]:
    """Numbers of the facets whose middles are the nearest to each node."""
    apart = nodes[:, None] - corners.mean(axis=1)
    found = np.argsort(np.sum(apart**2, axis=2), axis=1, kind="stable")[:, :most]
    return np.pad(found, ((0, 0), (0, most - found.shape[1])), mode="edge")


def patches(
    slave: MeshSide, master: MeshSide, most: int, first: tuple[int, int], turn: int
) -> tuple[
    Int[np.ndarray, "n m"], Int[np.ndarray, "n k 4"], Float[np.ndarray, "n k 4"], np.ndarray, np.ndarray
]:
    """For each node itself and the nodes of its facets (n, m), and facets by places among them (n, k, 4).

    Of their edges which end, and how far the surface goes on beyond them (n, k, 4) [m]; last the numbers of
    the facets on their surface (n, k).

    Args:
        slave: whose nodes.
        master: whose facets.
        most: facets of each node; a smaller surface repeats some.
        first: numbers of the first nodes of both surfaces, in the order in which they are numbered.
        turn: 0 where the slave is the first of them, else 1.
    """
    facets = np.searchsorted(master.numbers, master.surface.faces)
    places = np.asarray(master.surface.handle.nodes.positions)[master.numbers]
    nodes = np.asarray(slave.surface.handle.nodes.positions)[slave.numbers]
    near = _nearest(nodes, places[facets], most)
    corners = facets[near]
    unique = [np.unique(x) for x in corners]
    width = max(map(len, unique))
    table = np.stack([np.pad(x, (0, width - len(x)), mode="edge") for x in unique])
    local = np.stack([np.searchsorted(x, c) for x, c in zip(unique, corners)]) + 1
    edges = np.sort(_edges(corners), axis=-1)
    ends = np.stack([_alone(e, f) for e, f in zip(edges, near)])
    own = first[turn] + np.arange(len(near))
    goes_on = (ends > 0) & _shared(np.sort(_edges(facets), axis=-1))[near]
    beyond = np.where(goes_on, np.linalg.norm(np.ptp(places, axis=0)), 0.0)
    return np.concatenate([own[:, None], first[1 - turn] + table], axis=1), local, ends, beyond, near


def _edges(corners: Int[np.ndarray, "*n 4"]) -> Int[np.ndarray, "*n 4 2"]:
    """Both ends of the edges of facets."""
    return np.stack([corners, np.roll(corners, -1, axis=-1)], axis=-1)


def _shared(edges: Int[np.ndarray, "f 4 2"]) -> np.ndarray:
    """Which edges of all facets of a surface belong to two of them (f, 4); those without length to none."""
    _, number, count = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True)
    return (count > 1)[number.reshape(-1)].reshape(edges.shape[:2]) & (edges[..., 0] != edges[..., 1])


def _alone(edges: Int[np.ndarray, "k 4 2"], facets: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 4"]:
    """Which edges of facets belong to no other of them."""
    same = (edges[:, :, None, None] == edges).all(axis=-1)
    others = same & (facets[:, None] != facets)[:, None, :, None]
    return (~others.any(axis=(2, 3))).astype(float)


SHARP = 0.4
"""Cosine of the angle between the normals of two facets below which the edge between them is sharp: those of
boxes are, those of a round body of six facets along its girth or more are not."""


def sharp_edges(
    facets: Int[np.ndarray, "f 4"], places: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, "f 4"], Int[np.ndarray, " f"]]:
    """Which edges of facets are sharp and convex, and the number of the patch between those, facet by facet.

    Args:
        facets: numbers of their corners, in turn as seen from outside.
        places: of the nodes [m].

    Example:
        >>> import numpy as np
        >>> places = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, -1), (1, 1, -1.0)])
        >>> sharp, patch = sharp_edges(np.array([(0, 1, 2, 3), (1, 4, 5, 2)]), places)
        >>> sharp.astype(int).tolist(), patch.tolist()
        ([[0, 1, 0, 0], [0, 0, 0, 1]], [0, 1])
    """
    corners = places[facets]
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one, other = _pairs(np.sort(np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1), axis=-1))
    f, g = one // 4, other // 4
    cosines = np.sum(normals[f] * normals[g], axis=1)
    convex = np.sum(normals[f] * (middles[g] - middles[f]), axis=1) < 0
    bent = convex & (cosines < SHARP)
    sharp = np.zeros(facets.size, bool)
    sharp[np.concatenate([one[bent], other[bent]])] = True
    patch, before = np.arange(len(facets)), None
    f, g = f[~bent], g[~bent]
    while before is None or np.any(patch != before):
        before = patch.copy()
        least = np.minimum(patch[f], patch[g])
        np.minimum.at(patch, f, least)
        np.minimum.at(patch, g, least)
        # The facet that has given its number has a lower one itself by now.
        patch = patch[patch]
    return sharp.reshape(facets.shape), patch


def _pairs(edges: Int[np.ndarray, "f 4 2"]) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Numbers of edges of facets that are the same edge, of two of them."""
    flat = edges.reshape(-1, 2)
    _, number, count = np.unique(flat, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    shared = np.flatnonzero((count[number] == 2) & (flat[:, 0] != flat[:, 1]))
    order = shared[np.argsort(number[shared], kind="stable")]
    return order[::2], order[1::2]
