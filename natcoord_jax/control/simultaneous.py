"""The discrete problem with the states between the steps as unknowns, too: sparse, banded over the steps.

Where `transcription.roll` follows states from step to step, here each step sees the node before it and the
state after it as they are, and that the one leads to the other is a constraint: direct multiple shooting over
single steps (H. G. Bock, K. J. Plitt, IFAC Proc. 17 (1984) 1603-1608), or the simultaneous approach
(L. T. Biegler, Chem. Eng. Process. 46 (2007) 1043-1053). Values and multipliers of all other conditions are
those of the form without states wherever the motion is one.
"""

from operator import itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.collocation import unknowns_each
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.phases import most_counted
from natcoord_jax.control.pieces import Places, Sum, sum_of
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import (
    Node,
    Path,
    Slice,
    Unknowns,
    end,
    enters_in,
    first_node,
    slices,
    stage,
)


class Sizes(NamedTuple):
    """How many numbers there are of each kind.

    Attributes:
        free: besides the inputs.
        leading: coefficients before those that enter.
        carried: what one step hands to the next besides what is free.
        state: of these those of the state.
        w: coefficients that enter in a step.
        y: unknowns of a step's equations.
    """

    free: int
    leading: int
    carried: int
    state: int
    w: int
    y: int

    @property
    def seen(self) -> int:
        """How many numbers one step sees."""
        return self.free + 2 * self.carried + self.w + self.y


def sizes_of(problem: OptimalControl) -> Sizes:
    """The numbers of a problem."""
    state, degree = problem.state, problem.inputs.degree
    register = degree + (problem.inputs.every > 1)
    x = 2 * state.q.size + most_counted(problem.systems) + state.rates.size
    carried = x + problem.looked_back + sum(problem.memory_sizes) + register * problem.channels
    leading, own = degree * problem.channels, unknowns_each(problem)
    return Sizes(len(problem.free), leading, carried, x, problem.channels, own)


def _flat(node: Node) -> Array:
    """A node as a vector, without what is free."""
    return ravel_pytree((node.x, node.last, node.memory, node.register))[0]


def _node(problem: OptimalControl, free: Array, flat: Array) -> Node:
    """A node from such a vector."""
    n, back, memory = sizes_of(problem), problem.looked_back, sum(problem.memory_sizes)
    x, last, kept, register = jnp.split(flat, np.cumsum([n.state, back, memory]))
    return Node(x, free, last, kept, register.reshape(-1, problem.channels))


def _first(problem: OptimalControl, given: None, z: Array) -> tuple[Array, Array]:
    """The node at the start, from what is free and the leading coefficients."""
    n = sizes_of(problem)
    free, leading, node = jnp.split(z, np.cumsum([n.free, n.leading]))
    start = first_node(problem, free, leading.reshape(-1, problem.channels))
    return jnp.zeros(()), node - _flat(start)


def _step(problem: OptimalControl, at: Slice, z: Array) -> tuple[Array, Array]:
    """A step from the node before it to that after it."""
    n = sizes_of(problem)
    free, before, w, y, after = jnp.split(z, np.cumsum([n.free, n.carried, n.w, n.y]))
    found = stage(problem, at, _node(problem, free, before), w, y, reached=after[: n.state])
    return found.cost, jnp.concatenate([found.residual, after - _flat(found.after), found.excess])


def _end(problem: OptimalControl, given: None, z: Array) -> tuple[Array, Array]:
    """The end of the motion."""
    free, last = jnp.split(z, [len(problem.free)])
    found = end(problem, _node(problem, free, last))
    return found.cost, jnp.concatenate([found.missing, found.excess])


class Simultaneous(eqx.Module):
    """The program, and where everything is.

    Unknowns x are what is free, leading coefficients, the first node, and then for each step what enters in
    it, the unknowns of its equations and the node after it. Constraints are those of the first node, then
    for each step its equations, those of the node after it and the bounds, then the goal and the bounds at
    the end.

    Attributes:
        pieces: cost and constraints, as a sum.
        weights: of the constraints.
        motion: places of the steps' own equations among the constraints (steps, n).
        continuity: of the conditions that each step leads to the next (steps, carried).
        path: of the bounds (steps, h).
        goal: of the goal.
        last: of the bounds at the end.
        free: places of what is free among the unknowns.
        coefficients: of the coefficients (coefficients, m).
        y: of the unknowns of the steps (steps, n).
        nodes: of what the steps hand on (steps + 1, carried).
    """

    pieces: Sum
    weights: Float[Array, " c"]
    motion: np.ndarray
    continuity: np.ndarray
    path: np.ndarray
    goal: np.ndarray
    last: np.ndarray
    free: np.ndarray
    coefficients: np.ndarray
    y: np.ndarray
    nodes: np.ndarray

    def unknowns(self, x: Any) -> Unknowns:
        """What `nc.optimise` solves for."""
        return Unknowns(*(jnp.asarray(x, float)[at] for at in (self.coefficients, self.free, self.y)))

    def start(self, unknowns: Unknowns, path: Path) -> np.ndarray:
        """The vector of a motion."""
        found = np.zeros(self.pieces.size)
        nodes = jax.vmap(_flat)(path.nodes)
        given = (unknowns.coefficients, unknowns.free, unknowns.y, nodes)
        for at, value in zip((self.coefficients, self.free, self.y, self.nodes), given):
            found[at] = np.asarray(value)
        return found

    def multipliers(self, values: Any) -> Multipliers:
        """Those of `nc.optimise` from those of the constraints."""
        found = self.weights * jnp.asarray(values, float)
        return Multipliers(*(found[at] for at in (self.goal, self.path, self.last, self.motion)))

    @property
    def bounds(self) -> np.ndarray:
        """Which constraints are inequalities."""
        found = np.zeros(self.weights.size, bool)
        found[self.path], found[self.last] = True, True
        return found

    def names(self, problem: OptimalControl) -> tuple[str, ...]:
        """Of the constraints."""
        found = np.full(self.weights.size, "", object)
        for step, at in enumerate(self.motion):
            found[at] = [f"equation {k} of step {step}" for k in range(len(at))]
        carried = _labels(problem)
        for step, at in enumerate(self.continuity):
            found[at] = [f"continuity of {name}, step {step}" for name in carried]
        found[: len(carried)] = [f"initial {name}" for name in carried]
        for step, at in enumerate(self.path):
            found[at] = [f"{name}, step {step}" for name in problem.path_labels]
        found[self.goal], found[self.last] = problem.goal_labels, problem.end_labels
        return tuple(found)


