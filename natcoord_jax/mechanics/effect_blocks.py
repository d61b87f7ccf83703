"""Blocks of effects that couple a body with its parent in the tree, see `linsolve.tree`."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.model.node_layout import NodeLayout


def seated(
    bodies: Int[np.ndarray, "n k"], ground: int
) -> tuple[Bool[np.ndarray, "n k"], Bool[np.ndarray, "n k"]]:
    """Which bodies of each instance are its node, the deeper one, and which the node's parent."""
    real = bodies < ground
    # Bodies are numbered from the root.
    node = np.max(np.where(real, bodies, -1), axis=1, keepdims=True)
    at_node = real & (bodies == node)
    return at_node, real & ~at_node


def by_place(by_twist: Float[Array, "n k s 6 k s 6"], places: tuple[np.ndarray, np.ndarray]) -> list[Array]:
    """Blocks (node, node), (node, parent), (parent, node), (parent, parent) of each instance."""
    n, k, s = by_twist.shape[:3]
    local = by_twist.reshape(n, k, 6 * s, k, 6 * s)
    return [
        jnp.sum(jnp.where((a[:, :, None] & b[:, None, :])[:, :, None, :, None], local, 0.0), axis=(1, 3))
        for a in places
        for b in places
    ]


def borders(
    by_lam: Float[Array, "n k s 6 s m"],
    by_twist: Float[Array, "n s m k s 6"],
    places: tuple[np.ndarray, np.ndarray],
) -> list[Array]:
    """Of each multiplier: its loads on node and on parent, the rates of its constraint by their twists."""
    n, k, s = by_lam.shape[:3]
    loads = jnp.moveaxis(by_lam.reshape(n, k, 6 * s, s, -1), 4, 2)
    rates = jnp.moveaxis(by_twist.reshape(n, s, -1, k, 6 * s), (1, 3), (3, 1))
    return [
        jnp.sum(jnp.where(at[:, :, None, None, None], x, 0.0), axis=1)
        for x in (loads, rates)
        for at in places
    ]


def with_coupling(
    joints: tuple[Array, Array, Array], node_by_parent: Array, parent_by_node: Array
) -> tuple[Array, Array, Array]:
    """Blocks of the joints with loads on a node by its parent's twist, and on the parent by the node's."""
    spread, gather, rest = joints
    width = node_by_parent.shape[-1]
    empty = jnp.zeros((*rest.shape[:2], rest.shape[2] - width), rest.dtype)
    rest = rest + jnp.concatenate([gather @ node_by_parent, empty], axis=2)
    upper = rest[:, :width] + parent_by_node @ spread
    return spread, gather, jnp.concatenate([upper, rest[:, width:]], axis=1)


def with_multipliers(
    joints: tuple[Array, Array, Array], layout: NodeLayout, every: Sequence[Sequence[Array]]
) -> tuple[Array, Array, Array]:
    """Blocks with the multipliers of each node; a place without one keeps its unknown at zero."""
    spread, gather, rest = joints
    bodies, width, _ = spread.shape
    count, s = layout.slots.shape[1], layout.stages
    *parts, own = zip(*every)
    on_node, on_parent, by_node, by_parent = (layout.by_node(layout.by_multiplier(x)) for x in parts)
    on_node, on_parent = (
        jnp.moveaxis(x, 1, 2).reshape(bodies, width, count * s) for x in (-on_node, -on_parent)
    )
    by_node, by_parent = (
        jnp.moveaxis(x, 2, 3).reshape(bodies, count * s, width) for x in (by_node, by_parent)
    )
    unused = np.repeat(layout.slots == layout.places.shape[0], s, axis=1)
    by_parent = jnp.concatenate([by_parent, jnp.zeros((bodies, count * s, rest.shape[2] - width))], axis=2)
    columns = gather @ on_node
    columns = jnp.concatenate([columns[:, :width] + on_parent, columns[:, width:]], axis=1)
    corner = unused[:, :, None] * jnp.eye(count * s) + _by_multipliers(layout, own)
    rows = by_node @ spread + by_parent
    rest = jnp.concatenate(
        [jnp.concatenate([rest, columns], axis=2), jnp.concatenate([rows, corner], axis=2)], axis=1
    )
    spread = jnp.concatenate([spread, jnp.zeros((bodies, width, count * s))], axis=2)
    gather = jnp.concatenate([gather, jnp.zeros((bodies, count * s, width))], axis=1)
    return spread, gather, rest


def _by_multipliers(
    layout: NodeLayout, every: Sequence[Float[Array, "n m s s m"]]
) -> Float[Array, "bodies k k"]:
    """Rates of the constraints of each node by its multipliers: of one instance those of itself alone."""
    most = max(m for _, m in layout.groups)
    padded = [jnp.pad(x, ((0, 0),) * 4 + ((0, most - x.shape[4]),)) for x in every if x.shape[1]]
    found = layout.by_node(layout.by_multiplier(padded))
    first, total = np.zeros(layout.places.shape[0] + 1, int), 0
    for n, m in layout.groups:
        first[total : total + n * m] = total + np.repeat(np.arange(n) * m, m)
        total += n * m
    first[total] = -most - 1  # of an unused place: no multiplier is its own
    slots = layout.slots
    own = slots[:, None, :, None] == first[slots][:, :, None, None] + np.arange(most)
    bodies, count = slots.shape
    blocks = jnp.einsum("bamnk,back->bamcn", found, own.astype(found.dtype))
    return blocks.reshape(bodies, count * layout.stages, count * layout.stages)
