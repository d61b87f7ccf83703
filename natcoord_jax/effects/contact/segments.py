"""What two facets have in common, and integrals over it of products of shape functions, with derivatives.

Both are projected along the normal of the first at its middle, on a plane. The polygon of the points that are
in both is convex; it is cut into triangles, on which all integrands are smooth. Numbers of corners and of
triangles are the same wherever the facets are: what is too many coincides, and has no area.

Source: M. A. Puso and T. A. Laursen, Comput. Methods Appl. Mech. Engrg. 193 (2004) 601-629, for the segments;
I. E. Sutherland and G. W. Hodgman, Commun. ACM 17 (1974) 32-42, for the polygon.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.effects.contact.node_on_facets import ETA, XI, shapes
from natcoord_jax.maths.triangle import THREE, TRIANGLE, WEIGHTS
from natcoord_jax.maths.vectors import cross, dot, safe_divide, safe_norm, safe_sqrt

ITERATIONS = 6
"""Of Newton's method for natural coordinates, from the middle of a facet: distorted ones take five."""

FEW = 4
"""Of them for derivatives that Newton's method of a step takes."""

PRODUCTS: Any = np.array([(4, 2, 1, 2), (2, 4, 2, 1), (1, 2, 4, 2), (2, 1, 2, 4)]) / 36.0
"""Integrals of products of shape functions, for an area of one at each corner: it is bilinear between."""

AT_END = 1e-9
"""By how much facets are taken for larger at the end of their surface, in terms of their size: rounding."""

BEYOND = 2.0
"""Natural coordinates to which it is held: points that are looked for are within one."""

DEEP = 0.5
"""Overlap of two facets, in terms of the size of the first, beyond which they are of other walls."""


def _area(a: Float[Array, "*n 2"], b: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Of the parallelogram of two vectors in a plane, counter-clockwise."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def clipped(
    subject: Float[Array, "4 2"], window: Float[Array, "4 2"], more: Float[Array, "4"]
) -> Float[Array, "8 2"]:
    """Corners of what of a convex polygon is within another, both counter-clockwise; some coincide.

    Args:
        subject: polygon.
        window: polygon.
        more: by how much each of its sides is farther out, in terms of its length.
    """
    polygon = subject
    for k in range(4):
        polygon = _cut(polygon, window[k], window[(k + 1) % 4] - window[k], more[k])
    return polygon


def _cut(
    polygon: Float[Array, "n 2"], start: Float[Array, "2"], side: Float[Array, "2"], more: Array
) -> Array:
    """What of a convex polygon is to the left of a line; one corner more."""
    ahead = jnp.roll(polygon, -1, axis=0)
    # Computed once: a corner that is nearly on the line must not be on both sides of it.
    here = _area(side, polygon - start) + more * dot(side, side)
    there = jnp.roll(here, -1)
    crosses = (here >= 0) != (there >= 0)
    share = here / jnp.where(crosses, here - there, 1.0)
    points = jnp.stack([polygon, polygon + share[:, None] * (ahead - polygon)], axis=1).reshape(-1, 2)
    kept = jnp.stack([here >= 0, crosses], axis=1).reshape(-1)
    rank = jnp.cumsum(kept) - 1
    # What is missing coincides with the first; of nothing all are the origin.
    place = jnp.arange(len(polygon) + 1)[:, None]
    chosen = kept & (rank == jnp.where(place < jnp.sum(kept), place, 0))
    return jnp.sum(jnp.where(chosen[..., None], points, 0.0), axis=1)


