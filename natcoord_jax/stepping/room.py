"""Room for more steps than are made: one program then serves any number of them.

Only where nothing is traced: there the number of steps is known to Python alone, and rows can be cut off
without an operation of JAX, of which every number would compile one.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import Trajectory

ROOM, MOST_ROOM = 64, 16384
"""Steps that the smallest program has room for, and the largest before room grows by as many at a time."""


class Steps(eqx.Module):
    """A number of steps that may be traced, up to a largest one that is not.

    `nc.simulate(..., steps=nc.Steps(n, 256))` makes n steps; its trajectory has 257 states, of which those
    after the n-th repeat it. So one program serves runs of many lengths, in a batch, too.

    Attributes:
        number: of steps.
        most: the largest that there is room for. More are not made, and the code is then MAX_SUBSTEPS.

    Example:
        >>> import jax, jax.numpy as jnp; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.PointMass(mass=1.0, velocity=(1.0, 0.0, 0.0)))
        >>> system, state = scene.compile()
        >>> def run(n):
        ...     return nc.simulate(system, state, dt=0.1, steps=nc.Steps(n, 8)).t[-1]
        >>> jax.vmap(run)(jnp.array([2, 5])).tolist()
        [0.2, 0.5]
    """

    number: Int[Array, ""] | int
    most: int = eqx.field(static=True)

    @property
    def made(self) -> Array:
        """How many are made."""
        return jnp.minimum(jnp.asarray(self.number), self.most)

    def judged(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory, with a code if there was no room for all."""
        short = jnp.asarray(self.number) > self.most
        code = jnp.where(short, int(Result.MAX_SUBSTEPS), trajectory.result)
        return replace_fields(trajectory, result=code)


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
