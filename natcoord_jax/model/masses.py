"""Mass that effects bring to the nodes that they are on, and between them, as elements do."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST
from natcoord_jax.model.segment_sum import SegmentSum

BETWEEN = 4
"""Axes of a mass matrix that couples nodes."""


class MassBetween(eqx.Module):
    """Blocks of the mass matrix off its diagonal.

    Attributes:
        bodies: two different ones, of each block once.
        blocks: between the vectors that the nodes carry, their points first: of the first body along the
            rows, of the second along the columns.
        uniform: sums of the blocks in the rows of each body, momenta of a motion that is the same everywhere;
            with what sits on the ground, which has no part in motions, but has a weight.
        places: where the blocks of each group of effects go (n, k, k), beyond the last one those that are
            none or that another is the transpose of; None: it has none.
        acting: how bodies collect what the blocks give them, the first of all blocks before the second.
    """

    bodies: Int[np.ndarray, "pairs 2"] = eqx.field(**INDICES)
    blocks: Float[Array, "pairs r r"]
    uniform: Float[Array, "bodies 4 4"]
    places: tuple[Int[np.ndarray, "n k k"] | None, ...] = eqx.field(**INDICES)
    acting: SegmentSum

    @property
    def rows(self) -> int:
        """Vectors of a body that have mass together with those of another."""
        return self.blocks.shape[-1]

    @property
    def turning(self) -> bool:
        """Whether bodies turn; points do not."""
        return self.rows > 1

    @property
    def rates(self) -> int:
        """Components of the twists of two bodies that blocks have to do with: of points there is no spin."""
        return TWIST if self.turning else TWIST // 2

    def momenta(self, rates: Float[Array, "*s bodies 4 3"]) -> Float[Array, "*s bodies 4 3"]:
        """What they add to the momenta of the bodies."""
        first, second = (rates[..., bodies, : self.rows, :] for bodies in self.bodies.T)
        onto_first = jnp.sum(self.blocks[:, :, :, None] * second[..., None, :, :], axis=-2)
        onto_second = jnp.sum(self.blocks[:, :, :, None] * first[..., :, None, :], axis=-3)
        parts = jnp.moveaxis(jnp.concatenate([onto_first, onto_second], axis=-3), -3, 0)
        found = jnp.moveaxis(self.acting.collect(parts), 0, -3)
        return jnp.zeros_like(rates).at[..., : self.rows, :].set(found)

    def times(self, factor: Array | float) -> "MassBetween":
        """So many times as much."""
        return replace_fields(self, blocks=factor * self.blocks, uniform=factor * self.uniform)


def _axes(group: Group) -> int:
    """Axes of what effects bring, see `Effect.mass_matrix`; 0: nothing."""
    if group.weights is None or type(group.effect).mass_matrix is Effect.mass_matrix:
        return 0
    found = jax.eval_shape(jax.vmap(lambda e: e.mass_matrix()), group.effect)
    return 0 if found is None else found.ndim - 1


def mass_of(
    masses: Float[Array, "bodies 4 4"], groups: Sequence[Group], rows: np.ndarray
) -> tuple[Float[Array, "bodies 4 4"], MassBetween | None]:
    """Masses with all that effects bring; what sits on the ground is lost.

    Args:
        masses: m (15) of the bodies without them.
        groups: of all effects.
        rows: vectors that the node of each body carries.
    """
    between = _between(groups, rows)
    for number in range(len(groups)):
        masses, between = with_mass(masses, between, groups, number)
    return masses, between


def with_mass(
    masses: Float[Array, "bodies 4 4"],
    between: MassBetween | None,
    groups: Sequence[Group],
    number: int,
    before: Effect | None = None,
) -> tuple[Float[Array, "bodies 4 4"], MassBetween | None]:
    """With what the effects of a group bring.

    Args:
        masses: m (15) of all bodies.
        between: mass between them.
        groups: of all effects.
        number: of the group.
        before: what they were when what they brought was added; None: nothing has been.
    """
    group = groups[number]
    if not _axes(group):
        return masses, between
    places = None if between is None else between.places[number]
    old = None if before is None else replace_fields(group, effect=before)
    alone, blocks, uniform = _added(masses, between, places, group, old)
    if between is not None:
        between = replace_fields(between, blocks=blocks, uniform=uniform)
    return alone, between


def _between(groups: Sequence[Group], rows: np.ndarray) -> MassBetween | None:
    """The pairs of bodies between which there is mass, none yet."""
    count = len(rows)
    # Pairs of different bodies, the smaller number first, by one number; -1: another one is its transpose.
    numbers: list[np.ndarray | None] = [None] * len(groups)
    for k, group in enumerate(groups):
        if _axes(group) == BETWEEN:
            table = np.asarray(group.bodies, np.int64)
            one, other = table[:, :, None], table[:, None]
            numbers[k] = np.where((one < other) & (other < count), one * count + other, -1)
    given = [n[n >= 0] for n in numbers if n is not None]
    if not given:
        return None
    unique = np.unique(np.concatenate(given))
    places = tuple(
        None if n is None else np.where(n >= 0, np.searchsorted(unique, n), len(unique)).astype(np.int32)
        for n in numbers
    )
    bodies = np.stack(np.divmod(unique, count), axis=1).astype(np.int32)
    most = int(rows[bodies].max(initial=1))
    none, still = as_array(np.zeros((len(bodies), most, most))), as_array(np.zeros((count, 4, 4)))
    return MassBetween(bodies, none, still, places, SegmentSum.of(bodies.T, count))


@eager_numpy
def _added(
    masses: Float[Array, "bodies 4 4"],
    between: MassBetween | None,
    places: Int[Array | np.ndarray, "n k k"] | None,
    group: Group,
    before: Group | None,
) -> tuple[Float[Array, "bodies 4 4"], Any, Any]:
    """Masses of bodies, between them, and sums of these, with what a group brings."""
    bodies, weights = group.bodies, group.weights
    assert weights is not None
    rows = weights.reshape(*bodies.shape, -1, 4)
    found: Any = jax.vmap(lambda e: e.mass_matrix())(group.effect)
    if before is not None:
        found = found - jax.vmap(lambda e: e.mass_matrix())(before.effect)
    blocks: Any = None if between is None else between.blocks
    uniform: Any = None if between is None else between.uniform
    # What has mass comes first: of an attachment the point, or it and the first axis.
    if places is None:
        # Between vectors of a node there is mass where its point is not in the middle.
        if found.ndim < 4:
            found = found.reshape(*bodies.shape, -1, 1) * jnp.eye(max(1, found.size // bodies.size))
        rows = rows[:, :, : found.shape[2]]
        own = jnp.einsum("nkml,nkma,nklb->nkab", found, rows, rows)
        return masses.at[bodies].add(own, mode="drop"), blocks, uniform
    rows, ground = rows[:, :, : found.shape[2]], masses.shape[0]
    every = jnp.einsum("nkilj,nkia,nljb->nklab", found, rows, rows)
    one, other = bodies[:, :, None], bodies[:, None]
    alone, apart = (jnp.where(own, one, ground) for own in (one == other, one != other))
    masses, uniform = (x.at[at].add(every, mode="drop") for x, at in ((masses, alone), (uniform, apart)))
    carried = blocks.shape[-1]
    return masses, blocks.at[places].add(every[..., :carried, :carried], mode="drop"), uniform
