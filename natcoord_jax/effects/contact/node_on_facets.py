"""Gap between a node and a surface of quadrilaterals that move with their corners."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.potential import place_markers
from natcoord_jax.effects.contact.discrete_gap import DiscreteGap, Measured
from natcoord_jax.maths.vectors import cross, dot, safe_norm, safe_sqrt

XI: Any = np.array([-1.0, 1.0, 1.0, -1.0])
ETA: Any = np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the corners."""

ITERATIONS = 6
"""Of Newton's method for the nearest point of a facet, from its middle: warped ones take five."""


BEYOND = 1.4
"""Natural coordinates up to which a facet goes on where its neighbours take over from it."""

BLEND = 0.2
"""Of the natural coordinates, on both sides of an edge, in which they do."""

AT_END = 1e-6
"""Natural coordinates by which a node at the very end of a surface may be beyond it, by rounding."""

LEVEL = 0.3
"""Difference of heights above two facets, in terms of their size, at which only the nearer one counts."""


LEFT = (
    "has left the facets that it may touch, which are those that were nearest in the assembled pose, so that "
    "a contact is missed; pass more `candidates` to nc.Contact, or assemble the parts where they meet"
)


class Nearest(eqx.Module):
    """The nearest point of a facet, and where its normal through the node starts.

    Attributes:
        weights: of the corners.
        apart: from it to the point that it is the nearest to [m].
        normal: of the facet there, of unit length [-].
        edge: on which it is, by the number of the edge's first corner; -1: within the facet.
        to_edges: squares of the distances from the nearest points of the edges [m^2].
        natural: coordinates of the foot of the normal, which may be a little beyond the edges.
        height: of the node above it [m].
        size: of the facet [m].
    """

    weights: Float[Array, "4"]
    apart: Float[Array, "3"]
    normal: Float[Array, "3"]
    edge: Int[Array, ""]
    to_edges: Float[Array, "4"]
    natural: Float[Array, "2"]
    height: Float[Array, ""]
    size: Float[Array, ""]


def shapes(natural: Float[Array, "2"]) -> Float[Array, "4"]:
    """Shape functions of a quadrilateral."""
    return 0.25 * (1 + XI * natural[0]) * (1 + ETA * natural[1])


def slopes_at(natural: Float[Array, "2"], corners: Float[Array, "4 3"]) -> tuple[Array, Array]:
    """Derivatives of the place by the natural coordinates."""
    by_xi, by_eta = 0.25 * XI * (1 + ETA * natural[1]), 0.25 * ETA * (1 + XI * natural[0])
    return by_xi @ corners, by_eta @ corners


def nearest_on_edges(point: Float[Array, "3"], corners: Float[Array, "4 3"]) -> Float[Array, "4 4"]:
    """Weights of the corners in the nearest point of each edge."""
    along = jnp.roll(corners, -1, axis=0) - corners
    length = dot(along, along)
    some = length > 0
    share = jnp.clip(dot(point - corners, along) / jnp.where(some, length, 1.0), 0.0, 1.0)
    share = jnp.where(some, share, 0.0)
    unit = np.eye(4)
    return jnp.asarray(unit) + share[:, None] * (np.roll(unit, -1, axis=0) - unit)


