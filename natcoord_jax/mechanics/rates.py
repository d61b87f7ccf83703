"""The joint null space at one time: velocities of bodies from the rates of the tree's free motions.

At one time all axes and points are known, so that nothing has to be swept: a free motion of a joint moves
every body that hangs on it, turning about an axis through the joint's point or sliding along it. The
programs are small whatever the depth of the tree.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.state import State
from natcoord_jax.maths.vectors import cross, dot
from natcoord_jax.mechanics.coordinates import velocities_with_ground
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.model.tree import SLOTS, turns

Twists = tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]
"""Velocities of reference points [m/s] and angular velocities [rad/s]; or forces [N] and torques [N m]."""


FEW = 100
"""Bodies up to which a matrix of all pairs of them is written into programs."""


def carried(system: Model) -> Float[Array | np.ndarray, "bodies bodies"]:
    """Which body (first axis) hangs on which body's tree joint (second axis): 1 or 0."""
    count = len(system.structure.bodies)
    # A constant of the program, unless it would be a large one.
    number: Any = np.arange(count) if count <= FEW else jnp.arange(count)
    hangs = ((number == number[:, None]) | (number == system.tree.parent[:, None])).astype(system.mass.dtype)
    for _ in range((len(system.tree.levels) - 1).bit_length()):
        hangs = (hangs @ hangs > 0).astype(hangs.dtype)
    return hangs


def joint_axes(
    system: Model, rows: Float[Array, "bodies 4 3"]
) -> tuple[Float[Array, "bodies 7 3"], Float[Array, "bodies 3"]]:
    """Axes of all slots of the tree's joints, and the joints' points on the bodies they carry [m]."""
    above = rows_with_ground(rows.reshape(-1, 3))[system.tree.parent]
    frames = system.tree.frames(system.frames)
    parent, child = jax.vmap(frames_at)(frames, jnp.stack([above, rows], axis=1))
    a = parent.axes
    along = jnp.unstack(a, axis=1)
    if system.tree.directed is not None:
        a = jnp.where(system.tree.directed[:, None, None], child.axes, a)
    slides = jnp.stack([cross(along[(k + 1) % 3], along[(k + 2) % 3]) for k in range(3)], axis=1)
    return jnp.concatenate([a, slides, child.axes[:, :1]], axis=1), child.point


def null_space(
    system: Model, rows: Float[Array, "bodies 4 3"]
) -> tuple[Float[Array, "bodies unknowns 3"], Float[Array, "bodies unknowns 3"]]:
    """Velocities and angular velocities of all bodies per unit rate of each free motion."""
    axes, points = joint_axes(system, rows)
    body, slot = system.tree.slot_of // SLOTS, system.tree.slot_of % SLOTS
    axis: Any = axes[body, slot]
    hangs: Any = carried(system)[:, body, None]
    turning = turns(slot)[:, None]
    arm = rows[:, None, 0] - points[body]
    velocity = jnp.where(turning, cross(axis, arm), axis)
    return hangs * velocity, hangs * jnp.where(turning, axis, 0.0)


def twists(system: Model, rows: Float[Array, "bodies 4 3"], w: Float[Array, " unknowns"]) -> Twists:
    """Velocities and angular velocities of all bodies from the rates of the free motions."""
    velocity, spin = null_space(system, rows)
    return jnp.einsum("buc,u->bc", velocity, w), jnp.einsum("buc,u->bc", spin, w)


def tree_rates(system: Model, state: State) -> Float[Array, " unknowns"]:
    """Rates of the free motions of a state."""
    rows = rows_with_ground(state.q)
    rates, spin = velocities_with_ground(state.v, rows)
    axes, points = joint_axes(system, rows[:-1])

    def at_joint(body):
        return rates[body, 0] + cross(spin[body], points - rows[body, 0])

    own, parent = jnp.arange(points.shape[0]), system.tree.parent
    turning = dot(axes, (spin[own] - spin[parent])[:, None])
    sliding = dot(axes, (at_joint(own) - at_joint(parent))[:, None])
    slots = jnp.where(jnp.array([True] * 3 + [False] * 3 + [True]), turning, sliding)
    return slots.reshape(-1)[system.tree.slot_of]


def passed_on(system: Model, rows: Float[Array, "bodies 4 3"], force: Array, torque: Array) -> Twists:
    """What each tree joint transmits to the bodies that hang on it, about its point on the first of them.

    Args:
        system: compiled system.
        rows: rows of all bodies.
        force: forces on the bodies [N], shape (bodies, 3).
        torque: torques about their reference points [N m], shape (bodies, 3).
    """
    _, points = joint_axes(system, rows)
    hangs: Any = carried(system)
    about_origin = torque + cross(rows[:, 0], force)
    forces, torques = hangs.T @ force, hangs.T @ about_origin
    return forces, torques - cross(points, forces)
