"""What mass between two bodies adds to the local equations."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.local import body_motion, whole, wrenches
from natcoord_jax.mechanics.momentum import stage_changes
from natcoord_jax.model.masses import MassBetween


def pair_balance(
    block: Float[Array, "4 4"],
    start: Float[Array, "2 4 3"],
    velocity: Float[Array, "2 4 3"],
    twists: Float[Array, "2 s r"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "2 s r"]:
    """Change of the momenta that two bodies have by mass between them, as wrenches.

    Of what does not turn, twists and wrenches are velocities and forces.
    """
    motion = body_motion(start, whole(twists), h, tableau)
    changes = stage_changes(motion.rates - velocity[None], tableau)
    onto_first = jnp.sum(block[:, :, None] * changes[:, 1, None], axis=-2)
    onto_second = jnp.sum(block[:, :, None] * changes[:, 0, :, None], axis=-3)
    momentum = jnp.stack([onto_first, onto_second], axis=1)
    return wrenches(momentum, jnp.zeros_like(motion.spin), motion)[..., : twists.shape[-1]]


def pair_matrices(
    step: Any, mass: MassBetween, twists: Float[Array, "bodies s 6"]
) -> Float[Array, "pairs n n"]:
    """Jacobians of that, see `FullStep.matrices`."""
    bodies, rates = mass.bodies, mass.rates
    local = jax.vmap(jax.jacfwd(pair_balance, argnums=3), in_axes=(0, 0, 0, 0, None, None))
    given = step.start[bodies], step.velocity[bodies], twists[bodies][..., :rates]
    found = local(mass.blocks, *given, step.h, step.tableau)
    if mass.turning:
        along = step.system.local_rates.blocks(bodies, step.start)
        found = along(along(found, 1), 4)
    width = 2 * step.tableau.stages * rates
    return found.reshape(-1, width, width)
