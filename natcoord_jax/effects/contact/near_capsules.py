"""Which of many capsules are near each other: of those whose bounding spheres are the segments, too."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.effects.contact.pair_distance import products, vectors
from natcoord_jax.effects.contact.pairs import nearest_points
from natcoord_jax.maths.near_spheres import Neighbours, near_spheres, picked

CROWD = 4
"""Spheres around capsules that may meet one, for each neighbour that there is room for."""

NEARLY = 1e-9
"""How much nearest points are drawn to middles: as little as tells those of parallel segments."""


def near_capsules(
    ends: Float[Array, "v 3 n"], sizes: Float[Array, " n"], exempt: Int[Array, "n most"], room: int
) -> Neighbours:
    """Capsules that touch.

    Args:
        ends: of the segment of each, or the centres of spheres [m].
        sizes: their radii [m].
        exempt: others that do not count, of each; -1 for none.
        room: neighbours that each has room for.
    """
    middle = jnp.mean(ends, axis=0)
    half = jnp.sqrt(jnp.max(jnp.sum((ends - middle) ** 2, axis=1), axis=0))
    alone = ends.shape[0] == 1
    found = near_spheres(middle.T, sizes + half, room if alone else CROWD * room)
    near = found.near & ~jnp.any(found.others[..., None] == exempt[:, None], axis=-1)
    if alone:
        return Neighbours(found.others, near, found.left_out)
    n = ends.shape[2]
    one = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32)[:, None], near.shape)
    square = _least(ends, jnp.stack([one, found.others]).reshape(2, -1)).reshape(near.shape)
    near &= square <= (sizes[found.others] + sizes[:, None]) ** 2
    place, there = picked(jnp.zeros((n, 1), jnp.int32), near[:, None], room)
    others = jnp.where(there, jnp.take_along_axis(found.others, place, axis=1), 0)
    lacking = there[:, room]
    first = jnp.argmax(lacking)
    left_out = jnp.where(lacking[first], jnp.stack([first, others[first, room]]), -1)
    return Neighbours(
        others[:, :room], there[:, :room], jnp.where(found.left_out >= 0, found.left_out, left_out)
    )


def _least(ends: Float[Array, "2 3 n"], pairs: Int[Array, "2 p"]) -> Float[Array, " p"]:
    """Square of the distance of pairs of segments."""
    one, other, apart = vectors(ends, pairs)
    both = jnp.stack([one, other, apart])
    s, t = nearest_points(products(both, both), NEARLY)
    return jnp.sum((apart + s * one - t * other) ** 2, axis=0)
