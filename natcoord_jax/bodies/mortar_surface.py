"""Mean gaps of one surface over another at the nodes of the first, as arrays."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from natcoord_jax.bodies.contact_sides import MeshSide
from natcoord_jax.bodies.node_surface import CANDIDATES, patches
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.elements import Elements
from natcoord_jax.core.nodes import NodeUnion
from natcoord_jax.effects.contact import MortarGap
from natcoord_jax.effects.contact.segments import whole


def mortar_gaps(one: MeshSide, other: MeshSide, law: dict[str, Any], name: str) -> Elements:
    """Mean gaps at the nodes of the first surface over facets of the second.

    Args:
        one: surface.
        other: surface.
        law: numbers of the contact; stiffness per area, None: the smaller one of the elements of both;
            "candidates": facets that those at a node may touch, None: as many as can be below them.
        name: of the contact.

    Raises:
        ValueError: for shells that are touched from both sides, and facets that are not of four nodes.
    """
    law = dict(law)
    for side in (one, other):
        if side.two_sided:
            raise ValueError(
                f"contact {name!r}: a mortar is of one side of {side.surface.handle.name!r}; pass "
                "shell.surface('outside') or shell.surface('inside')"
            )
    corners = np.searchsorted(one.numbers, one.surface.faces)
    places, others = (np.asarray(s.surface.handle.nodes.positions)[s.numbers] for s in (one, other))
    table, facets = _fans(corners, len(places))
    beside = others[np.searchsorted(other.numbers, other.surface.faces)]
    most = law.pop("candidates", None) or max(CANDIDATES, _below(places, table, beside))
    masters, local, ends, beyond, _ = patches(one, other, min(most, len(beside)), (0, len(places)), 0)
    area = np.sum(_areas(places[table[np.arange(len(table))[:, None, None], facets]], facets == 0), axis=1)
    given = law.pop("stiffness")
    stiffness = min(s.stiffness_per_area for s in (one, other)) if given is None else float(given)
    numbers = {
        "facets": facets,
        # Of the markers the nodes of the second surface follow; the first of `masters` is the node itself.
        "others": local + table.shape[1] - 1,
        "open": np.where(beyond > 0, 0.0, ends),
        "rims": np.any(beyond > 0, axis=2).astype(float),
        "thickness": one.half_thickness + other.half_thickness.max(),
        "stiffness": stiffness * area,
    }
    union = NodeUnion(tuple(s.surface.handle.nodes[s.numbers] for s in (one, other)))
    return MortarGap.on(union, np.concatenate([table, masters[:, 1:]], axis=1), each=numbers, **law)


def _fans(corners: Int[np.ndarray, "f 4"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes of the facets at each node, itself first, and these facets by places among them.

    Facets that are missing are four times the node, and without area.
    """
    fans = [corners[(corners == node).any(axis=1)] for node in range(count)]
    around = [np.unique(fan) for fan in fans]
    around = [np.concatenate([[n], x[x != n]]) for n, x in enumerate(around)]
    width, most = max(map(len, around)), max(map(len, fans))
    table = np.stack([np.pad(x, (0, width - len(x)), mode="edge") for x in around])
    facets = np.zeros((count, most, 4), int)
    for n, fan in enumerate(fans):
        facets[n, : len(fan)] = np.argmax(fan[..., None] == around[n], axis=-1)
    return table, facets


@eager_numpy
def _areas(corners: Any, of: Any) -> Any:
    """Integrals of some shape functions of facets (n, f, 4, 3)."""
    return jax.vmap(jax.vmap(whole))(corners, of)


def _below(places: np.ndarray, table: np.ndarray, beside: Float[np.ndarray, "f 4 3"]) -> int:
    """How many facets the facets at a node can be above, at most."""
    middles, nodes = beside.mean(axis=1), places[table]
    reach = np.max(np.linalg.norm(nodes - nodes[:, :1], axis=2), axis=1)
    reach = reach + np.max(np.linalg.norm(beside - middles[:, None], axis=2))
    apart = np.linalg.norm(places[:, None] - middles, axis=2)
    within = apart**2 <= (apart.min(axis=1) ** 2 + reach**2)[:, None]
    return int(within.sum(axis=1).max())
