"""Contact of many capsules and spheres by the energy of their overlaps: only what is near is looked at.

Neighbours are found once, at the start of a step, within what each would pass in it at its velocity and a
skin for what it may stray from that way. What strays farther is reported, and the step is repeated in parts.
To keep neighbours over some steps would save a seventh of the time at most. Every pair is evaluated once, and
each of the two sums up what its own pairs push it by.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.closed_tangents import by_twists, twist_maps
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, NeighbourTangents, Response, SpreadTangents, StepContext
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.potential import marker_response, place_markers
from natcoord_jax.effects.contact.law import ContactLaw
from natcoord_jax.effects.contact.near_capsules import near_capsules
from natcoord_jax.effects.contact.pair_distance import Pushes, distance, products, rates_of, vectors
from natcoord_jax.effects.contact.pairs import CapsuleOnCapsule, SphereOnSphere
from natcoord_jax.maths.near_spheres import Pairs, each_once
from natcoord_jax.maths.vectors import safe_norm

ROOM = 16
"""Neighbours that each has room for: twelve equal spheres can touch one."""

SKIN = 0.25
"""Skin, of the largest radius."""


class CapsuleContacts(ContactLaw):
    """Contact of many capsules and spheres with each other, as `nc.GapPotential` of each pair.

    A sphere is a capsule of no length. For schemes of order two. Usually made by
    `nc.Contact(all_pairs_of=...)` of many bodies.

    Attributes:
        markers: the centres of spheres; of capsules, with spheres among them or not, the first ends of all
            segments, and then the second ends, each of the same body.
        radii: of them (n,) [m].
        ignored: pairs that are not in contact (m, 2), as numbers of capsules.
        capacity: neighbours that each has room for.
        skin: by how much two of them together may stray in a step from where their velocities take them [m];
            None: a quarter of the largest radius.
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".
        restitution: part of the closing speed that is left after an impact [-], above 0 up to 1; None: all.
        speed: of the impact that `restitution` is of [m/s].
        damping: part of the force per closing speed [s/m], follows from the two.
        exempt: of each, others that it is not in contact with; -1 for none.

    Raises:
        ValueError: for other markers than these, a restitution above one, or one without the speed that it is
            of; and where it is used by a scheme of another order.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> centres = tuple(nc.Point(nc.ground, (0.25 * k, 0, 0)) for k in range(3))
        >>> contacts = nc.CapsuleContacts(centres, radii=np.full(3, 0.1), stiffness=1e5)
        >>> above = tuple(nc.Point(nc.ground, (0.25 * k, 0, 0.2)) for k in range(3))
        >>> contacts = nc.CapsuleContacts(centres + above, radii=np.full(3, 0.1), stiffness=1e5)
    """

    radii: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None,), "not negative")))
    ignored: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 2))))
    capacity: int = eqx.field(default=ROOM, kw_only=True, static=True, metadata=is_a(Whole(1)))
    skin: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    exempt: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "contact of capsules"
    spread: ClassVar[bool] = True
    silent: ClassVar[bool] = True

    def __check_init__(self) -> None:
        """Refuse markers that are no centres or ends."""
        n = len(self.radii)
        if len(self.markers) not in (n, 2 * n):
            raise ValueError(
                f"CapsuleContacts: there are {len(self.markers)} markers and {n} radii [m]; pass a centre "
                "for each radius, or the first ends of all segments and then their second ends"
            )
        if any(one.handles != other.handles for one, other in zip(self.markers, self.markers[n:])):
            raise ValueError(
                "CapsuleContacts: both ends of a segment are points of one body, which these are not; pass "
                "the first ends of all segments and then the second ends in the same order"
            )

    def assembled_at(self, x: Float[Array, "k 3"]) -> "CapsuleContacts":
        """With its damping, its skin, and who does not touch whom."""
        skin = SKIN * jnp.max(self.radii) if self.skin is None else self.skin
        ignored = np.zeros((0, 2)) if self.ignored is None else self.ignored
        whole: Any = replace_fields(self, skin=skin, ignored=ignored)
        return replace_fields(whole.renewed(), exempt=_by_number(np.asarray(ignored, int), len(self.radii)))

    def _ends(self, x: Float[Array, "k 3"]) -> Float[Array, "v 3 n"]:
        """Centres of spheres, or both ends of segments."""
        return jnp.swapaxes(x.reshape(-1, self.radii.shape[0], 3), 1, 2)

    def ends(self, place: Array, rows: Array) -> Float[Array, "v 3 n"]:
        """Centres of spheres, or both ends of segments, of bodies with these rows [m]."""
        return self._ends(place_markers(place, rows))

    def gaps(self, ends: Float[Array, "v 3 n"], pairs: Int[Array, "2 p"]) -> Float[Array, " p"]:
        """Between the surfaces of pairs; negative where they overlap [m]."""
        found = vectors(ends, pairs)
        return distance(products(found, found)) - jnp.sum(self.radii[pairs], axis=0)

    def touch(
        self, ends: Float[Array, "v 3 n"], pairs: Int[Array, "2 p"]
    ) -> tuple[Float[Array, "p 3"], Float[Array, "p 3"]]:
        """Where the surfaces of pairs touch [m], and the directions in which the second ones are pushed."""
        both = jnp.transpose(ends[..., pairs], (3, 2, 0, 1)).reshape(pairs.shape[1], 2 * ends.shape[0], 3)
        kind = SphereOnSphere if ends.shape[0] == 1 else CapsuleOnCapsule
        return jax.vmap(lambda x, radii: kind(radii=radii).touch(x))(both, self.radii[pairs].T)

    def neighbours(self, place: Array, rows: Array, rates: Array, h: Array) -> Pairs:
        """Those that may touch each other in a step, half of the skin off their ways at most."""
        way = h * self._ends(place_markers(place, rates))
        middle = self._ends(place_markers(place, rows)) + 0.5 * way
        # What all have in common brings none nearer to another.
        astray = way - jnp.mean(way, axis=(0, 2))[:, None]
        reach = 0.5 * jnp.max(safe_norm(jnp.swapaxes(astray, 1, 2)), axis=0)
        sizes = self.radii + reach + 0.5 * self.skin
        return each_once(near_capsules(middle, sizes, self.exempt, self.capacity))

    def missed(
        self, place: Array, found: Pairs, start: Array, rates: Array, end: Array, h: Array
    ) -> Int[Array, "2 2"]:
        """What has strayed farthest with what is nearest to it, if it has by half of the skin."""
        x, begun, velocity = (self._ends(place_markers(place, y)) for y in (end, start, rates))
        square = jnp.max(jnp.sum((x - begun - h * velocity) ** 2, axis=1), axis=0)
        worst, every = jnp.argmax(square), jnp.arange(square.shape[0])
        between = self._distances(x, worst) - self.radii
        nearest = jnp.argmin(jnp.where(every == worst, jnp.inf, between))
        too_far = square[worst] > (0.5 * self.skin) ** 2
        return jnp.stack([jnp.where(too_far, jnp.stack([worst, nearest]), -1), found.left_out])

    def _distances(self, ends: Float[Array, "v 3 n"], one: Int[Array, ""]) -> Float[Array, " n"]:
        """Of the segments, or centres, from one of them."""
        every = jnp.arange(ends.shape[2])
        found = vectors(ends, jnp.stack([jnp.full_like(every, one), every]))
        return distance(products(found, found))

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Float[Array, ""]:
        """Energy [J], of all pairs, whether anyone has found them."""
        ends = self._ends(place_markers(place, rows))
        every = jnp.arange(ends.shape[2])

        def one(number: Array, energy: Array) -> Array:
            found = self.stored_at(self._distances(ends, number) - self.radii - self.radii[number])
            exempt = jnp.any(every[:, None] == self.exempt[number], axis=1)
            return energy + jnp.sum(jnp.where((every > number) & ~exempt, found, 0.0))

        return jax.lax.fori_loop(0, ends.shape[2], one, jnp.zeros((), ends.dtype))

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """On each what its neighbours push it by."""
        self._check(now)
        velocities = place_markers(place, motion.rates)
        pushes, velocity = self._pushes(place, motion.start, velocities[0], now)
        flow = rates_of(pushes.middle(velocity), velocity)
        elastic, lossy = pushes.gradients(flow)
        forces = now.neighbours.summed(pushes.forces(lossy, velocity))
        forces = jnp.swapaxes(forces, 1, 2).reshape(1, -1, 3)
        response = marker_response(place, forces, None, velocities, motion)
        if self.damping is None:
            return response
        return replace_fields(response, released=-jnp.sum(elastic * flow)[None])

    def _pushes(
        self, place: Array, start: Array, velocity: Float[Array, "k 3"], now: StepContext
    ) -> tuple[Pushes, Float[Array, "d 3 p"]]:
        """What pairs do to each other in a step, and the velocities of the vectors between them."""
        pairs: Pairs = now.neighbours
        begun, rates = self._ends(place_markers(place, start)), self._ends(velocity)
        radii = jnp.where(pairs.there, jnp.sum(self.radii[pairs.both], axis=0), 0.0)
        pushes = Pushes(self, radii, vectors(begun, pairs.both), now.h, now.tableau)
        return pushes, vectors(rates, pairs.both)

    def _check(self, now: StepContext) -> None:
        if now.tableau.stages > 1 or now.tableau.variational:
            raise ValueError(
                "contact of many bodies: its forces are exact for the energy-momentum method of order two "
                "only; pass scheme=nc.EnergyMomentum() or nc.Dissipative(), or list the pairs of fewer bodies"
            )

    @property
    def parts(self) -> Int[np.ndarray, "n k 1"]:
        """Each by itself: both ends are of one body."""
        shape = np.shape(self.radii)
        return np.broadcast_to(np.arange(shape[-1]), shape)[..., None]

    def spread_tangents(
        self, place: Array, motion: Motion, now: StepContext, *, turning: bool
    ) -> SpreadTangents:
        """Of each by its own motion, and by that of its neighbours."""
        count, n = self.radii.shape
        ends = place.shape[1] // n
        width = 3 * ends

        def one(contact: "CapsuleContacts", pairs: Pairs, place: Array, start: Array, rates: Array) -> Any:
            here = replace_fields(now, neighbours=pairs)
            pushes, velocity = contact._pushes(place, start, place_markers(place, rates), here)
            forces, slopes = pushes.tangents(velocity)
            first, second = slice(None, width), slice(width, None)
            own = pairs.summed(jnp.stack([slopes[first, first], slopes[second, second]], axis=2))
            across = jnp.stack([slopes[first, second], slopes[second, first]])
            return pairs.summed(forces), own, across

        given = now.neighbours, place, motion.start, motion.rates[0]
        forces, own, across = jax.vmap(one)(self, *given)

        def alone(x: Array, axis: int = 0) -> Array:
            return jnp.take(x, np.arange(n), axis + 1).reshape(*x.shape[:axis], -1, 1, *x.shape[axis + 2 :])

        every = Motion(alone(motion.start), *(alone(x, 1) for x in (motion.rows, motion.rates, motion.spin)))
        places = jnp.swapaxes(place.reshape(count, ends, n, -1), 1, 2).reshape(count * n, 1, ends, -1)
        stiffness = jnp.moveaxis(own, -1, 1).reshape(-1, width, width)
        pushed = jnp.transpose(forces, (0, 3, 1, 2)).reshape(-1, 1, ends, 3)
        parts = by_twists(stiffness, pushed, places, every, now.h, turning)
        if turning:
            maps = twist_maps(places, every, now.h)[:2]
        else:
            maps = (places[..., :1, None] * jnp.eye(3),) * 2
        moved = (jnp.swapaxes(x[:, 0], 1, 2).reshape(count, n, 1, -1, width) for x in maps)
        return SpreadTangents(parts, neighbours=NeighbourTangents(now.neighbours, now.h * across, *moved))


def _by_number(pairs: Int[np.ndarray, "m 2"], count: int) -> Int[np.ndarray, "n most"]:
    """For each thing those that are in a pair with it; -1 for none."""
    others: list[list[int]] = [[] for _ in range(count)]
    for one, other in pairs.tolist():
        others[one].append(other)
        others[other].append(one)
    found = np.full((count, max(map(len, others))), -1, np.int32)
    for one, row in zip(found, others):
        one[: len(row)] = row
    return found
