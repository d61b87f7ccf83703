"""Many equal effects a piece at a time, so that what is computed on the way stays in the fastest caches."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, StepContext

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

    def at_stages(x: Array) -> Array:
        return cut(x, 1)

    single = now.inputs, now.coordinates, now.rates
    moving = motion.rows, motion.rates, motion.spin
    given = (*jax.tree.map(cut, (effect, place, motion.start, single)), jax.tree.map(at_stages, moving))

    def one(_: None, piece: tuple) -> tuple[None, Any]:
        effect, place, start, (inputs, coordinates, rates), moving = piece
        alone = replace_fields(now, inputs=inputs, coordinates=coordinates, rates=rates)
        return None, function(effect, place, Motion(start, *moving), alone)

    found = jax.lax.scan(one, None, given)[1]
    return jax.tree.map(lambda x: x.reshape(pieces * size, *x.shape[2:])[:count], found)
