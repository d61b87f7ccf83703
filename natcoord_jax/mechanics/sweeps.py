"""Forward sweep of the joint null space: from the rates of the joints to the motion of all bodies."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.vectors import cross
from natcoord_jax.model.axisymmetric_axes import ball_axes, frame_axes
from natcoord_jax.model.tree import JointGeometry, Level, Tree, TreeMotion, combine, joined


class JointData(eqx.Module):
    """Bodies of one level, and what they hang on.

    Attributes:
        frames: weights of the joints' frames.
        rows: of the bodies at the start of the step.
        ball: whether the joints leave all rotations free.
        parent_rows: rows of the parents at the start of the step.
        turned: directors at the stages whose axes the free rotations and translations are taken along; None:
            those at the start of the step.
        symmetry: axes about which bodies are round, see `roundness`; None: nothing can be.
    """

    frames: Float[Array, "n 2 4 4"]
    rows: Float[Array, "n 4 3"]
    ball: Bool[Array | np.ndarray, " n"]
    parent_rows: Float[Array, "n 4 3"]
    turned: Float[Array, "s n 3 3"] | None = None
    symmetry: Float[Array, "n 4"] | None = None


def turning(
    level: Level,
    axes: Sequence[Array],
    child_axis: Array | None,
    spin_p: Float[Array, "s n 3"],
    rate: Float[Array, "s n 7"],
    h: Float[Array, ""],
    tableau: Tableau,
) -> tuple[Float[Array, "s n 3"], list[Array]]:
    """Angular velocities from those of the parents, and the child axis if there is one.

    Args:
        level: the bodies.
        axes: stage axes of their rotations.
        child_axis: start of the axis that is fixed to the child.
        spin_p: angular velocities of the parents.
        rate: mean rates by slot.
        h: step [s].
        tableau: the collocation method.
    """
    spin = spin_p
    rates = jnp.unstack(rate[..., None], axis=2)
    for k, axis in zip(level.rotations, axes):
        spin = spin + rates[k] * axis
    if child_axis is None:
        return spin, []
    turned = rotate_stages(h * spin, child_axis, tableau)
    return spin + rates[6] * turned, [turned]


def relative_motion(
    level: Level,
    these: JointData,
    spin_p: Float[Array, "s n 3"],
    d_p: Float[Array, "s n 3 3"],
    rate: Float[Array, "s n 7"],
    h: Float[Array, ""],
    tableau: Tableau,
) -> tuple[Array, Array, Array, JointGeometry]:
    """Motion of the bodies of one level on parents whose reference points rest.

    Args:
        level: the bodies.
        these: their numbers.
        spin_p: angular velocities of the parents.
        d_p: stage directors of the parents.
        rate: mean rates by slot.
        h: step [s].
        tableau: the collocation method.

    Returns:
        Angular velocities, velocities relative to those of the parents' points, stage directors, geometry.
    """
    place, rows = these.frames, these.rows
    d0 = rows[None, :, 1:]
    parent_axes = frame_axes(place[:, 0, 1:, 1:], d_p)
    along = jnp.unstack(parent_axes, axis=2)
    axes = [along[k] for k in level.rotations]
    slides = [cross(along[(k + 1) % 3], along[(k + 2) % 3]) for k in level.translations]
    if level.balls:
        turned = d0 if these.turned is None else these.turned
        own, ball = jnp.unstack(ball_axes(place, these.symmetry, turned), axis=2), these.ball[:, None]
        axes = [jnp.where(ball, own[k], a) for k, a in zip(level.rotations, axes)]
        slides = [jnp.where(ball, own[k], t) for k, t in zip(level.translations, slides)]
    start = combine(place[:, 1, 1, 1:], d0) if level.child_rotation else None
    spin, child_axis = turning(level, axes, start, spin_p, rate, h, tableau)
    d = rotate_stages(h * spin[:, :, None], d0, tableau)
    parent_arm = combine(place[:, 0, 0, 1:], d_p)
    child_arm = combine(place[:, 1, 0, 1:], d)
    velocity = -cross(spin, child_arm)
    if not level.grounded:
        velocity = velocity + cross(spin_p, parent_arm)
    gap = jnp.zeros_like(child_arm)
    if level.translations:
        rates = jnp.unstack(rate[..., None], axis=2)
        sliding = sum(rates[3 + k] * t for k, t in zip(level.translations, slides))
        velocity = velocity + sliding
        if not level.grounded:
            above = these.parent_rows
            child_point = rows[:, 0] + combine(place[:, 1, 0, 1:], d0[0])
            apart = child_point - above[:, 0] - combine(place[:, 0, 0, 1:], above[:, 1:])
            stages = jnp.asarray(tableau.a, rows.dtype)
            apart = apart + h * jnp.einsum("ij,jnc->inc", stages, sliding)
            gap = rotate_stages(h * spin_p, apart, tableau)
            velocity = velocity + cross(spin_p, gap)
    motions, none = axes + slides + child_axis, jnp.zeros((*child_arm.shape[:2], 0, 3), child_arm.dtype)
    stacked = jnp.stack(motions, axis=2) if motions else none
    return spin, velocity, d, JointGeometry(stacked, parent_arm, child_arm, gap)


def turned_directors(
    rows: Float[Array, "bodies 4 3"], velocity: Float[Array, "bodies 4 3"], h: Array, tableau: Tableau
) -> Float[Array, "s bodies 3 3"]:
    """Directors at the stages, if all bodies keep the angular velocities of the start of the step."""
    spin = 0.5 * jnp.sum(cross(rows[:, 1:], velocity[:, 1:]), axis=1)
    turn = jnp.broadcast_to(h * spin[:, None], (tableau.stages, *rows[:, 1:].shape))
    return rotate_stages(turn, rows[None, :, 1:], tableau)


def sweep_motion(
    tree: Tree,
    frames: Float[Array, "bodies 2 4 4"],
    rows: Float[Array, "bodies 4 3"],
    slots: Float[Array, "s bodies 7"],
    h: Float[Array, ""],
    tableau: Tableau,
    turned: Float[Array, "s bodies 3 3"] | None = None,
) -> tuple[TreeMotion, list[JointGeometry]]:
    """Motion of all bodies from the rates of the joints, root to leaves, level by level.

    Args:
        tree: the spanning tree.
        frames: weights of the joints' frames, joint b belonging to body b.
        rows: rows of all bodies at the start of the step.
        slots: mean rates by body and slot.
        h: step [s].
        tableau: the collocation method.
        turned: see `JointData`.
    """
    unit = jnp.eye(3, dtype=rows.dtype)
    spins, velocities, triads, geometry = [], [], [], []
    for level in tree.levels:
        here = level.here
        if level.grounded:
            shape = (tableau.stages, len(level.members), 3)
            spin_p = velocity_p = jnp.zeros(shape, rows.dtype)
            d_p, parent_rows = jnp.broadcast_to(unit, (*shape, 3)), rows[here]
        else:
            up = tree.parent_in_level[here]
            spin_p, velocity_p, d_p = spins[-1][:, up], velocities[-1][:, up], triads[-1][:, up]
            parent_rows = rows[tree.parent[here]]
        along = None if turned is None else turned[:, here]
        symmetry = None if tree.symmetry is None else tree.symmetry[here]
        these = JointData(frames[here], rows[here], tree.ball[here], parent_rows, along, symmetry)
        spin, relative, d, joint = relative_motion(level, these, spin_p, d_p, slots[:, here], h, tableau)
        geometry.append(joint)
        spins.append(spin)
        velocities.append(velocity_p + relative)
        triads.append(d)
    return TreeMotion(*(joined(tree.levels, x) for x in (spins, velocities, triads))), geometry
