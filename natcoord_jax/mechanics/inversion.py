"""Elements that a step turns inside out."""

import jax.numpy as jnp
from jaxtyping import Array, Int

from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground


def first_inverted(system: Model, state: State) -> Int[Array, ""] | None:
    """Number of the first element that is inside out, of all that can be; -1: none is, None: none can be."""
    ratios = []
    for group in system.effects:
        if group.has_volumes:
            rows = rows_with_ground(state.q)[group.bodies]
            ratios.append(group.effect.volume_ratios(group_places(system, group), rows))
    if not ratios:
        return None
    inverted = jnp.concatenate(ratios) <= 0.0
    return jnp.where(jnp.any(inverted), jnp.argmax(inverted), -1)


def code_of(system: Model, state: State, code: Int[Array, ""]) -> Int[Array, ""]:
    """Result code of a state that was found: that of an element which is inside out, if it was successful."""
    inverted = first_inverted(system, state)
    if inverted is None:
        return code
    return jnp.where((code == int(Result.SUCCESSFUL)) & (inverted >= 0), int(Result.INVERTED), code)
