"""Nodes of one surface on the facets of another, as arrays."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from natcoord_jax.bodies.contact_sides import MeshSide
from natcoord_jax.core.nodes import NodeUnion
from natcoord_jax.effects.contact import NodeOnFacets

CANDIDATES = 16
"""Facets that a node may touch, by default."""


def node_surface_gaps(slave: MeshSide, master: MeshSide, law: dict[str, Any], name: str) -> list[Any]:
    """Gaps of the nodes of one surface on the facets of another, with half the stiffness of the nodes.

    The other half is that of the same contact the other way round: so no surface has a part of its own.

    Args:
        slave: whose nodes.
        master: whose facets.
        law: numbers of the contact; stiffness None: that of the elements; "candidates": facets of each node.
        name: of the contact, for messages.
    """
    law = dict(law)
    most = law.pop("candidates", None) or CANDIDATES
    numbers, used = slave.numbers, master.numbers
    facets = np.searchsorted(used, master.surface.faces)
    places = np.asarray(master.surface.handle.nodes.positions)[used]
    nodes = np.asarray(slave.surface.handle.nodes.positions)[numbers]
    thick, stiff = slave.of_nodes()
    if law["stiffness"] is None:
        law["stiffness"] = stiff
    near = _nearest(nodes, places[facets], min(most, len(facets)))
    connectivity, local, ends = _patches(facets, near, len(numbers))
    beneath = master.of_nodes()[0].max() if master.shell else 0.0
    each = {
        "facets": local,
        "open": ends,
        "thickness": thick + beneath,
        "stiffness": 0.5 * np.broadcast_to(law.pop("stiffness"), len(numbers)),
    }
    union = NodeUnion((slave.surface.handle.nodes[numbers], master.surface.handle.nodes[used]))
    given = {"each": each, "two_sided": master.shell, **law}
    return [NodeOnFacets.on(union, connectivity, **given)]


def _nearest(
    nodes: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "f 4 3"], most: int
) -> Int[np.ndarray, "n k"]:
    """Numbers of the facets whose middles are the nearest to each node."""
    apart = nodes[:, None] - corners.mean(axis=1)
    return np.argsort(np.sum(apart**2, axis=2), axis=1, kind="stable")[:, :most]


def _patches(
    facets: Int[np.ndarray, "f 4"], near: Int[np.ndarray, "n k"], first: int
) -> tuple[Int[np.ndarray, "n m"], Int[np.ndarray, "n k 4"], Float[np.ndarray, "n k 4"]]:
    """For each node the nodes of its facets, these by their places among them, and which edges are ends.

    Args:
        facets: of the whole surface.
        near: numbers of those of each node.
        first: number of the surface's first node among all.
    """
    corners = facets[near]
    unique = [np.unique(x) for x in corners]
    width = max(map(len, unique))
    # What fills up repeats the last node.
    table = np.stack([np.pad(x, (0, width - len(x)), mode="edge") for x in unique])
    local = np.stack([np.searchsorted(x, c) for x, c in zip(unique, corners)]) + 1
    edges = np.sort(np.stack([corners, np.roll(corners, -1, axis=2)], axis=-1), axis=-1)
    edges = edges.reshape(len(near), -1, 2)
    shared = np.stack([np.sum((e[:, None] == e[None]).all(axis=2), axis=1) for e in edges])
    connectivity = np.concatenate([np.arange(len(near))[:, None], first + table], axis=1)
    return connectivity, local, (shared == 1).reshape(local.shape).astype(float)
