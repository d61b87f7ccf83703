"""Values and rates of all joint coordinates at one time, from rows and velocities."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE, by_node
from natcoord_jax.core.coordinate import pair_motion
from natcoord_jax.core.joint import Frame, frames_at
from natcoord_jax.core.motion import Motion
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import angular_velocity
from natcoord_jax.mechanics.response import StageKinematics
from natcoord_jax.model.groups import CoordinateGroup
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import rows_with_ground


def frames_of(
    system: Model, joints: Array | np.ndarray, rows: Float[Array, "bodies_and_ground 4 3"]
) -> tuple[Frame, Frame]:
    """Frames of parent and child of several joints, as the scene names them; leading axis the joints."""
    return jax.vmap(frames_at)(system.frames[joints], rows[system.joint_bodies[joints]])


def velocities_with_ground(
    v: Float[Array, "rows 3"], rows: Float[Array, "bodies_and_ground 4 3"]
) -> tuple[Float[Array, "bodies_and_ground 4 3"], Float[Array, "bodies_and_ground 3"]]:
    """Velocities of the rows and angular velocities by body, the resting ground last."""
    rates = jnp.concatenate([by_node(v), jnp.zeros((1, *NODE), v.dtype)])
    return rates, angular_velocity(rows[:, 1:], rates[:, 1:])


def coordinate_values(
    system: Model, rows: Float[Array, "bodies_and_ground 4 3"]
) -> Float[Array, " coordinates"]:
    """Joint coordinates [rad, in (-pi, pi], or m] of given rows."""
    found = jnp.zeros(len(system.structure.coordinates), rows.dtype)
    for group in system.coordinates:
        values = jax.vmap(group.axis.value)(*frames_of(system, group.joints, rows))
        found = found.at[group.index].set(values)
    return found


def coordinate_rates(
    system: Model,
    rows: Float[Array, "bodies_and_ground 4 3"],
    rates: Float[Array, "bodies_and_ground 4 3"],
    spin: Float[Array, "bodies_and_ground 3"],
) -> Float[Array, " coordinates"]:
    """Rates [rad/s or m/s] of all joint coordinates, linear in velocities and angular velocities."""
    found = jnp.zeros(len(system.structure.coordinates), rows.dtype)
    for group in system.coordinates:
        bodies = system.joint_bodies[group.joints]
        relative = spin[bodies[:, 1]] - spin[bodies[:, 0]]
        frames = frames_of(system, group.joints, rows)
        moving = frames_of(system, group.joints, rates)
        found = found.at[group.index].set(jax.vmap(group.axis.rate)(*frames, *moving, relative))
    return found


def state_rates(system: Model, state: State) -> Float[Array, " coordinates"]:
    """Rates [rad/s or m/s] of all joint coordinates of one state."""
    rows = rows_with_ground(state.q)
    return coordinate_rates(system, rows, *velocities_with_ground(state.v, rows))


def _rates_of_group(
    group: CoordinateGroup, system: Model, at: StageKinematics, h: Array
) -> Float[Array, "s n"]:
    bodies = system.joint_bodies[group.joints]

    def one(place, start, rows, rates, spin):
        return group.axis.unit_load(pair_motion(place, Motion(start, rows, rates, spin), 0), h).rate

    motion = at.start[bodies], at.rows[:, bodies], at.rates[:, bodies], at.spin[:, bodies]
    with jax.named_scope("joint_coordinates"):
        return jax.vmap(one, in_axes=(0, 0, 1, 1, 1), out_axes=1)(system.frames[group.joints], *motion)


def stage_rates(system: Model, at: StageKinematics, h: Array) -> Float[Array, "s coordinates"]:
    """Rates of joint coordinates whose weighted sum over the stages is the exact increment over h."""
    if not system.coordinates:
        return jnp.zeros((at.rates.shape[0], 0), at.rates.dtype)
    every = [_rates_of_group(group, system, at, h) for group in system.coordinates]
    return jnp.concatenate(every, axis=1)[:, system.coordinate_order]
