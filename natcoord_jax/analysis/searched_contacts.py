"""Contacts that look for their pairs: which of these come near along a trajectory, and their gaps."""

from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import ground
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.effects.contact.capsules import CapsuleContacts
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, over_states, rows_with_ground

BLOCK = 1024
"""Pairs that are measured at once: what these take stays in the cache, and is six times as fast as all."""


class NearPairs(NamedTuple):
    """Pairs of a contact that come within its skin.

    Attributes:
        name: of the contact.
        law: the contact.
        pairs: numbers of its capsules.
        names: of the pairs, as where they are listed.
        gap: of their surfaces at the saved times, negative where they overlap [m].
    """

    name: str
    law: CapsuleContacts
    pairs: Int[np.ndarray, "2 p"]
    names: tuple[str, ...]
    gap: Float[np.ndarray, "*lanes saved p"]


def searching(system: Model) -> list[Group]:
    """Groups of contacts that look for their pairs."""
    return [group for group in system.effects if isinstance(group.effect, CapsuleContacts)]


@over_states
def capsules(system: Model, state: State) -> list[Array]:
    """Where those of these contacts are: of each group (n, v, 3, capsules), see `CapsuleContacts`."""
    rows = rows_with_ground(state.q)
    each = jax.vmap(lambda effect, place, rows: effect.ends(place, rows))
    return [each(g.effect, group_places(system, g), rows[g.bodies]) for g in searching(system)]


def near_pairs(system: Model, trajectory: Trajectory) -> list[NearPairs]:
    """Of each contact that looks for its pairs those that come within its skin at any of the saved times.

    All pairs are measured state by state, and the least gap is kept: what takes memory is gaps of what is
    near.

    Args:
        system: compiled system.
        trajectory: of it, with any leading axes.
    """
    found = []
    for group, every in zip(searching(system), capsules(system, trajectory)):
        for k in range(group.count):
            law: Any = jax.tree.map(lambda x, k=k: x[k], group.effect)
            ends = every[..., k, :, :, :]
            flat = ends.reshape(-1, *ends.shape[-3:])
            pairs = _nearest(law, flat)
            gap = np.asarray(_gaps(law, flat, pairs)).reshape(*ends.shape[:-3], pairs.shape[1])
            found.append(NearPairs(group.names[k], law, pairs, _names(system, group, k, pairs), gap))
    return found


def _may_touch(law: CapsuleContacts) -> Int[np.ndarray, "2 p"]:
    """All pairs but those that are exempt, and points, which do not overlap."""
    radii, exempt = np.asarray(law.radii), np.asarray(law.exempt)
    one, other = np.triu_indices(len(radii), 1)
    apart = (exempt[one] == other[:, None]).any(axis=1) | (radii[one] + radii[other] == 0)
    return np.stack([one, other])[:, ~apart]


def _nearest(law: CapsuleContacts, ends: Float[Array, "s v 3 n"]) -> Int[np.ndarray, "2 p"]:
    """Pairs that come within the skin in any state; after a failure states may be no numbers."""
    ends = ends[np.isfinite(np.asarray(ends)).all(axis=(1, 2, 3))]
    pairs = _may_touch(law)
    filled = np.pad(pairs, ((0, 0), (0, -pairs.shape[1] % BLOCK)))
    blocks = np.moveaxis(filled.reshape(2, -1, BLOCK), 0, 1)
    least = np.asarray(_least(law, ends, blocks)).reshape(-1)[: pairs.shape[1]]
    return pairs[:, least < float(law.skin)]


@eager_numpy
def _least(law: CapsuleContacts, ends: Any, blocks: Any) -> Float[Array, "b p"]:
    """Least gap of pairs in all states."""

    def least(pairs: Array) -> Array:
        def nearer(found: Array, at: Array) -> tuple[Array, None]:
            return jnp.minimum(found, law.gaps(at, pairs)), None

        return jax.lax.scan(nearer, jnp.full(BLOCK, jnp.inf), ends)[0]

    return jax.lax.map(least, blocks)


@eager_numpy
def _gaps(law: CapsuleContacts, ends: Any, pairs: Any) -> Float[Array, "s p"]:
    return jax.lax.map(lambda at: law.gaps(at, pairs), ends)


@eager_numpy
def touch(law: CapsuleContacts, ends: Any, pairs: Any) -> Any:
    """Where pairs touch, and how the second ones are pushed, in all states."""
    return jax.vmap(lambda at: law.touch(at, pairs))(ends)


@eager_numpy
def mean_force(law: CapsuleContacts, before: Any, after: Any) -> Array:
    """What pushes pairs apart on average, from one gap to another [N]."""
    return law.mean_force(before, after)


def _names(system: Model, group: Group, number: int, pairs: Int[np.ndarray, "2 p"]) -> tuple[str, ...]:
    """Of pairs by their bodies; of bodies with several capsules by the numbers of these, too."""
    assert group.weights is not None
    # An interpolated marker is of several bodies, of which the first one names it.
    bodies = np.asarray(group.bodies[number]).reshape(group.weights.shape[1], -1)[:, 0]
    effect: Any = group.effect
    names, own = system.structure.bodies, bodies[: effect.radii.shape[-1]]
    named = [names[body] if body < len(names) else ground.name for body in own]
    several = Counter(named)
    told = [name if several[name] == 1 else f"{name} ({k})" for k, name in enumerate(named)]
    return tuple(f"{group.names[number]}[{told[a]}, {told[b]}]" for a, b in pairs.T)
