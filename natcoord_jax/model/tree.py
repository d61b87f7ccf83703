"""The joint null space: sweeps along the spanning tree, forward for motion and backward for forces.

Every body hangs on exactly one joint, free bodies on a free motion relative to the ground, also where an
effect couples them to a neighbour: nodes of a beam are as free as satellites. The unknowns are the mean
rates of the joints' free motions; with mid-point (stage) vectors, a the parent's axis and u the vector
between the joint's points,

    omega_c = omega_p + sum_k w_k a_k        (rotations about the parent's axes)
            + w_6 b                          (about the child's own first axis, for universal joints)
    u'      = omega_p x u + sum_k w_3+k t_k  (t_k = a_i x a_j, cross products of the parent's axes)

so that constraint rates vanish identically (47-50). Stage vectors come from `rotate_stages`. Levels are
unrolled, the bodies of one level are handled together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.maths.vectors import cross, dot
from natcoord_jax.model.axisymmetric_axes import ball_axes, frame_axes

SLOTS = 7
"""Free motions a joint can have: 3 rotations and 3 translations along parent axes, 1 rotation about a child
axis."""


def turns(slots: Array | np.ndarray) -> Array | np.ndarray:
    """Which of these free motions are rotations."""
    return (slots < 3) | (slots == SLOTS - 1)


@dataclass(frozen=True)
class Level:
    """Bodies that are handled together, in the order of their numbers, and the union of their free motions.

    `grounded`: all parents are the ground; `balls`: some joints leave all rotations free.
    """

    members: Sequence[int]
    rotations: tuple[int, ...]
    translations: tuple[int, ...]
    child_rotation: bool
    grounded: bool
    balls: bool

    @property
    def slots(self) -> tuple[int, ...]:
        """Slots in use."""
        last = (6,) if self.child_rotation else ()
        return (*self.rotations, *(3 + k for k in self.translations), *last)

    @property
    def here(self) -> slice | np.ndarray:
        """Index of the members; a slice, which costs nothing, where they follow each other."""
        if isinstance(self.members, range):
            return slice(self.members.start, self.members.stop)
        return np.array(self.members, np.int32) if self.members else slice(0, 0)


def joined(levels: Sequence[Level], parts: Sequence[Array], axis: int = 1) -> Array:
    """What belongs to all bodies, in the order of their numbers, from what belongs to levels."""
    every = [body for level in levels for body in level.members]
    whole = parts[0] if len(parts) == 1 else jnp.concatenate(list(parts), axis=axis)
    if every == list(range(len(every))):
        return whole
    return jnp.take(whole, np.argsort(every).astype(np.int32), axis=axis)


class Tree(eqx.Module):
    """Spanning tree of the bodies: body b is the child of joint b.

    Attributes:
        parent: body that the joint of each body hangs on; the number of bodies stands for the ground.
        neighbour: body that each body follows in the order of elimination: its parent, or for a free body one
            that an effect couples it to.
        parent_in_level: the same, counted within the previous level.
        slot_index: unknown of each body's slots; the number of unknowns where a slot is absent.
        slot_of: body * 7 + slot of each unknown.
        side: (parent, child) frame of each joint as the tree uses it, exchanged where it is used backwards.
        order: rows (point, axis 1, 2, 3) of those frames as the tree uses them.
        ball: bodies whose joint leaves all rotations free, and directors; their rates are components along
            axes in which the inertia matrix changes least, see `roundness`.
        levels: bodies by depth, the joints between them and the ground counted.
        free: free bodies.
        hung: bodies that hang on joints.
        backwards: whether any joint is used from child to parent.
        symmetry: axes about which bodies are round, see `roundness`; None: nothing can be.
        directed: which bodies are directors, that do not turn about their first axes; None: there are none.
    """

    parent: Int[np.ndarray, " bodies"] = eqx.field(**INDICES)
    neighbour: Int[np.ndarray, " bodies"] = eqx.field(**INDICES)
    parent_in_level: Int[np.ndarray, " bodies"] = eqx.field(**INDICES)
    slot_index: Int[np.ndarray, "bodies 7"] = eqx.field(**INDICES)
    slot_of: Int[np.ndarray, " unknowns"] = eqx.field(**INDICES)
    side: Int[np.ndarray, "bodies 2"] = eqx.field(**INDICES)
    order: Int[np.ndarray, "bodies 4"] = eqx.field(**INDICES)
    ball: Bool[np.ndarray, " bodies"] = eqx.field(**INDICES)
    levels: tuple[Level, ...] = eqx.field(static=True)
    free: Level = eqx.field(static=True)
    hung: Level = eqx.field(static=True)
    backwards: bool = eqx.field(static=True)
    symmetry: Float[Array, "bodies 4"] | None = None
    directed: Bool[np.ndarray, " bodies"] | None = eqx.field(default=None, **INDICES)

    @property
    def slots(self) -> tuple[int, ...]:
        """Slots that any body uses."""
        return tuple(sorted({*self.free.slots, *self.hung.slots}))

    def chained(self) -> "Tree":
        """The same with free bodies hanging on their neighbours, by all six motions."""
        levels = (self.free, self.hung)
        whole = Level(
            range(len(self.ball)),
            tuple(sorted({k for level in levels for k in level.rotations})),
            tuple(sorted({k for level in levels for k in level.translations})),
            any(level.child_rotation for level in levels),
            False,
            any(level.balls for level in levels),
        )
        none = Level((), (), (), False, True, False)
        return replace_fields(self, parent=self.neighbour, free=none, hung=whole)

    def ball_axes(
        self, frames: Float[Array, "bodies 2 4 4"], directors: Float[Array, "bodies 3 3"]
    ) -> Float[Array, "1 bodies 3 3"]:
        """Axes of the rates of balls, with the directors at the start of the step."""
        return ball_axes(frames, self.symmetry, directors[None])

    def frames(self, frames: Float[Array, "joints 2 4 4"]) -> Float[Array, "bodies 2 4 4"]:
        """Frames of the tree's joints, in the direction of the tree."""
        own = frames[: self.parent.shape[0]]
        if not self.backwards:
            return own
        body = np.arange(own.shape[0])[:, None, None]
        return own[body, self.side[:, :, None], self.order[:, None, :]]


