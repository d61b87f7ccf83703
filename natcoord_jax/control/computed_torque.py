"""Computed torque: inputs of inverse dynamics along a path, and feedback in the inertia they work against."""

from collections.abc import Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.control.inverse import followed, places_of
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import JOINT_NAME, Several
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.state import STATE, State
from natcoord_jax.mechanics.admissible_velocities import tangent
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.checked import STEP
from natcoord_jax.system import System


class ComputedTorque(eqx.Module):
    """Inputs as a function of time and state, for `nc.simulate(..., inputs=)`; see `nc.computed_torque`.

    Attributes:
        system: that moves.
        inputs: along the path, by step.
        coordinates: at the start of every step [rad, m].
        rates: the same [rad/s, m/s].
        gains: inputs per change of the coordinates at the end of a step, by step.
        bandwidth: rate at which errors decay [1/s].
        start: time of the first step [s].
        dt: step [s].
        places: of the coordinates in the state.
    """

    system: System
    inputs: Float[Array, "steps inputs"]
    coordinates: Float[Array, "steps c"]
    rates: Float[Array, "steps c"]
    gains: Float[Array, "steps inputs c"]
    bandwidth: Float[Array, ""]
    start: Float[Array, ""]
    dt: Float[Array, ""]
    places: Int[Array | np.ndarray, " c"]

    def __call__(self, t: Float[Array, ""], state: State) -> Float[Array, " inputs"]:
        """Inputs [N, N m] of the step that starts at a time [s]; after the last step those of the last."""
        k = jnp.clip(jnp.round((t - self.start) / self.dt).astype(int), 0, len(self.inputs) - 1)
        strayed = self.coordinates[k] - state.coordinates[self.places]
        faster = self.rates[k] - state_rates(self.system, state)[self.places]
        pole = jnp.exp(-self.bandwidth * self.dt)
        wanted = 0.5 * (1 - pole) ** 2 * strayed + 0.25 * (1 - pole) * (3 + pole) * self.dt * faster
        return self.inputs[k] + jnp.sum(self.gains[k] * wanted, axis=-1)


@checked()
def computed_torque(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    coordinates: Annotated[Any, Numbers((None, None))],
    *,
    dt: Annotated[Any, STEP],
    bandwidth: Annotated[Any, Number("positive")] = 10.0,
    joints: Annotated[Sequence[Handle | str] | None, Several(JOINT_NAME, 1)] = None,
) -> ComputedTorque:
    """Computed-torque control of a path: the inputs of inverse dynamics, and feedback for what strays.

    Feedback is worked out for the discrete motion: inputs held over a step move the coordinates at its end
    by a matrix that inverse dynamics knows, of everything that moves with them, flexible parts included. In
    those terms the error obeys e_1 = e + h e' + a, h e'_1 = h e' + 2 a with a = -(alpha e + beta h e'), and
    alpha = (1 - p)^2 / 2, beta = (1 - p)(3 + p) / 4 give both poles p = exp(-bandwidth h): no gains to tune,
    none that are unstable at some pose.

    Args:
        system: compiled system with as many inputs as coordinates are prescribed.
        state: initial state; its coordinates are where the path starts.
        coordinates: joint coordinates at the end of every step, see `nc.inverse_dynamics`.
        dt: step [s].
        bandwidth: rate at which errors decay [1/s]. Springs and beams on a light part want one above the
            root of stiffness over inertia where they push it away from the path; below 1 / dt.
        joints: handles or names of the joints whose coordinates are prescribed; default all.

    Returns:
        A function of time and state for `nc.simulate(system, state, dt=dt, steps=steps, inputs=...)`; its
        numbers are leaves.

    Raises:
        ValueError: for a wrong shape, or a path that the inputs cannot bring about.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity())
        >>> rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=(0, 0, 0.5)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0)))
        >>> motor = scene.add(nc.JointTorque(hinge, name="motor"))
        >>> system, state = scene.compile()
        >>> path = 0.3 * (1 - jnp.cos(jnp.arange(1, 201) * 0.05))[:, None]  # upright: unstable by itself
        >>> control = nc.computed_torque(system, state, path, dt=0.05)
        >>> pushed = system.with_coordinate(state, hinge, 0.1)
        >>> run = nc.simulate(system, pushed, dt=0.05, steps=200, inputs=control)
        >>> bool(abs(run.states.coordinates[-1] - path[-1]).max() < 1e-6)
        True
    """
    places = places_of(system, joints)
    found = followed(system, state, coordinates, dt, places)
    begun = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), state, found.states)
    return ComputedTorque(
        system,
        found.inputs,
        begun.coordinates[:, places],
        _rates(system, begun)[:, places],
        jnp.linalg.pinv(found.reach),
        jnp.asarray(bandwidth, float),
        state.t,
        jnp.asarray(dt, float),
        places,
    )


@compiled
def _rates(system: System, states: State) -> Float[Array, "steps c"]:
    """As the feedback is handed them."""
    return jax.vmap(lambda state: state_rates(system, tangent(system, state)))(states)
