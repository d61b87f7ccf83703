"""Contact of many spheres by the energy of their overlaps, of which only those that are near are looked at.

Neighbours are found once, at the start of a step, within what each sphere would pass in it at its velocity
and a skin for what it may stray from that way. What strays farther is reported, and the step is repeated in
parts. To keep neighbours over some steps would save a seventh of the time at most. Every pair is evaluated
from both of its sides: each sphere sums up its own neighbours, and what one gets the other gets with the
other sign, to the last digit.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.closed_tangents import by_twists, twist_maps
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import NAME
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.motion import Motion, NeighbourTangents, Response, SpreadTangents, StepContext
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.potential import marker_response, place_markers
from natcoord_jax.effects.contact.law import ContactLaw
from natcoord_jax.effects.contact.pairs import length
from natcoord_jax.maths.near_spheres import Neighbours, near_spheres
from natcoord_jax.maths.vectors import safe_norm

ROOM = 16
"""Neighbours that a sphere has room for: twelve equal ones can touch it."""

SKIN = 0.25
"""Skin, of the largest radius."""


class SphereContacts(ContactLaw):
    """Contact of many spheres with each other by an energy of the overlap, as `nc.GapPotential` of each pair.

    For schemes of order two. Usually made by `nc.Contact(all_pairs_of=...)` of many spheres.

    Attributes:
        markers: their centres.
        radii: of them (n,) [m].
        ignored: pairs that are not in contact (m, 2), as numbers of spheres.
        capacity: neighbours that a sphere has room for.
        skin: by how much two spheres together may stray in a step from where their velocities take them [m];
            None: a quarter of the largest radius.
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".
        restitution: part of the closing speed that is left after an impact [-], above 0 up to 1; None: all.
        speed: of the impact that `restitution` is of [m/s].
        damping: part of the force per closing speed [s/m], follows from the two.

    Raises:
        ValueError: for a restitution above one, or one without the speed that it is of; and where it is used
            by a scheme of another order.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> centres = tuple(nc.Point(nc.ground, (0.25 * k, 0, 0)) for k in range(3))
        >>> contacts = nc.SphereContacts(centres, radii=np.full(3, 0.1), stiffness=1e5)
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    radii: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None,), "not negative")))
    ignored: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 2))))
    capacity: int = eqx.field(default=ROOM, kw_only=True, static=True, metadata=is_a(Whole(1)))
    skin: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))

    kind: ClassVar[str] = "contact of spheres"
    spread: ClassVar[bool] = True
    silent: ClassVar[bool] = True

    def attach(self, find: Any) -> Any:
        """Their centres."""
        return self.markers

    def assembled_at(self, x: Float[Array, "k 3"]) -> "SphereContacts":
        """With its damping and its skin."""
        ignored = jnp.asarray(np.zeros((0, 2)) if self.ignored is None else self.ignored, jnp.int32)
        skin = SKIN * jnp.max(self.radii) if self.skin is None else self.skin
        whole: Any = replace_fields(self, ignored=ignored, skin=skin)
        return whole.renewed()

    def neighbours(self, place: Array, rows: Array, rates: Array, h: Array) -> Neighbours:
        """Those that each sphere may touch in a step, half of the skin off its way at most."""
        way = h * place_markers(place, rates)
        centres = place_markers(place, rows) + 0.5 * way
        # What all have in common brings none nearer to another.
        reach = 0.5 * safe_norm(way - jnp.mean(way, axis=0))
        found = near_spheres(centres, self.radii + reach + 0.5 * self.skin, self.capacity)
        one = jnp.arange(place.shape[0])[:, None]
        return replace_fields(found, near=found.near & self._meet(one, found.others))

    def _meet(self, one: Int[Array, "*n"], other: Int[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether pairs are in contact, if they touch."""
        one, other, (first, second) = one[..., None], other[..., None], self.ignored.T
        ignored = ((one == first) & (other == second)) | ((one == second) & (other == first))
        return ~jnp.any(ignored, axis=-1)

    def missed(
        self, place: Array, found: Neighbours, start: Array, rates: Array, end: Array, h: Array
    ) -> Int[Array, "2 2"]:
        """The sphere that has strayed farthest with what is nearest to it, if it has by half of the skin."""
        x = place_markers(place, end)
        strayed = x - place_markers(place, start) - h * place_markers(place, rates)
        square = jnp.sum(strayed**2, axis=1)
        worst = jnp.argmax(square)
        between = jnp.sqrt(jnp.sum((x - x[worst]) ** 2, axis=1)) - self.radii
        nearest = jnp.argmin(jnp.where(jnp.arange(x.shape[0]) == worst, jnp.inf, between))
        too_far = square[worst] > (0.5 * self.skin) ** 2
        return jnp.stack([jnp.where(too_far, jnp.stack([worst, nearest]), -1), found.left_out])

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Float[Array, ""]:
        """Energy [J], of all pairs, whether anyone has found them."""
        x = place_markers(place, rows)
        every = jnp.arange(x.shape[0])

        def one(number: Array, energy: Array) -> Array:
            square = jnp.sum((x - x[number]) ** 2, axis=1)
            found = self.stored_at(length(square) - self.radii - self.radii[number])
            return energy + jnp.sum(jnp.where((every > number) & self._meet(number, every), found, 0.0))

        return jax.lax.fori_loop(0, x.shape[0], one, jnp.zeros((), x.dtype))

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """On each sphere what its neighbours push it by, along the mean of the line between them."""
        self._check(now)
        rates = place_markers(place, motion.rates)
        near, velocity = now.neighbours, rates[0].T
        given = self._between(near, place_markers(place, motion.start).T, now.h * velocity)
        elastic, factor = self._pushes(*given, _apart(velocity, near))
        found = marker_response(place, -jnp.sum(factor * elastic, axis=1).T[None], None, rates, motion)
        if self.damping is None:
            return found
        return replace_fields(found, released=-jnp.sum(jnp.sum(elastic, axis=1) * velocity)[None])

    def _check(self, now: StepContext) -> None:
        if now.tableau.stages > 1 or now.tableau.variational:
            raise ValueError(
                "contact of many spheres: its forces are exact for the energy-momentum method of order two "
                "only; pass scheme=nc.EnergyMomentum() or nc.Dissipative(), or list the pairs of fewer bodies"
            )

    def _between(
        self, near: Neighbours, start: Float[Array, "3 n"], moved: Float[Array, "3 n"]
    ) -> tuple[Float[Array, "3 room n"], Float[Array, "3 room n"], Float[Array, "room n"]]:
        """From each sphere to its neighbours at the start, its change in the step, and the sum of radii.

        The sum is zero where there is no neighbour: what has no size does not overlap.
        """
        radii = jnp.where(near.near.T, self.radii[near.others.T] + self.radii, 0.0)
        return _apart(start, near), _apart(moved, near), radii

    def _pushes(
        self, start: Array, moved: Array, radii: Array, flow: Array
    ) -> tuple[Float[Array, "3 room n"], Float[Array, "*room n"]]:
        """Mean forces of the energy on neighbours [N], and the factor by which impacts change them.

        Along u = 2 r_m / (|r_0| + |r_1|) with the vectors r from one to the other at the start, in the middle
        and at the end of the step: the distance changes by u . (r_1 - r_0), exactly.
        """
        middle = start + 0.5 * moved
        square = jnp.sum(start * start, axis=0)
        begun, ended = length(square), length(square + 2.0 * jnp.sum(middle * moved, axis=0))
        both = begun + ended
        along = 2.0 * middle / jnp.where(both > 0, both, 1.0)
        before = begun - radii
        elastic = self.mean_force(before, before + jnp.sum(along * moved, axis=0)) * along
        if self.damping is None:
            return elastic, jnp.ones(())
        return elastic, 1.0 + jnp.maximum(-self.damping * jnp.sum(along * flow, axis=0), -1.0)

    @property
    def parts(self) -> Int[np.ndarray, "n k 1"]:
        """Each sphere by itself."""
        shape = np.shape(self.radii)
        return np.broadcast_to(np.arange(shape[-1]), shape)[..., None]

    def spread_tangents(
        self, place: Array, motion: Motion, now: StepContext, *, turning: bool
    ) -> SpreadTangents:
        """Of each sphere by its own motion, and by that of its neighbours."""
        n, k = place.shape[:2]

        def one(contact: "SphereContacts", near: Neighbours, place: Array, start: Array, rates: Array) -> Any:
            velocity = place_markers(place, rates).T
            begun, moved, radii = contact._between(near, place_markers(place, start).T, now.h * velocity)
            rate = 1.0 / jnp.where(now.h > 0, now.h, 1.0)

            def pushes(moved: Array) -> Array:
                elastic, factor = contact._pushes(begun, moved, radii, rate * moved)
                return factor * elastic

            units = jnp.broadcast_to(jnp.eye(3)[..., None, None], (3, *moved.shape))
            slopes = jax.vmap(lambda unit: jax.jvp(pushes, (moved,), (unit,))[1], out_axes=1)(units)
            return -jnp.sum(pushes(moved), axis=1), slopes

        given = now.neighbours, place, motion.start, motion.rates[0]
        forces, slopes = jax.vmap(one)(self, *given)

        def alone(x: Array, axis: int = 0) -> Array:
            return x.reshape(*x.shape[:axis], n * k, 1, *x.shape[axis + 2 :])

        every = Motion(alone(motion.start), *(alone(x, 1) for x in (motion.rows, motion.rates, motion.spin)))
        own = alone(place)[:, :, None]
        stiffness = -jnp.moveaxis(jnp.sum(slopes, axis=3), -1, 1).reshape(-1, 3, 3)
        pushed = jnp.swapaxes(forces, 1, 2).reshape(-1, 1, 1, 3)
        parts = by_twists(stiffness, pushed, own, every, now.h, turning)
        if turning:
            across, along, _ = twist_maps(own, every, now.h)
        else:
            across = along = own[..., :1, None] * jnp.eye(3)
        maps = (x.reshape(n, k, 1, -1, 3) for x in (across, along))
        others = jnp.swapaxes(now.neighbours.others, 1, 2)
        return SpreadTangents(parts, neighbours=NeighbourTangents(others, now.h * slopes, *maps))


def _apart(x: Float[Array, "3 n"], near: Neighbours) -> Float[Array, "3 room n"]:
    """What neighbours have more than the spheres whose they are."""
    return x[:, near.others.T] - x[:, None]