class JointGeometry(eqx.Module):
    """Stage geometry of the joints of one level, all in world components.

    Attributes:
        axes: directions of the slots in use: rotation axes, then translations, then the child axis.
        parent_arm: from the parent's reference point to the joint [m].
        child_arm: from the child's reference point to the joint [m].
        gap: from the joint's point on the parent to that on the child [m].
    """

    axes: Float[Array, "s n slots 3"]
    parent_arm: Float[Array, "s n 3"]
    child_arm: Float[Array, "s n 3"]
    gap: Float[Array, "s n 3"]


class TreeMotion(eqx.Module):
    """Stage motion of all bodies: angular velocities, velocities of points, stage directors."""

    spin: Float[Array, "s bodies 3"]
    velocity: Float[Array, "s bodies 3"]
    directors: Float[Array, "s bodies 3 3"]


def gather_slots(tree: Tree, w: Float[Array, "s unknowns"]) -> Float[Array, "s bodies 7"]:
    """Rates by body and slot, zero where a slot is absent."""
    padded = jnp.concatenate([w, jnp.zeros((w.shape[0], 1), w.dtype)], axis=1)
    return padded[:, tree.slot_index]


def combine(coefficients: Float[Array, "n m"], vectors: Float[Array, "*s n m 3"]) -> Float[Array, "*s n 3"]:
    """Sums of vectors of each body."""
    return jnp.sum(coefficients[..., None] * vectors, axis=-2)


def tangent(
    tree: Tree, geometry: list[JointGeometry], slots: Float[Array, "s bodies 7"]
) -> tuple[Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]:
    """Linear map P: velocities of points and angular velocities of all bodies, at fixed geometry."""
    spins, velocities = [], []
    for level, joint in zip(tree.levels, geometry):
        here = level.here
        rate = slots[:, here][:, :, jnp.array(level.slots, int), None] * joint.axes
        slides = len(level.translations)
        turning = jnp.concatenate(
            [rate[:, :, : len(level.rotations)], rate[:, :, len(level.rotations) + slides :]], axis=2
        )
        spin = jnp.sum(turning, axis=2)
        velocity = jnp.sum(rate[:, :, len(level.rotations) : len(level.rotations) + slides], axis=2)
        if not level.grounded:
            up = tree.parent_in_level[here]
            spin_p = spins[-1][:, up]
            velocity = velocity + velocities[-1][:, up] + cross(spin_p, joint.parent_arm + joint.gap)
            spin = spin + spin_p
        velocity = velocity - cross(spin, joint.child_arm)
        spins.append(spin)
        velocities.append(velocity)
    return joined(tree.levels, velocities), joined(tree.levels, spins)


