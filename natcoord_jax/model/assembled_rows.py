"""Rows of bodies in the assembled pose, their velocities and masses."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.model.rows import row_rates


def _stacked(points: Float[Array, "n 3"], rotations: Float[Array, "n 3 3"]) -> Float[Array, "n 4 3"]:
    return jnp.concatenate([points[:, None], rotations.swapaxes(1, 2)], axis=1)


rows_of_poses = eager_numpy(_stacked)


@eager_numpy
def rows_and_velocities(
    points: Array, rotations: Array, velocities: Array, spins: Array
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
    """Of bodies at some places that move."""
    rows = _stacked(points, rotations)
    rates = row_rates(rows, velocities, spins)
    return rows.reshape(-1, 3), rates.reshape(-1, 3)


@eager_numpy
def with_masses(blocks: Array, body: Array, rows: Float[Array, "n 4 4"], own: Float[Array, "n 4 4"]) -> Array:
    """Mass blocks with those of what is clamped to a body, whose rows are weights of its."""
    return blocks.at[body].add(jnp.einsum("nai,nab,nbj->ij", rows, own, rows))


@eager_numpy
def padded(weights: Float[Array, "*m w"], width: int) -> Float[Array, "*m width"]:
    """Weights with zeros behind them."""
    return jnp.concatenate([weights, jnp.zeros((*weights.shape[:-1], width - weights.shape[-1]))], axis=-1)
