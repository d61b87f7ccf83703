"""Sweeps along the tree node by node, in loops whose programs do not grow with the depth of the tree.

Only what is handed on from body to body is in the loops: angular velocities and sums of velocities down the
tree, sums of loads up. All else is done for all bodies at once, as if they were one level, and free bodies
hand on nothing. Loops carry one array and put out nothing else: an output read from what is carried would
make the compiler copy all of it for every node.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.sweeps import JointData, relative_motion, turning
from natcoord_jax.model.axisymmetric_axes import ball_axes, frame_axes
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.model.tree import JointGeometry, Level, Tree, TreeMotion, combine, joined
from natcoord_jax.xla.rows import add_at, row, with_row


class Geometry(NamedTuple):
    """Stage geometry of the motions of free bodies, and of the joints of all others."""

    free: JointGeometry
    hung: JointGeometry


def hinging(tree: Tree, frames: Array, rows: Float[Array, "bodies 4 3"]) -> JointData:
    """Bodies that hang on joints, and what they hang on."""
    here = tree.hung.here
    above = rows_with_ground(rows.reshape(-1, 3))[tree.parent[here]]
    symmetry = None if tree.symmetry is None else tree.symmetry[here]
    return JointData(frames[here], rows[here], tree.ball[here], above, symmetry=symmetry)


def free_axes(
    tree: Tree, frames: Float[Array, "bodies 2 4 4"], rows: Float[Array, "bodies 4 3"]
) -> Float[Array, "free 3 3"]:
    """Axes of the rates of free bodies, see `roundness`; those of space for points."""
    turning = tree.ball[tree.free.here][:, None, None]
    axes = tree.ball_axes(frames, rows[:, 1:])[0, tree.free.here]
    return jnp.where(turning, axes, jnp.eye(3, dtype=rows.dtype))


def _free_motion(
    tree: Tree,
    frames: Float[Array, "bodies 2 4 4"],
    rows: Float[Array, "bodies 4 3"],
    slots: Float[Array, "s bodies 7"],
    h: Float[Array, ""],
    tableau: Tableau,
) -> tuple[Array, Array, Array, JointGeometry]:
    """Angular velocities, velocities, stage directors and geometry of free bodies."""
    level, axes = tree.free, free_axes(tree, frames, rows)
    rate, count = slots[:, level.here], len(level.members)
    still = jnp.zeros((tableau.stages, count, 3), rows.dtype)
    turning = [rate[:, :, k, None] * axes[:, k] for k in level.rotations]
    sliding = [rate[:, :, 3 + k, None] * axes[:, k] for k in level.translations]
    spin, velocity = sum(turning, still), sum(sliding, still)
    d = rotate_stages(h * spin[:, :, None], rows[None, level.here, 1:], tableau)
    picked = axes[:, np.array([*level.rotations, *level.translations], int)]
    every = jnp.broadcast_to(picked, (tableau.stages, *picked.shape))
    return spin, velocity, d, JointGeometry(every, still, still, still)


def _spins_above(
    tree: Tree,
    these: JointData,
    slots: Float[Array, "s hung 7"],
    spins: Float[Array, "s free 3"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "s hung 3"]:
    """Angular velocities of the parents of all bodies that hang on joints, root to leaves."""
    level, here = tree.hung, tree.hung.here
    own = these.rows[None, :, 1:]
    picked = jnp.array(level.rotations, int)
    axes = frame_axes(these.frames[:, 0, 1:, 1:], these.parent_rows[None, :, 1:])[0][:, picked]
    if level.balls:
        own_axes = ball_axes(these.frames, these.symmetry, own)[0][:, picked]
        axes = jnp.where(these.ball[:, None, None], own_axes, axes)
    child = combine(these.frames[:, 1, 1, 1:], own)[0]

    def down(spins: Array, node: tuple) -> tuple[Array, None]:
        axes, child, ball, rate, index, parent = node
        above = row(spins, parent)
        turned = rotate_stages(h * above[:, None], axes[None], tableau)
        if level.balls:
            turned = jnp.where(ball, axes[None], turned)
        start = child[None, None] if level.child_rotation else None
        every = [turned[:, None, k] for k in range(len(level.rotations))]
        spin, _ = turning(level, every, start, above[:, None], rate[:, None], h, tableau)
        return with_row(spins, index, spin[:, 0]), None

    known = joined((tree.free, level), (spins, jnp.zeros_like(slots[:, :, :3])))
    parent, number = tree.parent[here], jnp.arange(tree.parent.shape[0])[here]
    nodes = (axes, child, these.ball, jnp.swapaxes(slots, 0, 1), number, parent)
    return jnp.swapaxes(jax.lax.scan(down, _with_rest(known), nodes)[0][parent], 0, 1)


def _sums_from_root(tree: Tree, relative: Float[Array, "s bodies 3"]) -> Float[Array, "s bodies 3"]:
    """Of each body, the sum of what it and the bodies that it hangs on have."""
    here = tree.hung.here

    def down(sums: Array, node: tuple) -> tuple[Array, None]:
        index, parent = node
        return add_at(sums, index, row(sums, parent)), None

    nodes = jnp.arange(relative.shape[1])[here], tree.parent[here]
    return jnp.swapaxes(jax.lax.scan(down, _with_rest(relative), nodes)[0][:-1], 0, 1)


def _with_rest(x: Float[Array, "s bodies k"]) -> Float[Array, "bodies_and_ground s k"]:
    """Vectors by body, last the zero of the ground."""
    return jnp.pad(jnp.swapaxes(x, 0, 1), ((0, 1), (0, 0), (0, 0)))


def sweep_nodes(
    tree: Tree,
    frames: Float[Array, "bodies 2 4 4"],
    rows: Float[Array, "bodies 4 3"],
    slots: Float[Array, "s bodies 7"],
    h: Float[Array, ""],
    tableau: Tableau,
) -> tuple[TreeMotion, Geometry]:
    """Motion of all bodies from the rates of the joints, root to leaves; see `sweeps.sweep_motion`."""
    *alone, free = _free_motion(tree, frames, rows, slots, h, tableau)
    if not tree.hung.members:
        none = JointGeometry(free.axes[:, :0, :0], *(free.child_arm[:, :0],) * 3)
        return TreeMotion(*alone), Geometry(free, none)
    these, hung = hinging(tree, frames, rows), slots[:, tree.hung.here]
    if tree.hung.grounded:
        spin_p = jnp.zeros_like(hung[:, :, :3])
    else:
        spin_p = _spins_above(tree, these, hung, alone[0], h, tableau)
    d_p = parent_directors(tree.hung, these, spin_p, h, tableau)
    *hinged, geometry = relative_motion(tree.hung, these, spin_p, d_p, hung, h, tableau)
    spin, velocity, d = (joined((tree.free, tree.hung), both) for both in zip(alone, hinged))
    if not tree.hung.grounded:
        velocity = _sums_from_root(tree, velocity)
    return TreeMotion(spin, velocity, d), Geometry(free, geometry)


def parent_directors(
    level: Level, these: JointData, spin_p: Float[Array, "s n 3"], h: Array, tableau: Tableau
) -> Float[Array, "s n 3 3"]:
    """Stage directors of what bodies hang on."""
    if level.grounded:
        return jnp.broadcast_to(jnp.eye(3, dtype=spin_p.dtype), (*spin_p.shape, 3))
    return rotate_stages(h * spin_p[:, :, None], these.parent_rows[None, :, 1:], tableau)


class TransmittedWrench(NamedTuple):
    """Forces and torques that the joints transmit, the torques about the bodies' reference points."""

    force: Float[Array, "s bodies 3"]
    torque: Float[Array, "s bodies 3"]


