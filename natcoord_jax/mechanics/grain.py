"""How finely the equations of a step are resolved: the size of the terms that cancel in their forces.

A stiff part at rest, or nearly, has no forces by whose size its equations could be said to be solved. But
these are differences of stiffness times places, and rounded as those are: a steel bar of one metre does not
know its length to better than 1e-16 m, or its force to better than 1e-16 of what would stretch it to twice
the length. Motion that is less than that is nothing but rounding.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.vectors import safe_divide
from natcoord_jax.mechanics.momentum import row_weights
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import rows_with_ground

STIFF = 4.0
"""Energy, twice, of the corrections that a force makes over its energy where the step is too long to resolve
the oscillation: its inertia in the equations is h^2/4 times the stiffness then."""

UNRESISTED = 1e200
"""Reciprocal inertia of what turns without any, but for its stiffness."""


def cancelling_size(equations: Any) -> Float[Array, ""]:
    """Size of the terms that cancel in the forces at the start of a step [sqrt(J)], as of a balance."""
    q, h = equations.state.q, equations.h
    rows, total = rows_with_ground(q), jnp.zeros((), q.dtype)
    by_force, by_torque = _mobilities(equations.system)
    for group, where in zip(equations.groups, equations.situations):
        index, axes = group.bodies, (None if group.effect.shared else 0, 0, 0, 0)
        each = jax.vmap(lambda e, *x: e.cancelling(*x), in_axes=axes)
        with jax.named_scope(group.effect.kind.replace(" ", "_")):
            found = each(group.effect, where.place, rows[index], where.coordinates)
        if found is None:
            continue
        energy, reach = found
        along = jnp.sum(safe_divide(by_force[index], reach[:, None] ** 2) + by_torque[index], axis=1)
        total = total + jnp.sum(jnp.minimum((h * energy) ** 2 * along, STIFF * energy))
    return jnp.sqrt(total)


def _mobilities(system: Model) -> tuple[Float[Array, " bodies_and_ground"], ...]:
    """Reciprocal inertia of each body against a force, and against a torque."""
    weights = row_weights(system.mass)[:, :2]
    # What turns without inertia, and is no point, turns as far as its stiffness lets it.
    turns = np.ones(len(system.structure.bodies), bool)
    turns[list(system.structure.points)] = False
    turning = jnp.where((weights[:, 1] == 0) & turns, UNRESISTED, weights[:, 1])
    still = jnp.zeros(1, weights.dtype)
    return jnp.concatenate([weights[:, 0], still]), jnp.concatenate([turning, still])
