"""Inverse dynamics: inputs that make joint coordinates follow a path, exactly for the discrete motion."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import System
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.stepping.step import advance

ROUNDS = 6
"""Newton corrections of the rates of a step."""
ACCURACY = 1e-8
"""Part of the loads that inputs may leave unbalanced before the path counts as impossible."""


@eqx.filter_jit
def _followed(
    system: System, state: State, path: Float[Array, "steps c"], dt: Array
) -> tuple[Array, State, Array, Array]:
    unknowns, tableau = system.structure.unknowns, gauss(1)
    none = jnp.zeros(len(system.structure.inputs))

    def after(state: State, y: Array, u: Array) -> tuple[Array, State]:
        residual, following, _ = advance(system, state, u, dt, y, tableau)
        return residual, following

    def body(carry: tuple, wanted: Array) -> tuple:
        state, y = carry

        def correct(_: Any, y: Array) -> Array:
            def missing(w: Array) -> Array:
                moved = y.at[:unknowns].set(w)
                return after(state, moved, none)[1].coordinates - wanted

            w = y[:unknowns]
            return y.at[:unknowns].add(-jnp.linalg.lstsq(jax.jacfwd(missing)(w), missing(w))[0])

        y = jax.lax.fori_loop(0, ROUNDS, correct, y)
        # Residuals are linear in inputs and multipliers.
        rates, loads = y[:unknowns], jnp.concatenate([none, y[unknowns:] * 0.0])

        def balance(loads: Array) -> Array:
            return after(state, jnp.concatenate([rates, loads[none.size :]]), loads[: none.size])[0]

        left, matrix = balance(loads), jax.jacfwd(balance)(loads)
        found = -jnp.linalg.lstsq(matrix, left)[0]
        rest = jnp.max(jnp.abs(left + matrix @ found)) / jnp.maximum(jnp.max(jnp.abs(left)), 1e-300)
        y, u = jnp.concatenate([rates, found[none.size :]]), found[: none.size]
        following = after(state, y, u)[1]
        return (following, y), (u, following, rest, jnp.max(jnp.abs(following.coordinates - wanted)))

    first = jnp.zeros(unknowns + system.structure.multipliers)
    _, (inputs, states, rest, missed) = jax.lax.scan(body, (state, first), path)
    return inputs, states, rest, missed


def inverse_dynamics(
    system: System, state: State, coordinates: Any, *, dt: Any
) -> tuple[Float[Array, "steps inputs"], State]:
    """Inputs that make all joint coordinates follow a path, exactly for the energy-momentum step (57).

    `nc.simulate` with these inputs reproduces the path to round-off.

    Args:
        system: compiled system whose free motions all have an input (a fully actuated one).
        state: initial state; its coordinates are where the path starts.
        coordinates: joint coordinates at the end of every step, shape (steps, coordinates), in the order of
            `system.structure.coordinates` [rad, counted on over many turns, or m].
        dt: step [s].

    Returns:
        Inputs (steps, inputs) [N, N m], and the states at the ends of the steps.

    Raises:
        ValueError: for a wrong shape, or a path that the inputs cannot bring about.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, disc))
        >>> motor = scene.add(nc.JointTorque(hinge, name="motor"))
        >>> system, state = scene.compile()
        >>> path = jnp.linspace(0.0, 1.0, 11)[1:, None] ** 3
        >>> inputs, _ = nc.inverse_dynamics(system, state, path, dt=0.1)
        >>> trajectory = nc.simulate(system, state, dt=0.1, inputs=inputs)
        >>> bool(abs(trajectory.states.coordinates[1:] - path).max() < 1e-12)
        True
    """
    path = jnp.asarray(coordinates, float)
    count = len(system.structure.coordinates)
    if path.ndim != 2 or path.shape[1] != count or path.shape[0] == 0:
        names = [f"{name} [{k}]" for name, k in system.structure.coordinates]
        raise ValueError(f"coordinates has shape {path.shape}; pass (steps, {count}) for {names}")
    inputs, states, rest, missed = _followed(system, state, path, jnp.asarray(dt, float))
    worst, off = float(np.max(rest)), float(np.max(missed))
    if not (worst < ACCURACY and off < ACCURACY):
        where = int(np.argmax(np.asarray(rest) + np.asarray(missed)))
        raise ValueError(
            f"the inputs {list(system.structure.inputs)} cannot bring about the path in step {where}: "
            f"{worst:.1e} of the loads stay unbalanced and the coordinates miss it by {off:.1e} rad or m; "
            "every free motion needs an input, and the path must obey the constraints"
        )
    return inputs, states