def load_nodes(
    tree: Tree, geometry: Geometry, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
) -> TransmittedWrench:
    """Sums of the forces and torques on each body and on all that hangs on it, leaves to root."""
    if tree.hung.grounded:
        return TransmittedWrench(force, torque)
    joints, here = geometry.hung, tree.hung.here
    arm = joints.parent_arm + joints.gap - joints.child_arm

    def up(sums: Array, node: tuple) -> tuple[Array, None]:
        arm, index, parent = node
        force, torque = jnp.split(row(sums, index), 2, axis=-1)
        return add_at(sums, parent, jnp.concatenate([force, torque + cross(arm, force)], axis=-1)), None

    start = _with_rest(jnp.concatenate([force, torque], axis=-1))
    nodes = jnp.swapaxes(arm, 0, 1), jnp.arange(force.shape[1])[here], tree.parent[here]
    sums = jax.lax.scan(up, start, nodes, reverse=True)[0][:-1]
    return TransmittedWrench(*jnp.split(jnp.swapaxes(sums, 0, 1), 2, axis=-1))


def spread_out(level: Level, slots: Sequence[int], x: Array, axis: int) -> Array:
    """What belongs to the slots that a level uses, at their places among others; zero elsewhere."""
    if level.slots == tuple(slots):
        return x
    columns = {slot: jax.lax.index_in_dim(x, i, axis, keepdims=False) for i, slot in enumerate(level.slots)}
    zero = jnp.zeros((*x.shape[:axis], *x.shape[axis + 1 :]), x.dtype)
    return jnp.stack([columns.get(slot, zero) for slot in slots], axis=axis)


def on_slots(tree: Tree, geometry: Geometry, through: TransmittedWrench) -> Float[Array, "s bodies k"]:
    """Generalised forces of the free motions, of all slots in use."""
    found = []
    for level, part in zip((tree.free, tree.hung), geometry):
        here = TransmittedWrench(through.force[:, level.here], through.torque[:, level.here])
        found.append(spread_out(level, tree.slots, forces_on_slots(level, part, here), 2))
    return joined((tree.free, tree.hung), found)


def forces_on_slots(
    level: Level, geometry: JointGeometry, through: TransmittedWrench
) -> Float[Array, "s n k"]:
    """The same of the bodies of one level, of the slots that it uses."""
    turning_arm, sliding_arm = slot_arms(level, geometry)
    force, torque = through.force[:, :, None], through.torque[:, :, None]
    return jnp.sum(turning_arm * torque + sliding_arm * force, axis=-1)


def slot_arms(level: Level, geometry: JointGeometry) -> tuple[Array, Array]:
    """Factors of torque and force in the generalised forces of the slots in use (s, bodies, k, 3)."""
    first, slides = len(level.rotations), len(level.translations)
    sliding = jnp.array([first <= k < first + slides for k in range(len(level.slots))], bool)[:, None]
    axes = geometry.axes
    moment = cross(geometry.child_arm[:, :, None], axes)
    return jnp.where(sliding, 0.0, axes), jnp.where(sliding, axes, moment)