def _labels(problem: OptimalControl) -> list[str]:
    """Names of what nodes hold."""
    n, state, back = sizes_of(problem), problem.state, problem.looked_back
    kept = sum(problem.memory_sizes)
    counts = {
        "position": state.q.size,
        "velocity": state.v.size,
        "joint coordinate": state.coordinates.size,
        "rotor rate": state.rates.size,
        "input before": back,
        "memory": kept,
        "register of inputs": n.carried - n.state - back - kept,
    }
    return [f"{name} {k}" for name, count in counts.items() for k in range(count)]


def simultaneous(problem: OptimalControl, unknowns: Unknowns, path: Path) -> Simultaneous:
    """The program of a problem with all its numbers as arrays.

    Args:
        problem: the problem.
        unknowns: a guess, for typical sizes.
        path: its motion.
    """
    n, steps, h = sizes_of(problem), problem.steps, path.stages.excess.shape[1]
    enters = np.broadcast_to(enters_in(problem), (steps, n.w))
    first = n.free + n.leading + n.carried
    own = enters.sum(axis=1) + n.y + n.carried
    begin = first + np.cumsum(own) - own
    size, numbers = int(first + own.sum()), np.arange
    w = np.where(enters, begin[:, None] + numbers(n.w), size)
    y = (begin + enters.sum(axis=1))[:, None] + numbers(n.y)
    nodes = np.concatenate([[first - n.carried], begin + own - n.carried])[:, None] + numbers(n.carried)
    free, leading = numbers(n.free), n.free + numbers(n.leading)
    each = np.broadcast_to(free, (steps, n.free))
    count, c, e = n.y + n.carried + h, path.end.missing.size, path.end.excess.size
    rows = n.carried + count * numbers(steps)[:, None] + numbers(count)
    final = n.carried + count * steps + numbers(c + e)
    places = (
        Places(None, np.concatenate([free, leading, nodes[0]])[None], numbers(n.carried)[None]),
        Places(slices(problem), np.concatenate([each, nodes[:-1], w, y, nodes[1:]], axis=1), rows),
        Places(None, np.concatenate([free, nodes[-1]])[None], final[None]),
    )
    weights = jnp.ones(final[-1] + 1 if final.size else n.carried + count * steps)
    # Momenta of short steps are small numbers beside goals and bounds: forces are not.
    lengths = problem.lengths(jnp.zeros(n.free))
    weights = weights.at[rows[:, : n.y]].set(1.0 / lengths[:, None])
    scale = _typical(problem, path)
    for at in (numbers(n.carried), rows[:, n.y : n.y + n.carried]):
        weights = weights.at[at].set(1.0 / scale)
    coefficients = np.concatenate([leading.reshape(-1, n.w), w[enters[:, 0]]])
    return Simultaneous(
        sum_of((_first, _step, _end), places, size, problem),
        weights,
        rows[:, : n.y],
        rows[:, n.y : count - h],
        rows[:, count - h :],
        final[:c],
        final[c:],
        free,
        coefficients,
        y,
        nodes,
    )


def _typical(problem: OptimalControl, path: Path) -> Float[Array, " carried"]:
    """Typical sizes of what nodes hold: velocities as of a metre in all the time there is."""
    state, time = problem.state, jnp.sum(problem.lengths(jnp.zeros(len(problem.free))))
    nodes = jax.tree.map(itemgetter(slice(None)), path.nodes)
    ones = jnp.ones(state.q.size)
    x = jnp.concatenate(
        [ones, ones / time, jnp.ones(state.coordinates.size), jnp.ones(state.rates.size) / time]
    )
    others = [jnp.max(jnp.abs(part), axis=0, initial=0.0) for part in (nodes.last, nodes.memory)]
    register = jnp.broadcast_to(jnp.max(jnp.abs(nodes.register), initial=0.0), nodes.register.shape[1:])
    sizes = jnp.concatenate([x, *others, register.ravel()])
    return jnp.where(sizes > 0, sizes, 1.0)
