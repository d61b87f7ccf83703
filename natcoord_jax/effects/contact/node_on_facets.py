"""Gap between a node and a surface of quadrilaterals that move with their corners."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.effects.contact.discrete_gap import DiscreteGap, Measured
from natcoord_jax.maths.vectors import cross, dot, safe_norm

XI, ETA = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the corners."""

ITERATIONS = 6
"""Of Newton's method for the nearest point of a facet, from its middle: warped ones take five."""


class Nearest(eqx.Module):
    """The nearest point of a facet.

    Attributes:
        weights: of the corners.
        apart: from it to the point that it is the nearest to [m].
        normal: of the facet there, of unit length [-].
        edge: on which it is, by the number of the edge's first corner; -1: within the facet.
    """

    weights: Float[Array, "4"]
    apart: Float[Array, "3"]
    normal: Float[Array, "3"]
    edge: Int[Array, ""]


def shapes(natural: Float[Array, "2"]) -> Float[Array, "4"]:
    """Shape functions of a quadrilateral."""
    return 0.25 * (1 + XI * natural[0]) * (1 + ETA * natural[1])


def _slopes(natural: Float[Array, "2"], corners: Float[Array, "4 3"]) -> tuple[Array, Array]:
    """Derivatives of the place by the natural coordinates."""
    by_xi, by_eta = 0.25 * XI * (1 + ETA * natural[1]), 0.25 * ETA * (1 + XI * natural[0])
    return by_xi @ corners, by_eta @ corners


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
    for _ in range(ITERATIONS):
        one, two = _slopes(natural, corners)
        apart = point - shapes(natural) @ corners
        a, b, c = dot(one, one), dot(one, two) - dot(apart, warp), dot(two, two)
        volume = a * c - b * b
        regular = volume > 1e-6 * a * c
        volume = jnp.where(regular, volume, 1.0)
        u, v = dot(one, apart), dot(two, apart)
        step = jnp.stack([c * u - b * v, a * v - b * u]) / volume
        natural = jnp.where(regular, jnp.clip(natural + step, -1.0, 1.0), natural)
    inside = shapes(natural)
    along = jnp.roll(corners, -1, axis=0) - corners
    length = dot(along, along)
    some = length > 0
    share = jnp.clip(dot(point - corners, along) / jnp.where(some, length, 1.0), 0.0, 1.0)
    share = jnp.where(some, share, 0.0)
    unit = np.eye(4)
    edges = unit + share[:, None] * (np.roll(unit, -1, axis=0) - unit)
    apart = point - jnp.concatenate([inside[None], edges]) @ corners
    squares = dot(apart, apart)
    best = jnp.argmin(squares[1:])
    # A point within is taken for one though an edge that it is next to may be nearer by rounding.
    within = jnp.all(jnp.abs(natural) < 1.0) & (squares[0] <= squares[1:][best] * (1 + 1e-12))
    weights = jnp.where(within, inside, edges[best])
    apart = jnp.where(within, apart[0], apart[1:][best])
    one, two = _slopes(natural, corners)
    normal = cross(one, two)
    size = safe_norm(normal)
    return Nearest(weights, apart, normal / jnp.where(size > 0, size, 1.0), jnp.where(within, -1, best))


class NodeOnFacets(DiscreteGap):
    """A node, or a ball about it, on the facets of a surface; `nc.Contact` makes such of whole surfaces.

    The nearest point of all facets counts, in their inside or on an edge, whatever it is at each place.

    Attributes:
        markers: the node, then nodes of the facets.
        facets: numbers among the markers of the corners of each facet (f, 4), in turn as seen from outside.
        open: 1 for each edge of each facet that is an end of the surface (f, 4), round which nodes go behind
            it without being pushed back; else 0.
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
    thickness: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))
    two_sided: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "node on facets"

    def measured(self, x: Float[Array, "k 3"]) -> Measured:
        """Distance from the nearest facet less thickness, and the direction in which it grows."""
        facets = jnp.asarray(self.facets).astype(int)
        every = jax.vmap(nearest_point, in_axes=(None, 0))(x[0], x[facets])
        best = jnp.argmin(dot(every.apart, every.apart))
        at = jax.tree.map(lambda y: y[best], every)
        distance, height = safe_norm(at.apart), dot(at.normal, at.apart)
        direction = at.apart / jnp.where(distance > 0, distance, 1.0)
        ends = jnp.broadcast_to(jnp.asarray(self.open), facets.shape)[best, at.edge] > 0
        within, both = at.edge < 0, jnp.asarray(self.two_sided) > 0
        side = jnp.where((height < 0) & (within | ~ends) & ~both, -1.0, 1.0)
        # The normal has a direction where the node is on the facet, too.
        signed = within & ~both
        distance = jnp.where(signed, height, side * distance)
        direction = jnp.where(signed, at.normal, side * direction)
        corners = facets[best]
        lever = jnp.zeros_like(x).at[0].set(direction).at[corners].add(-at.weights[:, None] * direction)
        return Measured(
            distance - self.thickness, lever, jnp.concatenate([jnp.zeros(1, corners.dtype), corners])
        )
