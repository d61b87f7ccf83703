"""Many instances at once, their axis the last in all arrays, so that what is computed is wide; in pieces."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.xla.materialise import materialised


def instances_last(x: Any, axis: int = 0) -> Any:
    """Arrays of a pytree with the axis of the instances moved to the end."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis, -1), x)


def place_together(place: Float[Array, "k *m w n"], rows: Float[Array, "*s b 4 3 n"]) -> Float[Array, "*out"]:
    """Marker vectors of many instances, see `place_markers`."""
    several = rows.shape[-4] // place.shape[0]
    if several > 1:
        rows = rows.reshape(*rows.shape[:-4], place.shape[0], NODE[0] * several, *rows.shape[-2:])
    if place.ndim == 4:
        rows = rows[..., None, :, :, :]
    return materialised(jnp.sum(place[..., None, :] * rows, axis=-3))


def steps_together(
    potential: Any, x: Float[Array, "s k *rest"], moved: Float[Array, "s k *rest"]
) -> Float[Array, "s p *n"]:
    """Changes of the invariants at the stages for changes of the marker vectors, of many instances too."""
    return jax.vmap(lambda xi, vi: jax.jvp(potential.invariants, (xi,), (vi,))[1])(x, moved)


PIECE = 64
"""Largest number of instances in a piece."""


def chunked(
    function: Callable[[Any, Array, Motion, StepContext], Any],
    effect: Any,
    place: Array,
    motion: Motion,
    now: StepContext,
) -> Any:
    """What a function gives for all instances of an effect; leading axis n, of the stacked numbers, too.

    Args:
        function: of the effect, its place, motion and time.
        effect: with stacked numbers.
        place: of the instances.
        motion: of their bodies.
        now: leading axis n in inputs, coordinates and rates.
    """
    count = place.shape[0]
    pieces = -(-count // PIECE)
    if pieces <= 1:
        return function(effect, place, motion, now)
    size = -(-count // pieces)

    def cut(x: Array, axis: int = 0) -> Array:
        last = jax.lax.slice_in_dim(x, count - 1, count, axis=axis)
        rest = pieces * size - count
        whole = jnp.concatenate([x, *[last] * rest], axis=axis) if rest else x
        split = whole.reshape(*x.shape[:axis], pieces, size, *x.shape[axis + 1 :])
        return jnp.moveaxis(split, axis, 0)

    single = now.inputs, now.coordinates, now.rates
    moving = motion.rows, motion.rates, motion.spin
    given = (
        *jax.tree.map(cut, (effect, place, motion.start, single)),
        jax.tree.map(partial(cut, axis=1), moving),
    )

    def one(_: None, piece: tuple) -> tuple[None, Any]:
        effect, place, start, (inputs, coordinates, rates), moving = piece
        alone = replace_fields(now, inputs=inputs, coordinates=coordinates, rates=rates)
        return None, function(effect, place, Motion(start, *moving), alone)

    found = jax.lax.scan(one, None, given)[1]
    return jax.tree.map(lambda x: x.reshape(pieces * size, *x.shape[2:])[:count], found)
