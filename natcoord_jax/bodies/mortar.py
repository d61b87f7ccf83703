"""Integrals over where two meshed surfaces meet: products of their shape functions, by segments; on the host.

Facets of one surface are cut with those of the other in the plane of the first, and every piece is integrated
by itself, so that the integrands are smooth: a uniform pressure passes exactly from one mesh to the other
(Puso and Laursen, Comput. Methods Appl. Mech. Engrg. 193, 2004).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from natcoord_jax.maths.triangle import TRIANGLE, WEIGHTS

CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
"""Natural coordinates of a quadrilateral's corners."""

NEAR = 0.3
"""Distance of two facets, in terms of the size of the first, beyond which they do not meet."""


@dataclass
class Overlap:
    """Integrals of products of shape functions where two surfaces meet.

    Attributes:
        own: D (slaves, slaves), of the first surface's with its own [m^2].
        other: M (slaves, masters), with those of the second [m^2].
    """

    own: Float[np.ndarray, "s s"]
    other: Float[np.ndarray, "s m"]


def shapes(natural: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 4"]:
    """Shape functions of a quadrilateral."""
    xi, eta = natural[:, :1], natural[:, 1:]
    return (1 + xi * CORNERS[:, 0]) * (1 + eta * CORNERS[:, 1]) / 4


def natural_coordinates(
    corners: Float[np.ndarray, "4 2"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Of points in the plane of a quadrilateral, by Newton's method."""
    found = np.zeros_like(points)
    a, b, c = (signs @ corners / 4 for signs in (CORNERS[:, 0], CORNERS[:, 1], CORNERS.prod(axis=1)))
    for _ in range(20):
        missing = points - shapes(found) @ corners
        by_xi, by_eta = a + c * found[:, 1:], b + c * found[:, :1]
        volume = _cross(by_xi, by_eta)
        first, second = _cross(missing, by_eta) / volume, _cross(by_xi, missing) / volume
        found = found + np.stack([first, second], axis=1)
        if np.max(np.abs(missing)) <= 1e-15 * np.max(np.abs(corners)):
            break
    return found


def _cross(a: Float[np.ndarray, "*n 2"], b: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Component across the plane of a cross product."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def clipped(subject: Float[np.ndarray, "n 2"], window: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "m 2"]:
    """What of a convex polygon lies within another, both counter-clockwise (Sutherland and Hodgman 1974)."""
    polygon = subject
    for start, end in zip(window, np.roll(window, -1, axis=0)):
        if not len(polygon):
            break
        edge = end - start
        side = _cross(edge, polygon - start)
        found = []
        for k, (point, here) in enumerate(zip(polygon, side)):
            after, there = polygon[(k + 1) % len(polygon)], side[(k + 1) % len(polygon)]
            if here >= 0:
                found.append(point)
            if here * there < 0:
                found.append(point + here / (here - there) * (after - point))
        polygon = np.array(found).reshape(-1, 2)
    return polygon


def overlap(
    slaves: Float[np.ndarray, "s 3"],
    slave_facets: Int[np.ndarray, "f 4"],
    masters: Float[np.ndarray, "m 3"],
    master_facets: Int[np.ndarray, "g 4"],
) -> Overlap:
    """Integrals where two surfaces meet.

    Args:
        slaves: nodes of the first surface.
        slave_facets: its quadrilaterals.
        masters: nodes of the second surface.
        master_facets: its quadrilaterals.
    """
    found = Overlap(np.zeros((len(slaves),) * 2), np.zeros((len(slaves), len(masters))))
    others = masters[master_facets]
    low, high = others.min(axis=1), others.max(axis=1)
    for facet in slave_facets:
        corners = slaves[facet]
        reach = NEAR * np.linalg.norm(np.ptp(corners, axis=0))
        near = (low <= corners.max(axis=0) + reach) & (high >= corners.min(axis=0) - reach)
        centre, plane = _plane(corners)
        flat = (corners - centre) @ plane.T
        for k in np.flatnonzero(near.all(axis=1)):
            away = (others[k] - centre) @ np.cross(*plane)
            if np.min(np.abs(away)) <= reach:
                _add(found, flat, facet, (others[k] - centre) @ plane.T, master_facets[k])
    return found


def _plane(corners: Float[np.ndarray, "4 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Centre of a facet, and two unit vectors along it, counter-clockwise with its corners."""
    first = corners[1] + corners[2] - corners[0] - corners[3]
    normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    first, normal = first / np.linalg.norm(first), normal / np.linalg.norm(normal)
    first = first - (first @ normal) * normal
    first = first / np.linalg.norm(first)
    return corners.mean(axis=0), np.stack([first, np.cross(normal, first)])


def _add(
    found: Overlap,
    own: Float[np.ndarray, "4 2"],
    slave: Int[np.ndarray, "4"],
    other: Float[np.ndarray, "4 2"],
    master: Int[np.ndarray, "4"],
) -> None:
    """Add what one pair of facets has in common, in the plane of the first."""
    # Seen from the first, the second may turn the other way round.
    turn = _cross(other[2] - other[0], other[3] - other[1])
    window = other if turn > 0 else other[::-1]
    polygon = clipped(window, own)
    if len(polygon) < 3:
        return
    middle = polygon.mean(axis=0)
    for one, two in zip(polygon, np.roll(polygon, -1, axis=0)):
        area = 0.5 * _cross(one - middle, two - middle)
        if area <= 0:
            continue
        points = TRIANGLE @ np.stack([middle, one, two])
        mine, theirs = (shapes(natural_coordinates(x, points)) for x in (own, other))
        weighted = (area * WEIGHTS)[:, None] * mine
        found.own[np.ix_(slave, slave)] += weighted.T @ mine
        found.other[np.ix_(slave, master)] += weighted.T @ theirs