def project(
    tree: Tree,
    geometry: list[JointGeometry],
    forces: Float[Array, "s bodies 3"],
    torques: Float[Array, "s bodies 3"],
) -> tuple[Float[Array, "s unknowns"], Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]:
    """Transposed map P^T: generalised forces from forces and torques at the reference points, leaves to root.

    Returns:
        Generalised forces of the unknowns, and the force and torque that each body's joint transmits to
        its child's subtree, the torque about the joint's point on the child.
    """
    slots, through_f, through_n = [], [], []
    carried: tuple[Array, Array] | None = None
    for level, joint in zip(reversed(tree.levels), reversed(geometry)):
        here = level.here
        f, n = forces[:, here], torques[:, here]
        if carried is not None:
            f, n = f + carried[0], n + carried[1]
        about = n - cross(joint.child_arm, f)
        rotations, slides = len(level.rotations), len(level.translations)
        vectors = [about] * rotations + [f] * slides + [about] * level.child_rotation
        columns = {k: dot(v, a) for k, v, a in zip(level.slots, vectors, jnp.unstack(joint.axes, axis=2))}
        zero = jnp.zeros_like(f[..., 0])
        slots.append(jnp.stack([columns.get(slot, zero) for slot in range(SLOTS)], axis=-1))
        through_f.append(f)
        through_n.append(about)
        if not level.grounded:
            onto = tree.parent_in_level[here]
            width = tree.levels[len(tree.levels) - len(slots) - 1]
            pick = (np.arange(len(width.members))[:, None] == onto[None, :]).astype(f.dtype)
            moved = about + cross(joint.parent_arm + joint.gap, f)
            carried = (
                jnp.sum(pick[:, :, None] * f[:, None], axis=2),
                jnp.sum(pick[:, :, None] * moved[:, None], axis=2),
            )
    by_slot, force, torque = (joined(tree.levels, x[::-1]) for x in (slots, through_f, through_n))
    stages, bodies = by_slot.shape[:2]
    return by_slot.reshape(stages, bodies * SLOTS)[:, tree.slot_of], force, torque


def start_rates(
    tree: Tree,
    frames: Float[Array, "bodies 2 4 4"],
    rows: Float[Array, "bodies 4 3"],
    velocity: Float[Array, "bodies 4 3"],
) -> Float[Array, " unknowns"]:
    """Rates of the free motions of given rows and velocities, of all bodies at once.

    The left inverse of the map from rates to velocities where axes are orthonormal, that is, between steps.
    """
    ground = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)]).astype(rows.dtype)[None]
    every, moving = jnp.concatenate([rows, ground]), jnp.concatenate([velocity, jnp.zeros_like(ground)])
    spin = 0.5 * jnp.sum(cross(every[:, 1:], moving[:, 1:]), axis=1)
    parent, spin_p = every[tree.parent], spin[tree.parent]
    parent_axes = frame_axes(frames[:, 0, 1:, 1:], parent[None, :, 1:])[0]
    own_axes = frame_axes(frames[:, 1, 1:, 1:], rows[None, :, 1:])[0]
    child_arm = combine(frames[:, 1, 0, 1:], rows[:, 1:])
    apart = rows[:, 0] + child_arm - parent[:, 0]
    relative = spin[:-1] - spin_p
    gap_rate = velocity[:, 0] + cross(spin[:-1], child_arm) - moving[tree.parent][:, 0] - cross(spin_p, apart)
    axes = jnp.where(tree.ball[:, None, None], tree.ball_axes(frames, rows[:, 1:])[0], parent_axes)
    turning, sliding = dot(relative[:, None], axes), dot(gap_rate[:, None], axes)
    slots = jnp.concatenate([turning, sliding, dot(relative, own_axes[:, 0])[:, None]], axis=1)
    return slots.reshape(-1)[tree.slot_of]
