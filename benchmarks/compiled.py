"""Rollouts of a system as compiled programs, so that a timed call runs the program and little else.

The arrays of system, state, inputs and step are arguments of the program, never constants in it: what is
timed is what runs again after any number has changed. Checks of arguments and errors, which an eager
`nc.simulate` does in Python at each call, are not in the times.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import natcoord_jax as nc
from benchmarks import common

PARTS = ("system", "state", "inputs", "dt")


class Rollout:
    """A rollout, each of its programs compiled at its first call.

    A selection of arrays is one of `PARTS` or "all"; it means the floating ones. `about` is what results say
    of it.

    Args:
        system: compiled system.
        state: initial state.
        inputs: inputs of every step (steps, inputs).
        dt: step [s].
        order: of the scheme.
    """

    def __init__(self, system: nc.System, state: nc.State, inputs: Array, dt: float, order: int = 2):
        self._scheme = nc.EnergyMomentum(order=order)
        self.about = common.about(float(dt), len(inputs), order)
        whole = (system, state, jnp.asarray(inputs), jnp.asarray(dt, float))
        self._leaves, self._structure = jax.tree.flatten(whole)
        owners = [part for part, tree in zip(PARTS, whole, strict=True) for _ in jax.tree.leaves(tree)]
        self._places = [k for k, x in enumerate(self._leaves) if isinstance(x, jax.Array | np.ndarray)]
        self._owners = [owners[k] for k in self._places]
        self._arguments = [jnp.asarray(self._leaves[k]) for k in self._places]
        self._program = jax.jit(self._simulate)

    def _simulate(self, arguments: list[Array]) -> nc.Trajectory:
        leaves = list(self._leaves)
        for place, array in zip(self._places, arguments, strict=True):
            leaves[place] = array
        system, state, inputs, dt = jax.tree.unflatten(self._structure, leaves)
        return nc.simulate(system, state, dt=dt, inputs=inputs, scheme=self._scheme)

    def _selected(self, part: str) -> list[int]:
        return [
            k
            for k, (owner, x) in enumerate(zip(self._owners, self._arguments, strict=True))
            if part in (owner, "all") and jnp.issubdtype(x.dtype, jnp.floating)
        ]

    def run(self) -> nc.Trajectory:
        """Run to the end; the trajectory holds every step."""
        return jax.block_until_ready(self._program(self._arguments))

    def batch(self, part: str, lanes: Any) -> Callable[[], nc.Trajectory]:
        """A call that runs many lanes at once.

        Args:
            part: what differs from lane to lane, "state" or "inputs".
            lanes: the same with a leading axis of lanes.
        """
        chosen, arguments = self._selected(part), list(self._arguments)
        for k, x in zip(chosen, jax.tree.leaves(lanes), strict=True):
            arguments[k] = x
        axes = [0 if k in chosen else None for k in range(len(arguments))]
        program = jax.jit(jax.vmap(self._simulate, in_axes=(axes,)))
        return lambda: jax.block_until_ready(program(arguments))

    def loss(self, part: str) -> tuple[Callable[[], Array], Callable[[], Any], Callable[[], Any], int]:
        """Sum of squares of the final velocities, the same with its gradient, and with one tangent.

        Args:
            part: what the gradient is with respect to. The tangent is along these numbers themselves.

        Returns:
            Calls of the value, of value and gradient and of value and tangent, and the number of parameters.
            The second raises FloatingPointError if its first gradient is not finite, and the third if its
            first tangent is not that of the gradient: the time of a wrong one says nothing.
        """
        chosen = self._selected(part)

        def loss(values: list[Array], arguments: list[Array]) -> Array:
            arguments = list(arguments)
            for k, value in zip(chosen, values, strict=True):
                arguments[k] = value
            return jnp.sum(self._simulate(arguments).v[-1] ** 2)

        values = [self._arguments[k] for k in chosen]
        value, both = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
        seen = False

        def with_gradient() -> Any:
            nonlocal seen
            found = jax.block_until_ready(both(values, self._arguments))
            if not seen and not all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(found)):
                raise FloatingPointError(f"the gradient by the {part} is not finite")
            seen = True
            return found

        def along(values: list[Array], arguments: list[Array]) -> tuple[Array, Array]:
            return jax.jvp(lambda x: loss(x, arguments), (values,), (values,))

        tangent, compared = jax.jit(along), False

        def with_tangent() -> Any:
            nonlocal compared
            found = jax.block_until_ready(tangent(values, self._arguments))
            if not compared:
                terms = [g * x for g, x in zip(with_gradient()[1], values, strict=True)]
                size = sum(float(jnp.sum(jnp.abs(x))) for x in terms)
                if not abs(float(found[1]) - sum(float(jnp.sum(x)) for x in terms)) <= 1e-6 * size:
                    raise FloatingPointError(f"the tangent by the {part} is not that of the gradient")
            compared = True
            return found

        return (
            lambda: jax.block_until_ready(value(values, self._arguments)),
            with_gradient,
            with_tangent,
            sum(x.size for x in values),
        )
