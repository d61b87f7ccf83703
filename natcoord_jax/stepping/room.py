"""Room for more steps than are made: one program then serves any number of them.

Only where nothing is traced: there the number of steps is known to Python alone, and rows can be cut off
without an operation of JAX, of which every number would compile one.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import Trajectory

ROOM, MOST_ROOM = 64, 16384
"""Steps that the smallest program has room for, and the largest before room grows by as many at a time."""


def in_host_memory() -> bool:
    """Whether arrays are where Python can cut them: not on a GPU, nor on one of several devices."""
    return jax.default_backend() == "cpu" and jax.local_device_count() == 1


def room_for(steps: int) -> int:
    """Steps that a program has room for, so that it serves other numbers of them, too."""
    room = ROOM
    while room < min(steps, MOST_ROOM):
        room *= 4
    return room if steps <= room else -(-steps // MOST_ROOM) * MOST_ROOM


def with_room(inputs: Any, steps: int, room: int) -> Any:
    """Inputs with rows of zeros for the steps that are not made."""
    if callable(inputs):
        return inputs
    rows = np.zeros((room, *inputs.shape[1:]))
    rows[:steps] = inputs
    return as_array(rows)


def cut(trajectory: Trajectory, steps: int) -> Trajectory:
    """The steps that were made; an operation of JAX would compile a program for every number of them."""

    def first(x: Array, count: int) -> Array:
        return as_array(np.asarray(x)[:count])

    states = jax.tree.map(lambda x: first(x, steps + 1), trajectory.states)
    return replace_fields(trajectory, states=states, inputs=first(trajectory.inputs, steps))