def nearest_point(point: Float[Array, "3"], corners: Float[Array, "4 3"]) -> Nearest:
    """The nearest point of a bilinear facet, within it or on an edge.

    Newton's method with all second derivatives finds where the distance is normal to the facet; the nearest
    points of the edges have a formula. Derivatives are those of the nearest point, none is held.

    Args:
        point: from which.
        corners: of the facet, in turn.
    """
    warp = 0.25 * (XI * ETA) @ corners
    natural = jnp.zeros(2)
    for k in range(ITERATIONS):
        # What the last two steps start from need not follow: each of them doubles the order to which the
        # coordinates do.
        natural = jax.lax.stop_gradient(natural) if k == ITERATIONS - 2 else natural
        one, two = slopes_at(natural, corners)
        apart = point - shapes(natural) @ corners
        a, flat, c = dot(one, one), dot(one, two), dot(two, two)
        b = flat - dot(apart, warp)
        # Where the node is farther than the facet is curved, the second derivatives lead away.
        b = jnp.where(a * c - b * b > 1e-6 * a * c, b, flat)
        volume = a * c - b * b
        regular = volume > 1e-6 * a * c
        volume = jnp.where(regular, volume, 1.0)
        u, v = dot(one, apart), dot(two, apart)
        step = jnp.stack([c * u - b * v, a * v - b * u]) / volume
        natural = jnp.where(regular, jnp.clip(natural + step, -BEYOND, BEYOND), natural)
    inside = shapes(natural)
    edges = nearest_on_edges(point, corners)
    apart = point - jnp.concatenate([inside[None], edges]) @ corners
    squares = dot(apart, apart)
    best = jnp.argmin(squares[1:])
    # A point within is taken for one though an edge that it is next to may be nearer by rounding.
    within = jnp.all(jnp.abs(natural) < 1.0) & (squares[0] <= squares[1:][best] * (1 + 1e-12))
    weights = jnp.where(within, inside, edges[best])
    apart = jnp.where(within, apart[0], apart[1:][best])
    one, two = slopes_at(natural, corners)
    normal = cross(one, two)
    size = safe_norm(normal)
    normal = normal / jnp.where(size > 0, size, 1.0)
    height = dot(normal, point - inside @ corners)
    edge = jnp.where(within, -1, best)
    return Nearest(weights, apart, normal, edge, squares[1:], natural, height, 2.0 * safe_sqrt(size))


class NodeOnFacets(DiscreteGap):
    """A node, or a ball about it, on the facets of a surface; `nc.Contact` makes such of whole surfaces.

    The nearest point of all facets counts, in their inside or on an edge, whatever it is at each place.

    Attributes:
        markers: the node, then nodes of the facets.
        facets: numbers among the markers of the corners of each facet (f, 4), in turn as seen from outside.
        open: 1 for each edge of each facet that is an end of the surface (f, 4), round which nodes go behind
            it without being pushed back; else 0.
        beyond: how far the surface goes on beyond each edge of each facet where it does so with facets that
            are not among these (f, 4) [m]; else 0. See `uncovered`.
        patch: number of the patch of the surface that each facet is of (f,): at sharp edges, which end it as
            those that are `open` do, the nearest patch counts alone. None: the surface is smooth.
        depth: how far the body reaches behind each facet (f,) [m]; a node that is farther behind is out again
            on its other side, and is not pushed back through it.
        thickness: distance of the node from the facets at which they touch [m]: that of both, halved.
        two_sided: 1 where facets are touched from both sides, as those of shells are, 0 where from outside.

    Source: T. A. Laursen, Computational Contact and Impact Mechanics, 2002, for the gap.

    Example:
        >>> import natcoord_jax as nc
        >>> corners = (nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)))
        >>> node = nc.Point(nc.ground, (0.5, 0.5, 1.0))
        >>> contact = nc.NodeOnFacets((node, *corners), facets=[(1, 2, 3, 4)], stiffness=1e4)
    """

    facets: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, 4))))
    open: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number() | Numbers((None, 4))))
    beyond: Any = eqx.field(
        default=0.0, kw_only=True, metadata=is_a(Number("not negative") | Numbers((None, 4)))
    )
    patch: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None,))))
    depth: Any = eqx.field(
        default=1e300, kw_only=True, metadata=is_a(Number("positive") | Numbers((None,), "positive"))
    )
    thickness: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))
    two_sided: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "node on facets"

    def measured(self, x: Float[Array, "k 3"]) -> Measured:
        """Height above the facets less thickness, its derivative, and the nearest facet."""
        (gap, facet), lever = jax.value_and_grad(self._height, has_aux=True)(x)
        return Measured(gap - self.thickness, lever, jnp.concatenate([jnp.zeros(1, facet.dtype), facet]))

    def _height(self, x: Float[Array, "k 3"]) -> tuple[Float[Array, ""], Int[Array, "4"]]:
        """Distance, negative behind the surface, and the corners of the nearest facet.

        Across an edge the heights above both facets pass into each other, so that its derivative has no jump;
        beyond an end of the surface there is the distance from it.
        """
        facets = jnp.asarray(self.facets).astype(int)
        every = jax.vmap(nearest_point, in_axes=(None, 0))(x[0], x[facets])
        best = jnp.argmin(dot(every.apart, every.apart))
        at = jax.tree.map(lambda y: y[best], every)
        ends = jnp.broadcast_to(jnp.asarray(self.open), facets.shape) > 0
        both = jnp.asarray(self.two_sided) > 0
        shares = jax.vmap(_share)(every, ends)
        shares = shares * (
            _level(every) if self.patch is None else _level(every, self.patch == self.patch[best])
        )
        rest = jnp.maximum(1.0 - jnp.sum(shares), 0.0)
        out = every.height < -jnp.broadcast_to(jnp.asarray(self.depth), every.height.shape)
        heights = jnp.where(both | out, jnp.abs(every.height), every.height)
        # Beside all of its facets a node is not behind them, wherever the surface goes on: see `uncovered`.
        # A corner is part of several edges, of which one that is an end decides.
        ending = ends | (jnp.broadcast_to(jnp.asarray(self.beyond), facets.shape) > 0)
        beside = (at.edge >= 0) & jnp.any(ending & _nearest(every))
        behind = (at.height < 0) & ~both & ~beside & ~out[best]
        aside = jnp.where(behind, -1.0, 1.0) * safe_norm(at.apart)
        return (jnp.sum(shares * heights) + rest * aside) / (jnp.sum(shares) + rest), facets[best]

    def uncovered(self, place: Array, rows: Float[Array, "k 4 3"]) -> dict[str, Array]:
        """Whether the node is beside its facets, where the surface goes on, and not in front of it."""
        x = place_markers(place, rows)
        facets = jnp.asarray(self.facets).astype(int)
        every = jax.vmap(nearest_point, in_axes=(None, 0))(x[0], x[facets])
        beyond = jnp.broadcast_to(jnp.asarray(self.beyond), facets.shape)
        beside = jnp.any(_nearest(every) & (every.to_edges < beyond**2))
        both = jnp.asarray(self.two_sided) > 0
        best = jnp.argmin(dot(every.apart, every.apart))
        height = every.height[best]
        out = height < -jnp.broadcast_to(jnp.asarray(self.depth), every.height.shape)[best]
        reached = jnp.where(both | out, jnp.abs(height), height) < self.thickness
        return {LEFT: beside & reached}


