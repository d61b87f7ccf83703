"""Mass that effects bring to the bodies that they are on, as elements of shells and solids do."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect
from natcoord_jax.model.groups import Group


def with_masses(
    masses: Float[Array, "bodies 4 4"], group: Group, before: Effect | None = None
) -> Float[Array, "bodies 4 4"]:
    """With what effects bring to their bodies; what sits on the ground is lost.

    Args:
        masses: m (15) of all bodies.
        group: of the effects.
        before: what they were when what they brought was added; None: nothing has been.
    """
    if group.weights is None or type(group.effect).lumped_mass is Effect.lumped_mass:
        return masses
    return _with_masses(masses, group.bodies, group.effect, before, group.weights)


@eager_numpy
def _with_masses(
    masses: Float[Array, "bodies 4 4"],
    bodies: Int[Array | np.ndarray, "n k"],
    effect: Effect,
    before: Effect | None,
    weights: Float[Array, "n k *m 4"],
) -> Float[Array, "bodies 4 4"]:
    def brought(effect: Effect) -> Array:
        lumps: Any = jax.vmap(lambda e: e.lumped_mass())(effect)
        # Between vectors of a node there is mass where its point is not in the middle.
        if lumps.ndim == 4:
            return lumps
        return lumps.reshape(*bodies.shape, -1, 1) * jnp.eye(max(1, lumps.size // bodies.size))

    lumps = brought(effect) if before is None else brought(effect) - brought(before)
    # What has mass comes first: of an attachment the point, or it and the first axis.
    rows = weights.reshape(*bodies.shape, -1, 4)[:, :, : lumps.shape[2]]
    blocks = jnp.einsum("nkml,nkma,nklb->nkab", lumps, rows, rows)
    return masses.at[bodies].add(blocks, mode="drop")
