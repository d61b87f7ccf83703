"""Derivatives of what one joint does: motion goes from parent to child, loads from child to parent."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.vectors import cross, skew
from natcoord_jax.mechanics.node_sweeps import (
    Geometry,
    TransmittedWrench,
    forces_on_slots,
    parent_directors,
    slot_arms,
    spread_out,
)
from natcoord_jax.mechanics.sweeps import JointData, relative_motion
from natcoord_jax.model.tree import SLOTS, JointGeometry, Level, Tree, joined


def _derivatives(
    level: Level,
    these: JointData,
    spin_p: Float[Array, "s n 3"],
    rates: Float[Array, "s n k"],
    through: TransmittedWrench,
    h: Array,
    tableau: Tableau,
) -> Float[Array, "n s 9+k s 6+k"]:
    """Derivatives of what each joint passes on, at given loads.

    Of velocity and angular velocity of the child, torque on the parent and forces of the slots; by velocity
    and angular velocity of the parent and the rates.
    """
    s, bodies, k = rates.shape
    # What the ground carries sees nothing of it.
    seen = 0 if level.grounded else 3

    def local(spin_p: Array, rates: Array) -> Array:
        d_p = parent_directors(level, these, spin_p, h, tableau)
        slots = spread_out(level, range(SLOTS), rates, 2)
        spin, velocity, _, geometry = relative_motion(level, these, spin_p, d_p, slots, h, tableau)
        moved = cross(geometry.parent_arm + geometry.gap - geometry.child_arm, through.force)
        return jnp.concatenate([velocity, spin, moved, forces_on_slots(level, geometry, through)], axis=-1)

    def along(unit: Array) -> Array:
        every = jnp.broadcast_to(unit[:, None], (s, bodies, seen + k))
        turned = every[..., :3] if seen else jnp.zeros_like(spin_p)
        return jax.jvp(local, (spin_p, rates), (turned, every[..., seen:]))[1]

    count = s * (seen + k)
    columns = jax.vmap(along)(jnp.eye(count).reshape(count, s, seen + k))
    found = jnp.transpose(columns.reshape(s, seen + k, s, bodies, 9 + k), (3, 2, 4, 0, 1))
    if level.grounded:
        return jnp.pad(found, ((0, 0),) * 4 + ((6, 0),))
    # The velocity of the parent adds to that of the child, and changes nothing else.
    moving = jnp.eye(s)[:, None, :, None] * jnp.eye(9 + k, 3)[None, :, None, :]
    return jnp.concatenate([jnp.broadcast_to(moving, (bodies, *moving.shape)), found], axis=-1)


def _free_motions(geometry: JointGeometry, level: Level) -> Float[Array, "n s 6 s k"]:
    """Velocities and angular velocities of free bodies by their rates."""
    turning, sliding = slot_arms(level, geometry)
    by_rate = jnp.moveaxis(jnp.swapaxes(jnp.concatenate([sliding, turning], axis=-1), 2, 3), 0, 1)
    return by_rate[:, :, :, None] * jnp.eye(turning.shape[0])[None, :, None, :, None]


def _handed_up(level: Level, geometry: JointGeometry, carried: bool) -> Float[Array, "n s rows s 6"]:
    """What force and torque of a node are for its parent, if that carries it, and for its slots."""
    s, bodies, _ = geometry.child_arm.shape
    unit = carried * jnp.broadcast_to(jnp.eye(3), (s, bodies, 3, 3))
    arm = skew(geometry.parent_arm + geometry.gap - geometry.child_arm)
    turning, sliding = slot_arms(level, geometry)
    blocks = [
        jnp.concatenate([unit, jnp.zeros_like(unit)], axis=-1),
        jnp.concatenate([arm, unit], axis=-1),
        jnp.concatenate([sliding, turning], axis=-1),
    ]
    by_stage = jnp.moveaxis(jnp.concatenate(blocks, axis=2), 0, 1)
    return by_stage[:, :, :, None, :] * jnp.eye(s)[None, :, None, :, None]


def _spread(level: Level, slots: Sequence[int], x: Array, first: int, axis: int) -> Array:
    """An array whose axis holds other things before the slots of a level, with all slots."""
    before = jax.lax.slice_in_dim(x, 0, first, axis=axis)
    after = jax.lax.slice_in_dim(x, first, x.shape[axis], axis=axis)
    return jnp.concatenate([before, spread_out(level, slots, after, axis)], axis=axis)


def joint_blocks(
    tree: Tree,
    these: JointData,
    present: Bool[Array | np.ndarray, "bodies k"],
    spin: Float[Array, "s bodies_and_ground 3"],
    rates: Float[Array, "s bodies 7"],
    geometry: Geometry,
    through: TransmittedWrench,
    h: Array,
    tableau: Tableau,
) -> tuple[Array, Array, Array]:
    """Matrices (X, Z), (T, S) and N of all joints without effects, see `linsolve.tree`.

    Args:
        tree: the spanning tree.
        these: numbers of what hangs on joints.
        present: which slots each body has; the others keep their unknown at zero.
        spin: stage angular velocities.
        rates: mean rates by body and slot.
        geometry: of the joints.
        through: loads that the joints transmit.
        h: step [s].
        tableau: the collocation method.
    """
    levels, slots, s = (tree.free, tree.hung), tree.slots, tableau.stages
    bodies, k = present.shape
    # Of free bodies: motion is linear in the rates, whatever their neighbours do.
    free, more = _free_motions(geometry.free, tree.free), 3 + geometry.free.axes.shape[2]
    derivatives = [jnp.pad(free, ((0, 0), (0, 0), (0, more), (0, 0), (6, 0)))]
    gathers = [_handed_up(tree.free, geometry.free, False)]
    if tree.hung.members:
        here = tree.hung.here
        spin_p, loads = spin[:, tree.parent[here]], TransmittedWrench(*(x[:, here] for x in through))
        own = rates[:, here][:, :, np.array(tree.hung.slots, int)]
        derivatives.append(_derivatives(tree.hung, these, spin_p, own, loads, h, tableau))
        gathers.append(_handed_up(tree.hung, geometry.hung, not tree.hung.grounded))
    derivatives = [
        _spread(level, slots, _spread(level, slots, x, 9, 2), 6, 4) for level, x in zip(levels, derivatives)
    ]
    gathers = [_spread(level, slots, x, 6, 2) for level, x in zip(levels, gathers)]
    found, gather = (joined(levels[: len(x)], x, 0) for x in (derivatives, gathers))
    kept = jnp.concatenate([jnp.ones((bodies, 6), bool), present], axis=1)
    found = jnp.where(kept[:, None, None, None, :], found, 0.0)
    motion, torque, by_slot = found[:, :, :6], found[:, :, 6:9], found[:, :, 9:]
    by_slot = jnp.where(present[:, None, :, None, None], by_slot, 0.0)
    idle = jnp.eye(s)[:, None, :, None] * (~present[:, :, None] * jnp.eye(k, 6 + k, 6))[:, None, :, None, :]
    loads = jnp.concatenate([jnp.zeros_like(torque), torque], axis=2)
    gather = jnp.where(kept[:, None, :, None, None], gather, 0.0)

    def flat(x: Array) -> Array:
        rows = x.shape[1] * x.shape[2]
        first = x[..., :6].reshape(bodies, rows, 6 * s)
        return jnp.concatenate([first, x[..., 6:].reshape(bodies, rows, -1)], axis=2)

    rest = jnp.concatenate([flat(loads), flat(by_slot + idle)], axis=1)
    gather = jnp.concatenate([flat(gather[:, :, :6]), flat(gather[:, :, 6:])], axis=1)
    return flat(motion), gather, rest


def rooted_blocks(
    tree: Tree,
    these: JointData,
    present: Bool[Array | np.ndarray, "bodies k"],
    rates: Float[Array, "s bodies 7"],
    geometry: Geometry,
    through: TransmittedWrench,
    h: Array,
    tableau: Tableau,
) -> tuple[Array, Array, Array]:
    """Matrices Z, S and the own part of N, where all bodies hang on the ground; see `joint_blocks`."""
    levels, slots, s = (tree.free, tree.hung), tree.slots, tableau.stages
    bodies, k = present.shape
    free = _free_motions(geometry.free, tree.free)
    count = free.shape[4]
    moved, pulled = [free], [jnp.transpose(free, (0, 3, 4, 1, 2))]
    bent = [jnp.zeros((free.shape[0], s, count, s, count), free.dtype)]
    if tree.hung.members:
        here = tree.hung.here
        loads = TransmittedWrench(*(x[:, here] for x in through))
        own = rates[:, here][:, :, np.array(tree.hung.slots, int)]
        still = jnp.zeros_like(rates[:, here, :3])
        found = _derivatives(tree.hung, these, still, own, loads, h, tableau)[..., 6:]
        moved.append(found[:, :, :6])
        pulled.append(_handed_up(tree.hung, geometry.hung, False)[:, :, 6:])
        bent.append(found[:, :, 9:])

    def whole(parts: list[Array], axes: tuple[int, ...]) -> Array:
        used = levels[: len(parts)]
        for axis in axes:
            parts = [spread_out(level, slots, x, axis) for level, x in zip(used, parts)]
        return joined(used, parts, 0)

    has = present.astype(free.dtype)
    column, line = has[:, None, None, None, :], has[:, None, :, None, None]
    idle = jnp.eye(s)[:, None, :, None] * ((1.0 - has)[:, :, None] * jnp.eye(k))[:, None, :, None, :]
    blocks = (
        whole(moved, (4,)) * column,
        whole(pulled, (2,)) * line,
        whole(bent, (2, 4)) * line * column + idle,
    )
    z, gather, n = (x.reshape(bodies, x.shape[1] * x.shape[2], -1) for x in blocks)
    return z, gather, n