def _nearest(every: Nearest) -> Bool[Array, "f 4"]:
    """Which edges of all facets are the nearest, but for rounding."""
    return every.to_edges <= jnp.min(dot(every.apart, every.apart)) * (1 + 1e-9)


def _share(at: Nearest, ends: Float[Array, "4"]) -> Float[Array, ""]:
    """How much a facet counts where it passes nodes on to its neighbours: smoothly from one to none."""
    beyond = jnp.abs(at.natural) - 1.0
    smooth = jnp.clip(0.5 * (BLEND - beyond) / BLEND, 0.0, 1.0)
    smooth = smooth**2 * (3.0 - 2.0 * smooth)
    # The edges at xi = 1 and -1 are those from corners 1 and 3, at eta = 1 and -1 from corners 2 and 0.
    end = jnp.where(at.natural > 0, ends[jnp.array([1, 2])], ends[jnp.array([3, 0])])
    return jnp.prod(jnp.where(end, jnp.where(beyond < AT_END, 1.0, 0.0), smooth))


def _level(every: Nearest, some: Bool[Array, " f"] | None = None) -> Float[Array, " f"]:
    """How much facets, or some of them, count by how near they are."""
    heights = jnp.abs(every.height)
    least = jnp.min(heights if some is None else jnp.where(some, heights, jnp.inf))
    higher = (heights - least) / (LEVEL * jnp.where(every.size > 0, every.size, 1.0))
    return jnp.exp(-(higher**2)) if some is None else jnp.where(some, jnp.exp(-(higher**2)), 0.0)
