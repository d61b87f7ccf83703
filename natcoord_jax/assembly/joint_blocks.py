"""Derivatives of what one joint does: motion goes from parent to child, loads from child to parent."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.assembly.node_sweeps import Through, on_slots, slot_arms
from natcoord_jax.assembly.sweeps import Hinging, relative_motion
from natcoord_jax.assembly.tree import SLOTS, JointGeometry, Level
from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.vectors import cross, skew


def _of_slots(level: Level, rates: Float[Array, "s n k"]) -> Float[Array, "s n 7"]:
    columns = {slot: rates[:, :, i] for i, slot in enumerate(level.slots)}
    return jnp.stack([columns.get(k, jnp.zeros(rates.shape[:2], rates.dtype)) for k in range(SLOTS)], axis=2)


def _derivatives(
    level: Level,
    these: Hinging,
    spin_p: Float[Array, "s n 3"],
    rates: Float[Array, "s n k"],
    through: Through,
    h: Array,
    tableau: Tableau,
) -> Float[Array, "n s 9+k s 6+k"]:
    """Derivatives of what each joint passes on, at given loads.

    Of velocity and angular velocity of the child, torque on the parent and forces of the slots; by velocity
    and angular velocity of the parent and the rates.
    """
    s, bodies, k = rates.shape

    def local(spin_p: Array, rates: Array) -> Array:
        d_p = rotate_stages(h * spin_p[:, :, None], these.parent_rows[None, :, 1:], tableau)
        slots = _of_slots(level, rates)
        spin, velocity, _, geometry = relative_motion(level, these, spin_p, d_p, slots, h, tableau)
        moved = cross(geometry.parent_arm + geometry.gap - geometry.child_arm, through.force)
        return jnp.concatenate([velocity, spin, moved, on_slots(level, geometry, through)], axis=-1)

    def along(unit: Array) -> Array:
        every = jnp.broadcast_to(unit[:, None], (s, bodies, 3 + k))
        return jax.jvp(local, (spin_p, rates), (every[..., :3], every[..., 3:]))[1]

    columns = jax.vmap(along)(jnp.eye(s * (3 + k)).reshape(-1, s, 3 + k))
    found = jnp.transpose(columns.reshape(s, 3 + k, s, bodies, 9 + k), (3, 2, 4, 0, 1))
    # The velocity of the parent adds to that of the child, and changes nothing else.
    moving = jnp.eye(s)[:, None, :, None] * jnp.eye(9 + k, 3)[None, :, None, :]
    return jnp.concatenate([jnp.broadcast_to(moving, (bodies, *moving.shape)), found], axis=-1)


def _handed_up(level: Level, geometry: JointGeometry) -> Float[Array, "n s rows s 6"]:
    """What force and torque of a node are for its parent and for its slots."""
    s, bodies, _ = geometry.child_arm.shape
    unit = jnp.broadcast_to(jnp.eye(3), (s, bodies, 3, 3))
    arm = skew(geometry.parent_arm + geometry.gap - geometry.child_arm)
    turning, sliding = slot_arms(level, geometry)
    blocks = [
        jnp.concatenate([unit, jnp.zeros_like(unit)], axis=-1),
        jnp.concatenate([arm, unit], axis=-1),
        jnp.concatenate([sliding, turning], axis=-1),
    ]
    by_stage = jnp.moveaxis(jnp.concatenate(blocks, axis=2), 0, 1)
    return by_stage[:, :, :, None, :] * jnp.eye(s)[None, :, None, :, None]


def joint_blocks(
    level: Level,
    these: Hinging,
    present: Bool[Array | np.ndarray, "n k"],
    spin_p: Float[Array, "s n 3"],
    rates: Float[Array, "s n k"],
    geometry: JointGeometry,
    through: Through,
    h: Array,
    tableau: Tableau,
) -> tuple[Array, Array, Array]:
    """Matrices (X, Z), (T, S) and N of all joints without effects, see `linsolve.tree`.

    Args:
        level: all bodies as one level.
        these: their numbers.
        present: which slots each joint has; the others keep their unknown at zero.
        spin_p: angular velocities of the parents.
        rates: mean rates by body and slot in use.
        geometry: of the joints.
        through: loads that the joints transmit.
        h: step [s].
        tableau: the collocation method.
    """
    s, bodies, k = rates.shape
    found = _derivatives(level, these, spin_p, rates, through, h, tableau)
    kept = jnp.concatenate([jnp.ones((bodies, 6), bool), present], axis=1)
    found = jnp.where(kept[:, None, None, None, :], found, 0.0)
    motion, torque, slots = found[:, :, :6], found[:, :, 6:9], found[:, :, 9:]
    slots = jnp.where(present[:, None, :, None, None], slots, 0.0)
    idle = jnp.eye(s)[:, None, :, None] * (~present[:, :, None] * jnp.eye(k, 6 + k, 6))[:, None, :, None, :]
    loads = jnp.concatenate([jnp.zeros_like(torque), torque], axis=2)
    gather = jnp.where(kept[:, None, :, None, None], _handed_up(level, geometry), 0.0)

    def flat(x: Array) -> Array:
        rows = x.shape[1] * x.shape[2]
        first = x[..., :6].reshape(bodies, rows, 6 * s)
        return jnp.concatenate([first, x[..., 6:].reshape(bodies, rows, -1)], axis=2)

    rest = jnp.concatenate([flat(loads), flat(slots + idle)], axis=1)
    gather = jnp.concatenate([flat(gather[:, :, :6]), flat(gather[:, :, 6:])], axis=1)
    return flat(motion), gather, rest