def natural_coordinates(
    point: Float[Array, "2"], corners: Float[Array, "4 2"], iterations: int = ITERATIONS
) -> Float[Array, "2"]:
    """Of a point within a quadrilateral in its plane, with derivatives."""
    warp = 0.25 * (XI * ETA) @ corners
    along, up = 0.25 * XI @ corners, 0.25 * ETA @ corners
    missing = point - jnp.mean(corners, axis=0)
    found = jnp.zeros(2)
    for k in range(iterations):
        # As of the nearest point of a facet: the last two steps give the derivatives.
        found = jax.lax.stop_gradient(found) if k == iterations - 2 else found
        xi, eta = found
        one, two = along + eta * warp, up + xi * warp
        rest = missing - xi * along - eta * up - xi * eta * warp
        volume = _area(one, two)
        regular = volume > 0
        step = jnp.stack([_area(rest, two), _area(one, rest)]) / jnp.where(regular, volume, 1.0)
        found = jnp.where(regular, jnp.clip(found + step, -BEYOND, BEYOND), found)
    return found


def whole(corners: Float[Array, "4 3"], of: Float[Array, "4"]) -> Float[Array, ""]:
    """Integral of some shape functions over a facet, along the normal at its middle [m^2].

    Args:
        corners: of the facet.
        of: 1 for each shape function that counts, else 0.
    """
    flat, _ = _flat(corners, corners)
    sides = jnp.roll(flat, -1, axis=0) - flat
    return of @ PRODUCTS @ _area(sides, -jnp.roll(sides, 1, axis=0))


def _flat(corners: Float[Array, "4 3"], points: Float[Array, "n 3"]) -> tuple[Array, Array]:
    """Points in the plane of a facet, from its middle, and its normal; of no area nothing."""
    one, two = 0.25 * XI @ corners, 0.25 * ETA @ corners
    normal, first = (safe_divide(x, safe_norm(x)[None]) for x in (cross(one, two), one))
    plane = jnp.stack([first, cross(normal, first)])
    return (points - jnp.mean(corners, axis=0)) @ plane.T, normal


def segment(
    own: Float[Array, "4 3"],
    of: Float[Array, "4"],
    other: Float[Array, "4 3"],
    ends: Float[Array, "4"],
    *,
    nearly: bool = False,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Integrals over what two facets have in common, weighted by shape functions of the first one.

    Of the gap along the normal of the first [m^3], and of one [m^2]; zero where they do not face each other.

    Args:
        own: corners of the first, in turn as seen from outside.
        of: 1 for each of its shape functions that counts, else 0.
        other: corners of the second.
        ends: 1 for each side of the second that is an end of its surface, else 0.
        nearly: whether fewer points and iterations do, for derivatives in Newton's method.
    """
    rule, weights = (THREE, np.full(3, 1 / 3)) if nearly else (TRIANGLE, WEIGHTS)
    flat, normal = _flat(own, own)
    # Seen from the first, the second turns the other way round.
    facing = _flat(own, other[::-1])[0]
    size = safe_sqrt(_area(flat[2] - flat[0], flat[3] - flat[1]))
    apart = dot(normal, jnp.mean(other, axis=0) - jnp.mean(own, axis=0))
    meets = (_area(facing[2] - facing[0], facing[3] - facing[1]) > 0) & (apart > -DEEP * size)
    polygon = clipped(flat, facing, AT_END * ends[jnp.array([2, 1, 0, 3])])
    one, two = (polygon[k:][: len(polygon) - 2] - polygon[0] for k in (1, 2))
    areas = jnp.where(meets, 0.5 * _area(one, two), 0.0)
    points: Any = polygon[0] + jnp.asarray(rule[:, 1:]) @ jnp.stack([one, two], axis=1)
    points = points.reshape(-1, 2)
    iterations = FEW if nearly else ITERATIONS

    def every(corners: Float[Array, "4 2"]) -> Float[Array, "p 4"]:
        return jax.vmap(lambda point: shapes(natural_coordinates(point, corners, iterations)))(points)

    mine, theirs = every(flat), every(facing)
    weighted = (areas[:, None] * weights).reshape(-1) * (mine @ of)
    gaps = theirs @ ((other[::-1] - own[0]) @ normal) - mine @ ((own - own[0]) @ normal)
    return weighted @ gaps, jnp.sum(weighted)
