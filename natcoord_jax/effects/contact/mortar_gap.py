"""The mean gap of facets at a node over the facets of another surface (mortar method)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.potential import place_markers
from natcoord_jax.effects.contact.discrete_gap import DiscreteGap, Measured
from natcoord_jax.effects.contact.law import ContactReadings
from natcoord_jax.effects.contact.segments import segment, whole

LEFT = (
    "and the facets at it have left those that they may touch, which are those that were nearest in the "
    "assembled pose, so that a contact is missed; pass more `candidates` to nc.Contact, or assemble the "
    "parts where they meet"
)

COVERED = 1 - 1e-6
"""Part of the facets at a node that is covered, but for rounding, where all of them is."""


class MortarGap(DiscreteGap):
    """The mean gap at a node of a surface over another one; `nc.Contact(..., method="mortar")` makes them.

    The gap between the facets at the node and those that they face, along their normals, is averaged with the
    shape function of the node, by the segments that facets have in common. So a uniform pressure passes
    exactly from one mesh to another, whatever they are. What is not covered by the other surface counts with
    a gap of zero: a facet that hangs over touches with less of its overlap.

    Attributes:
        markers: the node, then other nodes of both surfaces.
        facets: numbers among the markers of the corners of each facet at the node (f, 4), in turn as seen
            from outside; what fills up is four times the same.
        others: of each facet of the other surface (g, 4), in turn as seen from outside.
        open: 1 for each side of these (g, 4) that is an end of their surface, else 0: nodes that are on an
            end but for rounding are covered.
        rims: 1 for each of these beyond which that surface goes on with facets that are not among them (g,),
            else 0; see `uncovered`.
        thickness: distance of the facets at which they touch [m]: that of both, halved.

    Source: M. A. Puso and T. A. Laursen, Comput. Methods Appl. Mech. Engrg. 193 (2004) 601-629.

    Example:
        >>> import natcoord_jax as nc
        >>> low = [nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))]
        >>> up = [nc.Point(nc.ground, x) for x in ((0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1))]
        >>> given = {"facets": [(0, 1, 2, 3)], "others": [(4, 5, 6, 7)]}
        >>> contact = nc.MortarGap((*up, *low), stiffness=1e4, **given)
    """

    facets: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, 4))))
    others: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, 4))))
    open: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number() | Numbers((None, 4))))
    rims: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number() | Numbers((None,))))
    thickness: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number("not negative")))

    kind: ClassVar[str] = "mortar contact"

    def _numbers(
        self,
    ) -> tuple[Int[Array, "f 4"], Float[Array, "f 4"], Int[Array, "g 4"], Float[Array, "g 4"]]:
        """Of facets at the node, which of their corners it is, of the others, and which sides are ends."""
        own, other = (jnp.asarray(corners).astype(int) for corners in (self.facets, self.others))
        ends = jnp.broadcast_to(jnp.asarray(self.open), other.shape)
        return own, (own == 0).astype(ends.dtype), other, ends

    def _segments(self, x: Float[Array, "k 3"]) -> tuple[Float[Array, "f g"], Float[Array, "f g"]]:
        """Of each facet at the node with each of the others."""
        own, of, other, ends = self._numbers()
        each = jax.vmap(segment, in_axes=(None, None, 0, 0))
        return jax.vmap(each, in_axes=(0, 0, None, None))(x[own], of, x[other], ends)

    def _areas(self, x: Float[Array, "k 3"]) -> Float[Array, " f"]:
        own, of, *_ = self._numbers()
        return jax.vmap(whole)(x[own], of)

    def _area(self, x: Float[Array, "k 3"]) -> Float[Array, ""]:
        area = jnp.sum(self._areas(x))
        return jnp.where(area > 0, area, 1.0)

    def gap(self, x: Float[Array, "k 3"]) -> Float[Array, ""]:
        """The mean gap [m]."""
        gaps, areas = self._segments(x)
        return (jnp.sum(gaps) - self.thickness * jnp.sum(areas)) / self._area(x)

    def measured(self, x: Float[Array, "k 3"]) -> Measured:
        """The mean gap, its derivative, and all nodes."""
        return Measured(*jax.value_and_grad(self.gap)(x), jnp.arange(len(x)))

    def touch(self, place: Array, rows: Array) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The node [m], and the force on the corners of the facets at it by the force of the law [-]."""
        x = place_markers(place, rows)
        own = jnp.zeros(len(x)).at[self._numbers()[0].reshape(-1)].set(1.0)
        return x[0], own @ self.measured(x).lever

    def turned(self, x: Float[Array, "k 3"]) -> Float[Array, "k 3 k 3"]:
        """Second derivatives of the gap: of pairs of facets by their own corners, with few points."""
        own, of, other, ends = self._numbers()
        count = len(other)
        both = jnp.concatenate([jnp.repeat(own, count, axis=0), jnp.tile(other, (len(own), 1))], axis=1)
        of, ends = jnp.repeat(of, count, axis=0), jnp.tile(ends, (len(own), 1))
        mean, lever = jax.value_and_grad(self.gap)(x)
        area, grown = jax.value_and_grad(self._area)(x)

        # A mean I / A is that where I - mean A vanishes.
        def missing(
            x: Float[Array, "8 3"], of: Float[Array, "4"], ends: Float[Array, "4"]
        ) -> Float[Array, ""]:
            gap, covered = segment(x[:4], of, x[4:], ends, nearly=True)
            return (gap - self.thickness * covered - mean * whole(x[:4], of) / count) / area

        each = jax.vmap(jax.hessian(missing))(x[both], of, ends)
        found = jnp.zeros((len(x), len(x), 3, 3), x.dtype)
        found = found.at[both[:, :, None], both[:, None]].add(jnp.swapaxes(each, 2, 3))
        shared = jnp.einsum("ax,by->axby", lever, grown) / area
        return jnp.swapaxes(found, 1, 2) - shared - jnp.transpose(shared, (2, 3, 0, 1))

    def readings(self, place: Array, rows: Array) -> ContactReadings:
        """Gap and force; the gap is infinite where no facet faces those at the node."""
        found = super().readings(place, rows)
        covered = jnp.sum(self._segments(place_markers(place, rows))[1]) > 0
        return replace_fields(found, gap=jnp.where(covered, found.gap, jnp.inf))

    def uncovered(self, place: Array, rows: Float[Array, "k 4 3"]) -> dict[str, Array]:
        """Whether facets in contact are beyond those that they may touch, where the surface goes on."""
        x = place_markers(place, rows)
        areas = self._segments(x)[1]
        beyond = jnp.sum(areas, axis=1) < COVERED * self._areas(x)
        at_rim = jnp.any((areas > 0) & (jnp.asarray(self.rims) > 0), axis=1)
        return {LEFT: (self.gap(x) < 0) & jnp.any(beyond & at_rim)}
