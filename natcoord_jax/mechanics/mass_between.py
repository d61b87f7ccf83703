"""What mass between two bodies adds to the local equations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.local import body_motion, wrenches
from natcoord_jax.mechanics.momentum import stage_changes
from natcoord_jax.model.masses import MassBetween


def pair_balance(
    block: Float[Array, "r r"],
    start: Float[Array, "2 4 3"],
    velocity: Float[Array, "2 4 3"],
    twists: Float[Array, "2 s 6"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "2 s 6"]:
    """Change of the momenta that two bodies have by mass between them, as wrenches."""
    motion, rows = body_motion(start, twists, h, tableau), block.shape[0]
    changes = stage_changes(motion.rates - velocity[None], tableau)[..., :rows, :]
    onto_first = jnp.sum(block[:, :, None] * changes[:, 1, None], axis=-2)
    onto_second = jnp.sum(block[:, :, None] * changes[:, 0, :, None], axis=-3)
    momentum = (
        jnp.zeros_like(motion.rates).at[..., :rows, :].set(jnp.stack([onto_first, onto_second], axis=1))
    )
    return wrenches(momentum, jnp.zeros_like(motion.spin), motion)


def pair_matrices(
    step: Any, mass: MassBetween, twists: Float[Array, "bodies s 6"]
) -> Float[Array, "pairs n n"]:
    """Jacobians of that, see `FullStep.matrices`."""
    bodies, stages = mass.bodies, step.tableau.stages
    width = 2 * stages * mass.rates
    if not mass.turning:
        # Momenta of points are linear in their velocities.
        other, unit, inverse = 1.0 - np.eye(2), np.eye(3), np.array(step.tableau.a_inverse)
        pattern = np.einsum("ab,ij,xy->aixbjy", other, inverse, unit).reshape(width, width)
        return mass.blocks * pattern
    local = jax.vmap(jax.jacfwd(pair_balance, argnums=3), in_axes=(0, 0, 0, 0, None, None))
    given = step.start[bodies], step.velocity[bodies], twists[bodies]
    found = local(mass.blocks, *given, step.h, step.tableau)
    along = step.system.local_rates.blocks(bodies, step.start)
    return along(along(found, 1), 4).reshape(-1, width, width)
