"""Rows of all nodes, the ground's last, and how effects sit on them."""

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.maths.vectors import cross
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model

R = TypeVar("R")


def states_of(motion: State | Trajectory) -> State:
    """The states of a trajectory, or the state itself."""
    return motion.states if isinstance(motion, Trajectory) else motion


def over_states(
    function: Callable[[Model, State], R],
) -> Callable[[Model, State | Trajectory], R]:
    """A function of a system and one state, as one of a system and a motion: along all leading axes."""

    def every(system: Model, states: State) -> R:
        mapped = function
        for _ in range(states.q.ndim - 2):
            mapped = jax.vmap(mapped, in_axes=(None, 0))
        return mapped(system, states)

    evaluate = eager_numpy(every)

    @wraps(function)
    def along(system: Model, motion: State | Trajectory) -> R:
        return evaluate(system, states_of(motion))

    return along


def rows_with_ground(rows: Float[Array, "bodies4 3"]) -> Float[Array, "bodies_and_ground 4 3"]:
    """Rows by body, with those of the ground last."""
    ground = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)]).astype(rows.dtype)
    return jnp.concatenate([by_node(rows), ground[None]])


def group_places(system: Model, group: Group) -> Array:
    """How the instances of a group sit on their bodies: weights, joint frames or mass blocks."""
    if group.source == "mass":
        between = system.mass_between
        return system.mass if between is None else system.mass + between.uniform
    if group.source == "markers":
        assert group.weights is not None
        return group.weights
    frames = system.frames[group.joints]
    return frames[:, 0] if group.source == "joint" else frames


def row_rates(rows: Float[Array, "bodies 4 3"], velocity: Array, spin: Array) -> Float[Array, "bodies 4 3"]:
    """Velocities of the rows of bodies with given velocities and angular velocities."""
    return jnp.concatenate([velocity[:, None], cross(spin[:, None], rows[:, 1:])], axis=1)
