"""Which of many spheres are near each other: cells in columns, and room for a fixed number of neighbours.

Space is cut into cells as wide as the widest reach, so that what is near a sphere is in its cell or in one
next to it. Cells are sorted by a number for their column, which is hashed, and their height in it: the three
cells of a column that matter are one run of the sorted spheres, and nine such runs are looked through.
Columns next to a sphere that share a number are looked through once. Every array has a size that is known
beforehand.

Source: M. Teschner et al., Optimized spatial hashing for collision detection of deformable objects,
Vision, Modeling and Visualization 2003, section 4, for the hash.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.xla.materialise import materialised

PRIMES = np.int32(73856093), np.int32(19349663)
"""Of the hash of a column."""

HEIGHTS = 1 << 16
"""Heights of cells in a column that are told apart; what is above shares the last."""

COLUMNS = 1 << 14
"""Most numbers of columns, so that a number and a height go into 31 bits."""

AROUND = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], np.int32)
"""Columns next to one, itself included."""


class Neighbours(eqx.Module):
    """Spheres near each of `n` spheres.

    Attributes:
        others: their numbers; 0 where there is none.
        near: whether there is one.
        left_out: two spheres for which there was no room; -1 where there was room for all.
    """

    others: Int[Array, "n room"]
    near: Bool[Array, "n room"]
    left_out: Int[Array, "2"]


class Pairs(eqx.Module):
    """Pairs of things that are near each other, each once, for `n` things.

    Attributes:
        both: numbers of the two; 0 and 0 where there is no pair.
        there: whether there is one.
        seats: of each thing, its places in the list of all that are first in a pair, followed by that of all
            that are second; `2 p` where there is none.
        left_out: two things for which there was no room; -1 where there was room for all.
    """

    both: Int[Array, "2 p"]
    there: Bool[Array, " p"]
    seats: Int[Array, "room n"]
    left_out: Int[Array, "2"]

    def seated(self, x: Float[Array, "*k 2 p"]) -> Float[Array, "*k room n"]:
        """For each thing what either of its pairs has for it; zero where there is none."""
        flat = x.reshape(*x.shape[:-2], -1)
        return jnp.concatenate([flat, jnp.zeros_like(flat[..., :1])], axis=-1)[..., self.seats]

    def summed(self, x: Float[Array, "*k 2 p"]) -> Float[Array, "*k n"]:
        """The sum of it."""
        return jnp.sum(self.seated(x), axis=-2)


def near_spheres(centres: Float[Array, "n 3"], sizes: Float[Array, " n"], room: int) -> Neighbours:
    """Spheres that touch.

    Args:
        centres: of two spheres or more [m].
        sizes: their radii, one of them above zero [m].
        room: neighbours that a sphere has room for; a run has room for half as many spheres again.
    """
    n = centres.shape[0]
    cell = jnp.floor((centres - jnp.min(centres, axis=0)) / (2.0 * jnp.max(sizes))).astype(jnp.int32)
    columns = min(1 << (2 * n - 1).bit_length(), COLUMNS)

    def column_of(column: Int[Array, "*n 2"]) -> Int[Array, "*n"]:
        return ((column[..., 0] * PRIMES[0]) ^ (column[..., 1] * PRIMES[1])) & (columns - 1)

    def key(column: Array, height: Array) -> Array:
        return column * HEIGHTS + jnp.clip(height, 0, HEIGHTS - 1)

    keys = key(column_of(cell[:, :2]), cell[:, 2])
    order = jnp.argsort(keys).astype(jnp.int32)
    keys, cell, (x, y, z), sizes = keys[order], cell[order], centres[order].T, sizes[order]
    beside, height = column_of(cell[:, None, :2] + AROUND), cell[:, 2:]
    again = jnp.any((beside[:, :, None] == beside[:, None, :]) & np.tri(len(AROUND), k=-1, dtype=bool), -1)
    first = jnp.searchsorted(keys, key(beside, height - 1))
    beyond = jnp.searchsorted(keys, key(beside, height + 1), side="right")
    first, count = materialised((first, jnp.where(again, 0, beyond - first)))
    most = 3 * room // 2 + 1  # with the sphere itself
    at = first[..., None] + jnp.arange(most)
    inside = jnp.arange(most) < count[..., None]
    at = jnp.minimum(at, n - 1)
    apart = sum((w[at] - w[:, None, None]) ** 2 for w in (x, y, z))
    near = inside & (apart <= (sizes[at] + sizes[:, None, None]) ** 2) & (at != jnp.arange(n)[:, None, None])
    place, there = picked(first, materialised(near), room)
    # Of a run that is too long any of the last will do for a name.
    lacking = there[:, room] | jnp.any(count > most, axis=1)
    one = jnp.argmax(lacking)
    other = jnp.where(there[one, room], place[one, room], first[one, jnp.argmax(count[one])] + most)
    left_out = jnp.where(lacking[one], order[jnp.stack([one, other])], -1)
    back = jnp.argsort(order)
    others = jnp.where(there, order[place], 0)[back, :room]
    return Neighbours(others, there[back, :room], left_out)


def picked(
    first: Int[Array, "n runs"], near: Bool[Array, "n runs most"], room: int
) -> tuple[Int[Array, "n more"], Bool[Array, "n more"]]:
    """Places of those that are near, one after the other, and of one more; whether there are so many.

    Args:
        first: place at which each run begins.
        near: which of a run are near.
        room: how many of them are wanted.
    """
    within = materialised(jnp.cumsum(near, axis=-1, dtype=jnp.int32))
    count = within[..., -1]
    upto = materialised(jnp.cumsum(count, axis=-1))
    slot, each = jnp.arange(room + 1, dtype=jnp.int32), jnp.arange(near.shape[0])[:, None]
    run = jnp.sum(upto[:, None, :] <= slot[:, None], axis=-1, dtype=jnp.int32)
    run = materialised(jnp.minimum(run, near.shape[1] - 1))
    rank = slot - (upto - count)[each, run]
    before = jnp.sum(within[each, run] <= rank[..., None], axis=-1, dtype=jnp.int32)
    return first[each, run] + before, slot < upto[:, -1:]


def each_once(found: Neighbours) -> Pairs:
    """Pairs of neighbours, of which either has the other: half as many as there is room for at most."""
    n, room = found.others.shape
    size, one = n * room // 2, jnp.arange(n, dtype=jnp.int32)[:, None]
    mine = found.near & (found.others > one)
    upto = materialised(jnp.cumsum(mine.reshape(-1), dtype=jnp.int32))
    there = jnp.arange(size) < upto[-1]
    at = jnp.searchsorted(upto, jnp.arange(1, size + 1, dtype=jnp.int32)).astype(jnp.int32)
    at = jnp.where(there, at, 0)
    both = jnp.where(there, jnp.stack([at // room, found.others.reshape(-1)[at]]), 0)
    # What is second in a pair has its number from the list of the first.
    number = (upto - 1).reshape(n, room)
    mirrored = jnp.argmax(found.near[found.others] & (found.others[found.others] == one[..., None]), axis=-1)
    seats = jnp.where(mine, number, size + number[found.others, mirrored])
    return Pairs(both, there, jnp.where(found.near, seats, 2 * size).T, found.left_out)
