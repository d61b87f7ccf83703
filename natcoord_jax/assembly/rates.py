"""Velocities of bodies at one time from the rates of the tree's free motions, and back."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import System
from natcoord_jax.assembly.tree import JointGeometry, gather_slots, joint_rates, sweep_motion, tangent
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import angular_velocity
from natcoord_jax.maths.vectors import cross

Twists = tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]
"""Velocities of the reference points [m/s] and angular velocities [rad/s]; or forces [N] and torques [N m]."""


def geometry_at(system: System, rows: Float[Array, "bodies 4 3"]) -> list[JointGeometry]:
    """Axes and arms of the tree's joints at given rows."""
    slots = gather_slots(system.tree, jnp.zeros((1, system.structure.unknowns), rows.dtype))
    frames = system.tree.frames(system.frames)
    return sweep_motion(system.tree, frames, rows, slots, jnp.zeros((), rows.dtype), gauss(1))[1]


def twists(system: System, geometry: list[JointGeometry], w: Float[Array, " unknowns"]) -> Twists:
    """Velocities and angular velocities of all bodies from the rates of the tree's free motions."""
    velocity, spin = tangent(system.tree, geometry, gather_slots(system.tree, w[None]))
    return velocity[0], spin[0]


def tree_rates(system: System, geometry: list[JointGeometry], state: State) -> Float[Array, " unknowns"]:
    """Rates of the tree's free motions of a state."""
    rows, rates = state.q.reshape(-1, 4, 3), state.v.reshape(-1, 4, 3)
    spin = angular_velocity(rows[:, 1:], rates[:, 1:])
    return joint_rates(system.tree, geometry, rates[None, :, 0], spin[None])[0]


def row_rates(rows: Float[Array, "bodies 4 3"], velocity: Array, spin: Array) -> Float[Array, "bodies 4 3"]:
    """Velocities of the rows of bodies with given velocities and angular velocities."""
    return jnp.concatenate([velocity[:, None], cross(spin[:, None], rows[:, 1:])], axis=1)
