"""Sweeps along the tree node by node, in loops whose programs do not grow with the depth of the tree.

Only what is handed on from body to body is in the loops: angular velocities and sums of velocities down the
tree, sums of loads up. All else is done for all bodies at once, as if they were one level. Loops carry one
array and put out nothing else: an output read from what is carried would make the compiler copy all of it
for every node.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.diagnostics import rows_with_ground
from natcoord_jax.assembly.sweeps import Hinging, relative_motion, turning
from natcoord_jax.assembly.tree import JointGeometry, Level, Tree, TreeMotion, combine, frame_axes
from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.rows import add_at, row, with_row
from natcoord_jax.maths.vectors import cross


def united(tree: Tree) -> Level:
    """All bodies as one level, with the union of their joints' free motions."""
    levels = tree.levels
    return Level(
        0,
        levels[-1].stop if levels else 0,
        tuple(sorted({k for level in levels for k in level.rotations})),
        tuple(sorted({k for level in levels for k in level.translations})),
        any(level.child_rotation for level in levels),
        False,
        any(level.balls for level in levels),
    )


def hinging(tree: Tree, frames: Array, rows: Float[Array, "bodies 4 3"]) -> Hinging:
    """All bodies and what they hang on."""
    above = rows_with_ground(rows.reshape(-1, 3))[tree.parent]
    return Hinging(frames, rows, tree.ball, above)


def _spins_above(
    tree: Tree, level: Level, these: Hinging, slots: Array, h: Array, tableau: Tableau
) -> Float[Array, "s bodies 3"]:
    """Angular velocities of the parents of all bodies, root to leaves."""
    bodies, stages = these.rows.shape[0], tableau.stages
    own = these.rows[None, :, 1:]
    picked = jnp.array(level.rotations, int)
    axes = frame_axes(these.frames[:, 0, 1:, 1:], these.parent_rows[None, :, 1:])[0][:, picked]
    if level.balls:
        own_axes = frame_axes(these.frames[:, 1, 1:, 1:], own)[0][:, picked]
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

    start = jnp.zeros((bodies + 1, stages, 3), own.dtype)
    nodes = (axes, child, these.ball, jnp.swapaxes(slots, 0, 1), jnp.arange(bodies), tree.parent)
    return jnp.swapaxes(jax.lax.scan(down, start, nodes)[0][tree.parent], 0, 1)


def _sums_from_root(tree: Tree, relative: Float[Array, "s bodies 3"]) -> Float[Array, "s bodies 3"]:
    """Of each body, the sum of what it and the bodies that it hangs on have."""

    def down(sums: Array, node: tuple) -> tuple[Array, None]:
        index, parent = node
        return add_at(sums, index, row(sums, parent)), None

    nodes = jnp.arange(relative.shape[1]), tree.parent
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
) -> tuple[TreeMotion, JointGeometry]:
    """Motion of all bodies from the rates of the joints, root to leaves; see `sweeps.sweep_motion`."""
    level, these = united(tree), hinging(tree, frames, rows)
    spin_p = _spins_above(tree, level, these, slots, h, tableau)
    d_p = rotate_stages(h * spin_p[:, :, None], these.parent_rows[None, :, 1:], tableau)
    spin, relative, d, geometry = relative_motion(level, these, spin_p, d_p, slots, h, tableau)
    return TreeMotion(spin, _sums_from_root(tree, relative), d), geometry


class Through(NamedTuple):
    """Forces and torques that the joints transmit, the torques about the bodies' reference points."""

    force: Float[Array, "s bodies 3"]
    torque: Float[Array, "s bodies 3"]


def load_nodes(
    tree: Tree, geometry: JointGeometry, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
) -> Through:
    """Sums of the forces and torques on each body and on all that hangs on it, leaves to root."""
    arm = geometry.parent_arm + geometry.gap - geometry.child_arm

    def up(sums: Array, node: tuple) -> tuple[Array, None]:
        arm, index, parent = node
        force, torque = jnp.split(row(sums, index), 2, axis=-1)
        return add_at(sums, parent, jnp.concatenate([force, torque + cross(arm, force)], axis=-1)), None

    start = _with_rest(jnp.concatenate([force, torque], axis=-1))
    nodes = jnp.swapaxes(arm, 0, 1), jnp.arange(force.shape[1]), tree.parent
    sums = jax.lax.scan(up, start, nodes, reverse=True)[0][:-1]
    return Through(*jnp.split(jnp.swapaxes(sums, 0, 1), 2, axis=-1))


def on_slots(level: Level, geometry: JointGeometry, through: Through) -> Float[Array, "s bodies k"]:
    """Generalised forces of the free motions, of all slots in use."""
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
