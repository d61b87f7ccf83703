"""Where points and directions are and how they move, and what effects tell of themselves."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.handles import ground
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.state import State
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, over_states, rows_with_ground
from natcoord_jax.reading.instant import instants
from natcoord_jax.reading.tangent_states import Source


class MarkerSensor(eqx.Module):
    """Motion of a material point, or of a direction fixed in a body.

    Attributes:
        position: of the point [m], or the direction itself [-].
        weights: of the rows of the body (7, 46).
        body: number of the body; the number of bodies is the ground. Of a marker between nodes all of them.
        source: what the sensor looks at.
    """

    position: Float[Array, "*t 3"]
    weights: Float[Array, "*b 4"]
    body: int | tuple[int, ...] = eqx.field(static=True)
    source: Source = eqx.field(repr=False)

    @property
    def velocity(self) -> Float[Array, "*t 3"]:
        """Time derivative of the position [m/s, 1/s]."""
        return weighted(self.weights, self.source.read.v, self.body)

    @property
    def acceleration(self) -> Float[Array, "*t 3"]:
        """Second time derivative [m/s^2, 1/s^2]."""
        return weighted(self.weights, instants(self.source).accelerations, self.body)


def weighted(
    weights: Float[Array, "*l 4"], rows: Float[Array, "*t rows 3"], body: int | tuple[int, ...]
) -> Float[Array, "*t 3"]:
    """Marker vector sum_a w_a q_a; zero on the ground, whose rows do not move."""
    if isinstance(body, tuple):
        return sum((weighted(w, rows, b) for w, b in zip(weights, body)), jnp.zeros_like(rows[..., 0, :]))
    nodes = by_node(rows)
    if body >= nodes.shape[-3]:
        return jnp.zeros_like(rows[..., 0, :])
    own = nodes[..., body, :, :]
    missing = own.ndim - 1 - weights.ndim
    weights = weights.reshape(*weights.shape[:-1], *(1,) * missing, 4)
    return jnp.sum(weights[..., None] * own, axis=-2)


def marker_weights(system: Model, marker: Marker, state: State | None) -> tuple[Float[Array, "4"], int]:
    """Weights of a marker and the number of its body; the number of bodies is the ground.

    Raises:
        ValueError: for a marker in world coordinates without the state they refer to.
    """
    vector = jnp.asarray(marker.vector, float)
    head = jnp.ones(1) if marker.is_point else jnp.zeros(1)
    if marker.body == ground:
        return jnp.concatenate([head, vector]), len(system.structure.bodies)
    body = system.body_index(marker.body)
    if not marker.local:
        if state is None:
            raise ValueError(
                f"the marker on {marker.body!r} is in world coordinates of the assembled pose: pass "
                "local=True with the marker if you mean those of the body, else that pose as `state=` (the "
                "initial state)"
            )
        rows = state.rows[body]
        vector = rows[1:] @ (vector - rows[0] if marker.is_point else vector)
    return jnp.concatenate([head, vector]), body


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
