"""What effects tell of themselves."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.state import State
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, over_states, rows_with_ground


def tells(group: Group, name: str) -> bool:
    """Whether a name is that of an effect of a group, or of the set of them."""
    return name in group.names or name in group.labels


def readings(system: Model, states: State, names: tuple[str, ...]) -> Any:
    """What effects of one kind, or all of a set, tell of themselves, along an axis before that of quantities.

    Raises:
        ValueError: for effects of several kinds, or of one that tells nothing.
    """
    number, group = next((k, g) for k, g in enumerate(system.effects) if tells(g, names[0]))
    missing = [name for name in names if not tells(group, name)]
    if missing:
        raise ValueError(f"{missing[0]!r} is of another kind than {names[0]!r}: sense them one by one")
    if group.effect.silent:
        raise ValueError(
            f"the {group.effect.kind} {names[0]!r} has no sensor; use those of the bodies that it acts on, "
            "of a contact that looks for its pairs `nc.contacts(system, trajectory)`, "
            "of a constraint `system.instant(...).multipliers`; a class of your own has one if you give it "
            "`silent = False` and `readings`"
        )
    if group.is_set and names[0] in group.labels:
        chosen = jnp.arange(group.count)
    else:
        chosen = jnp.array([group.names.index(name) for name in names])
    return _all_readings(system, states, number, chosen)


@compiled
def _all_readings(system: Model, states: State, number: int, chosen: Array) -> Any:
    group = system.effects[number]
    places = group_places(system, group)[chosen]
    effects = jax.tree.map(lambda x: x[chosen], group.effect)

    def one(system: Model, state: State) -> Any:
        rows = rows_with_ground(state.q)[group.bodies[chosen]]
        return jax.vmap(lambda effect, place, rows: effect.readings(place, rows))(effects, places, rows)

    return over_states(one)(system, states)
