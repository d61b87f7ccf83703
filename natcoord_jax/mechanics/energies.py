"""Stored energies of groups of effects, and momenta of bodies."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.state import State
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.momentum import inertia
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground


def group_energies(system: Model, group: Group, state: State) -> Float[Array, " n"]:
    """Stored energy of every instance of a group."""
    rows = rows_with_ground(state.q)[group.bodies]

    def one(effect, place, rows, coordinates, rates):
        return effect.stored(place, rows, coordinates, rates)

    axes = (None if group.source == "mass" else 0, 0, 0, 0, 0)
    with jax.named_scope(group.effect.kind.replace(" ", "_")):
        return jax.vmap(one, in_axes=axes)(
            group.effect,
            group_places(system, group),
            rows,
            state.coordinates[group.coordinates],
            state.rates[group.rotors],
        )


def body_momenta(system: Model, state: State) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Momentum and angular momentum about the origin of every body (24, 32)."""
    q, v = state.rows, state.row_rates
    impulse = inertia(system, v)
    return impulse[:, 0], jnp.sum(cross(q, impulse), axis=1)
