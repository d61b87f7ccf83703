"""Friction between a node and the facets that it touches."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import marker_response, on_rows, place_markers
from natcoord_jax.effects.contact.friction import REGULARISED, missing_friction
from natcoord_jax.effects.contact.node_on_facets import NodeOnFacets, nearest_point, slopes_at
from natcoord_jax.maths.vectors import cross, dot, unit


class FrictionalNodeOnFacets(NodeOnFacets):
    """A node on the facets of a surface, as `nc.NodeOnFacets`, with friction.

    What slips are the places of the node along two directions that turn with the nearest facet, s = e . (x -
    sum w y), with the weights w of its corners held: they do not change when all points move as a rigid
    body, so that forces -D s^T f against their rates neither push nor turn as a whole, wherever the node is
    above the facet. Of shells friction acts on the middles of their thicknesses. The force is at most mu N,
    and what sticks is at rest, as with `nc.FrictionalGapPotential`. For schemes of one stage,
    `nc.EnergyMomentum()`.

    Attributes:
        friction: coefficient mu [-].
        regularisation: of the velocity of slip [m/s]; None: see `nc.GapConstraint`.
        mobility: change of the speed of closing by a unit impulse [1/kg], follows from the masses.
        phase: None, of schemes that locate impacts.

    Example:
        >>> import natcoord_jax as nc
        >>> corners = (nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)))
        >>> node, given = nc.Point(nc.ground, (0.5, 0.5, 1.0)), {"stiffness": 1e4, "friction": 0.3}
        >>> contact = nc.FrictionalNodeOnFacets((node, *corners), facets=[(1, 2, 3, 4)], **given)
    """

    friction: Any = eqx.field(kw_only=True, metadata=is_a(Number("not negative")))
    regularisation: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    mobility: Any = eqx.field(default=None, init=False)
    phase: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "node on facets with friction"
    multipliers: ClassVar[int] = 4
    unilateral: ClassVar[bool] = True
    bends: ClassVar[bool] = True
    slips: ClassVar[tuple[str, float] | None] = ("regularisation", REGULARISED)
    impulsive: ClassVar[bool] = True
    works: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleMethodOverride]

    def assembled_at(self, x: Float[Array, "k 3"]) -> "FrictionalNodeOnFacets":
        """With a mobility, which is found when the masses are known."""
        found: Any = super().assembled_at(x)
        return replace_fields(found, mobility=jnp.ones(()))

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """None: surfaces may overlap."""
        return jnp.zeros(1)

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """Metres."""
        return ("m",)

    def pushes(self, place: Array, rows: Array) -> Float[Array, "1 k 4 3"]:
        """Forces on the rows of the nodes per unit impulse along the gradient of the gap."""
        return on_rows(place, self.measured(place_markers(place, rows)).lever[None])

    def rubs(self, place: Array, rows: Array) -> Float[Array, "3 k 4 3"]:
        """The same of impulses against slip, by components."""
        x = place_markers(place, rows)
        return on_rows(place, jax.jacrev(lambda v: self.slip(x, v))(jnp.zeros_like(x)))

    def slip(self, x: Float[Array, "k 3"], rates: Float[Array, "k 3"]) -> Float[Array, "3"]:
        """Velocity with which the node slips on the nearest facet [m/s]."""
        facets = jnp.asarray(self.facets).astype(int)
        every = jax.vmap(nearest_point, in_axes=(None, 0))(x[0], x[facets])
        best = jnp.argmin(dot(every.apart, every.apart))
        at, facet = jax.tree.map(lambda y: y[best], every), facets[best]
        natural = jnp.clip(at.natural, -1.0, 1.0)

        def axes(x: Float[Array, "k 3"]) -> Float[Array, "2 3"]:
            one, two = slopes_at(natural, x[facet])
            first = unit(one)
            return jnp.stack([first, cross(unit(cross(one, two)), first)])

        def places(x: Float[Array, "k 3"]) -> Float[Array, "2"]:
            return axes(x) @ (x[0] - at.weights @ x[facet])

        return jax.jvp(places, (x,), (rates,))[1] @ axes(x)

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Array, *, turning: bool
    ) -> Array | None:
        """None: those of the response, with its multipliers."""
        return None

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The impulse along the normal is that of the energy's mean force, friction at most mu times it."""
        start, x = place_markers(place, motion.start), place_markers(place, motion.rows)
        rates, weights = place_markers(place, motion.rates), jnp.asarray(now.tableau.b)
        begun, ended, derivatives = self._discrete(start, x, now.h * rates, weights)
        elastic = now.h * self.mean_force(begun.gap, ended.gap)
        closing = -jnp.einsum("i,ikx,ikx->", weights, derivatives, rates)
        # Where a contact is stiffer than the step is short, its equation is in terms of places.
        scale = 0.5 * self.mobility / (1.0 + 0.25 * self.mobility * self.stiffness * now.h**2)
        found = scale * (lam[0, 0] - self.lossy(closing) * elastic)
        slip, pulled = jax.vjp(lambda v: self.slip(x[0], v), rates[0])
        along = lam[0, 1:]
        missing = missing_friction(along, slip, self.friction * lam[0, 0], self.regularisation)
        forces = lam[0, 0] * derivatives + pulled(along)[0]
        response = marker_response(place, forces, None, rates, motion)
        rows = jnp.concatenate([found[None], self.mobility * missing])[None]
        return replace_fields(response, rows=rows, released=(-elastic * closing)[None])
