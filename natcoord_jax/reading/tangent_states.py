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
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.checks import require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.linsolve.tree import TreeBlocks, factor, handed_up, passed_down
from natcoord_jax.maths.elimination import definite_inverse, definite_solution
from natcoord_jax.maths.vectors import cross, skew
from natcoord_jax.mechanics.equations_of_motion import EquationsOfMotion, loops_of, relations_of, rotors_of
from natcoord_jax.mechanics.momentum import inertia, spatial_inertia, weighs_only, wrench
from natcoord_jax.mechanics.rates import joint_axes, tree_rates
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import row_rates, rows_with_ground, states_of
from natcoord_jax.model.tree import SLOTS
from natcoord_jax.xla.tracing import depends

SHIFT = 1e-12
"""Compliance that is added to constraints, relative, and refined away where they are independent. Where they
are not, or close to singular positions (below a millionth of the others), they are left as they are."""
ROUNDS = 4

LARGEST = 10_000_000
"""Numbers that are at hand at once when many states are read."""


def tangent(system: Model, state: State) -> State:
    """One state with velocities that the constraints admit, the nearest in the metric of the mass."""
    if not system.structure.unknowns:
        return replace_fields(state, v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
    find = _along_the_tree if _by_body(system) else _together
    found = find(system, state, Velocity(state.row_rates, state.rates))
    return replace_fields(state, v=found.rows.reshape(state.v.shape), rates=found.rotors)


def _by_body(system: Model) -> bool:
    """Whether rates are found from body to body: in trees so large that steps are solved so, too.

    In small ones, and where more than the joints of the tree couples velocities, they are all found together.
    """
    coupled = relations_of(system) or loops_of(system) or rotors_of(system)
    return system.structure.solver == "recursive" and not coupled


def _less(v: Velocity, other: Velocity) -> Velocity:
    return Velocity(v.rows - other.rows, v.rotors - other.rotors)


def _along_the_tree(system: Model, state: State, v: Velocity) -> Velocity:
    """By elimination from body to body, at a cost in proportion to their number."""
    tree, rows = system.tree, state.rows
    blocks, present = _spatial(system, rows)
    across, own = blocks.spread[:, :, :6], blocks.spread[:, :, 6:]
    places, parent = jnp.asarray(tree.slot_index)[:, np.array(tree.slots, int)], blocks.parent
    w = jnp.where(present, tree_rates(system, state).at[places].get(mode="fill", fill_value=0.0), 0.0)

    def moving(w: Float[Array, "bodies m"]) -> Float[Array, "bodies 4 3"]:
        twists = passed_down(across, jnp.sum(own * w[:, None], axis=2), parent)[:-1]
        return row_rates(rows, twists[:, :3], twists[:, 3:])

    lost = inertia(system, v.rows - moving(w))
    loads = jnp.concatenate([x[0] for x in wrench(lost[None], rows[None, :, 1:])], axis=1)
    upward = jnp.swapaxes(across, 1, 2)
    loads = loads + handed_up(upward, jnp.sum(upward * loads[:, None], axis=2), parent)
    change = factor(blocks)[0].solve(jnp.sum(own * loads[:, :, None], axis=1))
    return Velocity(moving(w + change), v.rotors)


def _spatial(system: Model, rows: Float[Array, "bodies 4 3"]) -> tuple[TreeBlocks, Bool[Array, "bodies m"]]:
    """Inertia of the free motions by body, from twists of the bodies, and which of the slots a body has."""
    tree, slots = system.tree, np.array(system.tree.slots, int)
    axes, points = joint_axes(system, rows)
    present = jnp.asarray(tree.slot_index)[:, slots] < tree.slot_of.shape[0]
    axis, turning = jnp.where(present[..., None], axes[:, slots], 0.0), (slots < 3) | (slots == SLOTS - 1)
    velocity = jnp.where(turning[:, None], cross(axis, (rows[:, 0] - points)[:, None]), axis)
    own = jnp.concatenate([velocity, jnp.where(turning[:, None], axis, 0.0)], axis=2)
    count, unit = rows.shape[0], jnp.eye(3, dtype=rows.dtype)
    arm = rows[:, 0] - rows_with_ground(rows.reshape(-1, 3))[tree.parent, 0]
    across = jnp.broadcast_to(jnp.eye(6, dtype=rows.dtype), (count, 6, 6)).at[:, :3, 3:].set(-skew(arm))
    # A unit inertia for turns of point masses, which nothing else sees.
    idle = jnp.where(weighs_only(system.mass), 1.0, 0.0)
    masses = spatial_inertia(system.mass, rows[:, 1:], rows[:, 1:])
    masses = masses.at[:, 3:, 3:].add(idle[:, None, None] * unit)
    absent = jnp.where(present, 0.0, 1.0)[:, None] * jnp.eye(slots.size, dtype=rows.dtype)
    rest = jnp.zeros((count, 6 + slots.size, 6 + slots.size), rows.dtype).at[:, 6:, 6:].set(absent)
    spread = jnp.concatenate([across, jnp.swapaxes(own, 1, 2)], axis=2)
    gather = jnp.swapaxes(spread, 1, 2)
    return TreeBlocks(masses, spread, gather, rest, jnp.asarray(tree.parent), slots.size), present


def _together(system: Model, state: State, v: Velocity) -> Velocity:
    """A change of the rates of the tree, so that what is admissible stays as it is to the last digits."""
    balances = EquationsOfMotion.at(system, state)
    gains = balances.columns()
    space, matrix = TangentSpace.without_frame(balances, gains)
    w, rows = tree_rates(system, state), gains.constraints.T
    impulse = space.pulled(space.impulse(_less(v, space.spread(w))))
    if not rows.shape[0]:
        return space.spread(w + definite_solution(matrix, impulse))
    # Where all rows vanish, because the tree lets nothing move that they forbid, they are rounding.
    size = sum(jnp.sum(x**2) for x in balances.unit_loads[1])
    gap = -balances.rates(w).constraints
    return space.spread(w + _constrained(matrix, rows, jnp.trace(matrix) / size, impulse, gap))


def _constrained(
    matrix: Float[Array, "u u"],
    rows: Float[Array, "c u"],
    weight: Float[Array, ""],
    impulse: Float[Array, " u"],
    gap: Float[Array, " c"],
) -> Float[Array, " u"]:
    """Solution x of A x - C^T lambda = impulse, C x = gap, whether or not rows of C depend on each other.

    A is completed by C^T C, times a weight, which changes no solution: bodies may lack inertia along what
    only loops forbid.
    """
    inverse = definite_inverse(matrix + weight * rows.T @ rows)
    spread = inverse @ rows.T
    shifted = definite_inverse(rows @ spread + SHIFT / weight * jnp.eye(rows.shape[0], dtype=rows.dtype))
    x = inverse @ (impulse + weight * rows.T @ gap)
    for _ in range(ROUNDS):
        x = x + spread @ (shifted @ (gap - rows @ x))
    return x


@eager_numpy
def _every(system: Model, states: State) -> State:
    """The same of states along any leading axes, so many at a time that memory suffices."""
    shape, read = states.t.shape, partial(tangent, system)
    if system.mass.ndim > 3:
        return jax.vmap(_every)(system, states)
    if not shape:
        return read(states)
    bodies, unknowns, count = len(system.structure.bodies), system.structure.unknowns, math.prod(shape)
    size = 0 if _by_body(system) else unknowns + system.structure.multipliers + system.structure.rotors
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
