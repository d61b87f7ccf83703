"""Many instances at once, their axis the last in all arrays, so that what is computed is wide."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
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
    potential: Any, x: Float[Array, "s k *m 3 n"], moved: Float[Array, "s k *m 3 n"]
) -> Float[Array, "s p n"]:
    """Changes of the invariants at the stages, of many instances, for changes of the marker vectors."""
    return jax.vmap(lambda xi, vi: jax.jvp(potential.invariants, (xi,), (vi,))[1])(x, moved)
