"""Gaps of boxes: with spheres, and with each other, by corners and edges that are a little round."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.effects.contact.gap import Gap
from natcoord_jax.effects.contact.pairs import RADIUS, direction, nearest_points
from natcoord_jax.maths.vectors import dot, safe_sqrt

BLEND = 0.1
"""Of the radius of round edges: by how much pairs of them may be farther than the nearest, to count."""

PARALLEL = 1e-3
"""Square of the sine of the angle between edges below which they are nearly parallel: their corners touch."""

AT_END = 0.5
"""Of the radius of round edges: how near to the end of one its corner touches in its place."""

TOWARDS_MIDDLE = 1e-6
"""As that of capsules; of edges, parallel ones do not count."""


def distance_from_box(place: Float[Array, "3"], half: Float[Array, "3"]) -> Float[Array, ""]:
    """Distance of a point from a box, inside of it to the nearest face and negative.

    Args:
        place: of the point in the axes of the box, from its centre [m].
        half: edges of the box, halved [m].
    """
    beyond = jnp.abs(place) - half
    outside = safe_sqrt(jnp.sum(jnp.where(beyond > 0, beyond, 0.0) ** 2))
    return jnp.where(outside > 0, outside, jnp.max(beyond))


class SphereOnBox(Gap):
    """A sphere beside a box, with round edges as the sphere sees them.

    Markers: the centre of the box, the centre of the sphere, and three directions of the box.

    Attributes:
        size: edges of the box (3,) [m].
        radius: of the sphere [m].
    """

    size: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((3,), "positive")))
    radius: Any = eqx.field(kw_only=True, metadata=is_a(RADIUS))

    markers: ClassVar[Markers] = Markers(2, 3)
    sides: ClassVar[tuple[int, int]] = (0, 1)

    def invariants(self, x: Float[Array, "5 3"]) -> Float[Array, "3"]:
        """Place of the sphere in the axes of the box [m]."""
        apart = x[1] - x[0]
        return jnp.stack([dot(axis, apart) for axis in x[2:5]])

    def distance(self, invariants: Float[Array, "3"]) -> Float[Array, ""]:
        """Distance from the box less radius; inside of it to the nearest face."""
        return distance_from_box(invariants, 0.5 * self.size) - self.radius

    def contact(self, x: Float[Array, "5 3"]) -> tuple[Array, Array]:
        """The point of the box that is nearest to a sphere outside of it."""
        place, half = self.invariants(x), 0.5 * self.size
        nearest = x[0] + jnp.clip(place, -half, half) @ x[2:5]
        return nearest, direction(x[1] - nearest)


class BetweenBoxes(Gap):
    """Base of gaps between two boxes whose edges and corners are round: balls roll along them.

    Within each box there is a smaller one, from which the surface is a radius away; gaps are distances of the
    smaller ones less two radii, which are smooth where the surfaces meet. Faces stay where they are.

    Markers: the centres of both boxes, three directions of the first, three of the second.

    Attributes:
        rounding: radius of the edges and corners of both [m], below half of the shortest edge.
    """

    rounding: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))

    markers: ClassVar[Markers] = Markers(2, 6)
    sides: ClassVar[tuple[int, int]] = (0, 1)

    def invariants(self, x: Float[Array, "8 3"]) -> Float[Array, "12"]:
        """Place of the second box in the axes of the first [m], and the cosines of all of their axes [-]."""
        vectors = jnp.concatenate([(x[1] - x[0])[None], x[5:8]])
        return dot(vectors[:, None], x[2:5]).reshape(-1)


class CornersOnBox(BetweenBoxes):
    """Whichever of two opposite corners of a box is the nearer to another box.

    Both cannot be near at once, and four of these are all the corners of a box.

    Attributes:
        size: edges of the first box (3,) [m].
        corner: one of the corners of the second, from its centre (3,) [m].

    Example:
        >>> import natcoord_jax as nc
        >>> gap = nc.CornersOnBox(size=(0.2, 0.2, 0.1), corner=(0.1, 0.1, 0.05), rounding=0.002)
    """

    size: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((3,), "positive")))
    corner: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((3,))))

    def distance(self, invariants: Float[Array, "12"]) -> Float[Array, ""]:
        """Of the nearer corner."""
        return jnp.min(self._distances(invariants)) - 2.0 * self.rounding

    def contact(self, x: Float[Array, "8 3"]) -> tuple[Array, Array]:
        """In the middle between the corner and the nearest point of the box."""
        place = self.invariants(x)
        turned = jnp.where(jnp.argmin(self._distances(place)) == 0, 1.0, -1.0)
        tip = x[1] + turned * self._inner @ x[5:8]
        half = 0.5 * self.size - self.rounding
        nearest = x[0] + jnp.clip(jnp.sum(x[2:5] * (tip - x[0]), axis=1), -half, half) @ x[2:5]
        return 0.5 * (nearest + tip), direction(tip - nearest)

    @property
    def _inner(self) -> Float[Array, "3"]:
        """The corner of the smaller box."""
        return self.corner - self.rounding * jnp.sign(self.corner)

    def _distances(self, invariants: Float[Array, "12"]) -> Float[Array, "2"]:
        """Of both corners from the smaller box."""
        place, turn = invariants[:3], invariants[3:].reshape(3, 3).T
        tip, half = jnp.sum(turn * self._inner, axis=1), 0.5 * self.size - self.rounding
        return jnp.stack([distance_from_box(place + tip, half), distance_from_box(place - tip, half)])


class EdgesOnEdges(BetweenBoxes):
    """The nearest of half of the edges of a box and half of those of another.

    Of the four edges along one axis it takes two opposite ones, which do not touch another box both at once.
    So four of these are all edges, and where a face of one box lies across a face of the other, each of the
    four crossings of their edges is the nearest of another of them. Of edges that are equally near, within
    a tenth of `rounding`, it is the mean distance that counts: it is smooth where the nearest changes.

    Attributes:
        sizes: edges of both boxes (2, 3) [m].
        skew: of either box (2,) [-]: 1 for the edges where the two other coordinates, in turn, have the same
            sign, -1 for those where they have different ones.

    Example:
        >>> import natcoord_jax as nc
        >>> sizes = (0.2, 0.2, 0.1), (0.3, 0.1, 0.1)
        >>> gap = nc.EdgesOnEdges(sizes=sizes, skew=(1, -1), rounding=0.002)
    """

    sizes: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((2, 3), "positive")))
    skew: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((2,))))

    def distance(self, invariants: Float[Array, "12"]) -> Float[Array, ""]:
        """Mean of the nearest."""
        place, turn = invariants[:3], invariants[3:].reshape(3, 3)
        (middles, halves), other = self._edges(0), self._edges(1)
        turned = [jnp.sum(x[..., None] * turn, axis=-2) for x in other]
        far, *_ = self._nearest(middles, halves, place + turned[0], turned[1])
        return jnp.sum(self._weights(far) * far) - 2.0 * self.rounding

    def contact(self, x: Float[Array, "8 3"]) -> tuple[Array, Array]:
        """In the middle between the edges, weighed as the gap follows them."""
        one, other = ([y @ x[2 + 3 * k : 5 + 3 * k] for y in self._edges(k)] for k in (0, 1))
        far, first, second = self._nearest(x[0] + one[0], one[1], x[1] + other[0], other[1])
        weights = self._weights(far)
        weights = weights * (1.0 - (far - jnp.sum(weights * far)) / (BLEND * self.rounding))
        normals = jax.vmap(jax.vmap(direction))(second - first)
        mean = lambda y: jnp.sum(weights[..., None] * y, axis=(0, 1))  # noqa: E731
        return mean(0.5 * (first + second)), direction(mean(normals))

    def _edges(self, box: int) -> tuple[Float[Array, "6 3"], Float[Array, "6 3"]]:
        """Middles of the edges of the smaller box that count, and halves of the edges, in its axes."""
        half = jnp.diag(0.5 * self.sizes[box] - self.rounding)
        middles = jnp.roll(half, -1, axis=0) + self.skew[box] * jnp.roll(half, -2, axis=0)
        return jnp.concatenate([middles, -middles]), jnp.concatenate([half, half])

    def _nearest(self, middles, halves, others, other_halves) -> tuple[Array, Array, Array]:
        """Distances of all pairs of edges, those without a crossing by `rounding` more, and where."""
        one, other = (2.0 * halves)[:, None], (2.0 * other_halves)[None]
        begin, end = (middles - halves)[:, None], (others - other_halves)[None]
        apart = begin - end
        pairs = (one, one), (other, other), (one, other), (one, apart), (other, apart), (apart, apart)
        products = jnp.stack([jnp.broadcast_to(dot(u, v), (6, 6)) for u, v in pairs])
        s, t = nearest_points(products, TOWARDS_MIDDLE)
        first, second = begin + s[..., None] * one, end + t[..., None] * other
        far = safe_sqrt(dot(second - first, second - first))
        crossing = 1.0 - jnp.exp((products[2] ** 2 / (products[0] * products[1]) - 1.0) / PARALLEL)
        for place, square in ((s, products[0]), (t, products[1])):
            end = (0.5 - jnp.abs(place - 0.5)) * safe_sqrt(square) / (AT_END * self.rounding)
            end = jnp.clip(end, 0.0, 1.0)
            crossing = crossing * (end * end * (3.0 - 2.0 * end))
        return far + self.rounding * (1.0 - crossing), first, second

    def _weights(self, far: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
        """How much each pair counts."""
        return jax.nn.softmax(-far / (BLEND * self.rounding), axis=(0, 1))
