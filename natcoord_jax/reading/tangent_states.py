"""Velocities as they are read: the nearest to those of a state that the constraints admit.

The energy-momentum step (57) keeps constraints in position only. With the mean velocity V of a step, which is
tangent at its mid-point, it is v_1 = 2 V - v_0: what of v_0 is normal to the constraints is reversed in every
step, with an amplitude of the order of h^2 at first, and more where a controller answers to it. States keep
it, because the balances of energy and momentum hold with it to round-off. Readings leave it out,

    minimise |v - v_read|_M,    G v_read + c_t = 0.

Orthogonality in the mass matters. In M (v_1 - v_0) = h F the normal parts at both ends of a step act on the
motion along the constraints by what the constraints turn over half a step, with opposite signs, which cancel.
Relative rates of joints that are taken from v as it is have a part of the alternation instead.
"""

import math
from collections.abc import Callable
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.checks import require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.mechanics.admissible_velocities import by_body, tangent
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import states_of
from natcoord_jax.xla.tracing import depends

LARGEST = 10_000_000
"""Numbers that are at hand at once when many states are read."""


@eager_numpy
def _every(system: Model, states: State) -> State:
    """The same of states along any leading axes, so many at a time that memory suffices."""
    shape, read = states.t.shape, partial(tangent, system)
    if system.mass.ndim > 3:
        return jax.vmap(_every)(system, states)
    if not shape:
        return read(states)
    bodies, unknowns, count = len(system.structure.bodies), system.structure.unknowns, math.prod(shape)
    size = 0 if by_body(system) else unknowns + system.structure.multipliers + system.structure.rotors
    together = max(1, LARGEST // (4 * size**2 + 24 * bodies * (size + 12)))
    flat = jax.tree.map(lambda x: x.reshape(count, *x.shape[len(shape) :]), states)
    if count <= together:
        found = jax.vmap(read)(flat)
    else:
        found = _in_batches(read, flat, together)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), found)


def _in_batches(read: Callable[[State], State], states: State, size: int) -> State:
    """So many states at a time; `jax.lax.map` takes no arrays without numbers."""
    leaves, structure = jax.tree.flatten(states)
    full = [k for k, x in enumerate(leaves) if x.size]

    def some(given: list[Array]) -> list[Array]:
        every = [jnp.zeros(x.shape[1:], x.dtype) for x in leaves]
        for k, x in zip(full, given):
            every[k] = x
        found = jax.tree.leaves(read(jax.tree.unflatten(structure, every)))
        return [found[k] for k in full]

    for k, x in zip(full, jax.lax.map(some, [leaves[k] for k in full], batch_size=size)):
        leaves[k] = x
    return jax.tree.unflatten(structure, leaves)


_handed: ContextVar[Any] = ContextVar("handed", default=None)
"""Velocities of the state that a controller was handed: made tangent already, if they are to be."""


class Source(eqx.Module):
    """What is read: states of a system.

    Attributes:
        system: compiled system; with leading axes, too, if the whole went through `jax.vmap`.
        states: along any leading axes.
        as_they_are: whether velocities are read as the states have them: the scheme keeps them tangent, or
            they are asked for as it leaves them.
        inputs: at each of the states.
    """

    system: Model
    states: State
    as_they_are: bool = eqx.field(static=True)
    inputs: Float[Array, "*t inputs"] | None = None

    @classmethod
    def of(cls, system: Model, motion: State | Trajectory, inputs: Array | None = None) -> "Source":
        """That of a state or of a trajectory."""
        states = states_of(motion)
        if isinstance(motion, Trajectory):
            as_they_are = motion.scheme is not None and not motion.scheme.loose
        else:
            as_they_are = motion.v is _handed.get()
        return cls(system, states, as_they_are, inputs)

    @property
    def read(self) -> State:
        """The states with the velocities that are read of them."""
        return self.states if self.as_they_are else _every(self.system, self.states)

    def each(self, function: Callable, *along: Any) -> Any:
        """A function of system and state, and of more along the same axes, for all states as read."""
        require_double("sensor")
        axes, lanes = self.states.t.ndim, self.system.mass.ndim - 3
        for axis in range(axes):
            own = 0 if axis >= axes - lanes else None
            function = jax.vmap(function, in_axes=(own, 0, *(0 for _ in along)))
        return function(self.system, self.read, *along)


R = TypeVar("R")


def over_source(function: Callable[[Model, State], R]) -> Callable[[Source], R]:
    """A function of a system and one state, as one of all states of a source as they are read."""
    return eager_numpy(lambda source: source.each(function))


def tangent_states(system: Model, motion: State | Trajectory) -> State:
    """The states of a motion with velocities that obey the constraints; see `System.tangent`."""
    return Source.of(system, motion).read


def handing(function: Any) -> Any:
    """The function of a state, its last argument, that reads velocities as this state has them.

    What is no function stays as it is. A module with numbers of its own does, too: it reads velocities that
    are tangent already, and makes them so once more.
    """
    if isinstance(function, eqx.Module) or not callable(function):
        return function

    @wraps(function)
    def call(*arguments: Any) -> Any:
        before = _handed.set(arguments[-1].v)
        try:
            return function(*arguments)
        finally:
            _handed.reset(before)

    return call


def reads_velocities(function: Callable[[State], Any], state: State) -> bool:
    """Whether what a function of a state gives depends on velocities; to find them takes time."""

    def of_velocities(v: Array, rates: Array) -> Any:
        return function(replace_fields(state, v=v, rates=rates))

    return depends(of_velocities, state.v, state.rates)
