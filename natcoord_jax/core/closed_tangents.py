"""Derivatives of the forces of an energy of invariants, in formulas, for Newton's iteration.

Invariants are quadratic in the marker vectors x and do not change when all of these are turned together, so
that their second derivatives are numbers for each pair of vectors, times the unit matrix. For one stage the
forces are f = -G_m^T S, with G_m the derivatives of the invariants in the middle of the step, and S a
gradient that follows the invariants at the end with half the curvature H of the energy. With increments D x
of the vectors along the step, which end where the derivatives of the invariants are G_1,

    d f = -1/2 (G_m^T H G_1 + sum_i S_i Q_i) d(D x).

A viscosity C adds C D pi / h to S, and 2 C / h to H.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.together import instances_last, place_together
from natcoord_jax.maths.vectors import cross

HALF = 0.5
"""Part of the increments of a step by which its middle moves."""


def stiffness(
    potential: Any,
    start: Float[Array, "k *m 3 n"],
    middle: Float[Array, "k *m 3 n"],
    moved: Float[Array, "k *m 3 n"],
    now: StepContext,
    curvature: Float[Array, "n p p"],
) -> tuple[Float[Array, "n x x"], Float[Array, "k *m 3 n"]]:
    """Second derivatives -d f/d(D x), of x = 3 k m components, and the forces f.

    Args:
        potential: with numbers whose last axis is that of the instances.
        start: marker vectors at the start of the step.
        middle: in its middle.
        moved: their increments.
        now: of the step.
        curvature: of the energy.
    """
    shape, count = start.shape[:-1], start.shape[-1]
    size = math.prod(shape)
    units = jnp.eye(size, dtype=start.dtype).reshape(size, *shape, 1)

    def slopes(x: Array) -> Float[Array, "n p x"]:
        def along(unit: Array) -> Array:
            return jax.jvp(potential.invariants, (x,), (jnp.broadcast_to(unit, x.shape),))[1]

        return jnp.transpose(jax.vmap(along)(units), (2, 1, 0))

    steps = jax.jvp(potential.invariants, (middle,), (moved,))[1]
    stress = potential.averaged(potential.invariants(start), steps[None], now.tableau)[0]
    viscosity = potential.viscosity
    if viscosity is not None:
        rate = 1.0 / jnp.where(now.h > 0, now.h, 1.0)
        stress = stress + rate * jnp.sum(viscosity * steps[None], axis=1)
        curvature = curvature + 2.0 * rate * jnp.moveaxis(viscosity, -1, 0)
    # Of each vector one component tells all.
    firsts = units[::3]
    pulled = jax.vmap(lambda e: potential.pulled_back(jnp.broadcast_to(e, start.shape), stress))(firsts)
    by_pair = pulled[..., 0, :].reshape(size // 3, size // 3, count)
    geometric = jnp.transpose(by_pair, (2, 0, 1))[:, :, None, :, None] * jnp.eye(3)[:, None, :]
    material = jnp.swapaxes(slopes(middle), 1, 2) @ (curvature @ slopes(start + moved))
    whole = HALF * (material + geometric.reshape(count, size, size))
    return whole, -potential.pulled_back(middle, stress)


def tangents_together(
    potential: Any, place: Float[Array, "n k *m 4"], motion: Motion, now: StepContext, *, turning: bool
) -> Float[Array, "n k 1 r k 1 r"]:
    """Derivatives of the wrenches of a potential by the twists, see `Effect.tangents`; for one stage.

    Args:
        potential: one that takes many instances at once.
        place: weights of the rows of the bodies in the marker vectors, each of one body.
        motion: of the bodies.
        now: of the step.
        turning: whether bodies turn.
    """
    last, weights, start = instances_last((potential, place, motion.start))
    rows, rates = instances_last((motion.rows[0], motion.rates[0]))
    begun, middle, moved = (place_together(weights, x) for x in (start, rows, now.h * rates))
    curvature = jax.vmap(lambda e, x: e.energy_curvature(e.invariants(x)))(
        potential, jnp.moveaxis(middle, -1, 0)
    )
    found, forces = stiffness(last, begun, middle, moved, now, curvature)
    vectors = place.reshape(*place.shape[:2], -1, 4)
    on_vectors = jnp.moveaxis(forces, -1, 0).reshape(*vectors.shape[:3], 3)
    return by_twists(found, on_vectors, vectors, motion, now.h, turning)


def by_twists(
    stiffness: Float[Array, "n x x"],
    forces: Float[Array, "n k m 3"],
    place: Float[Array, "n k m 4"],
    motion: Motion,
    h: Float[Array, ""],
    turning: bool,
) -> Float[Array, "n k 1 r k 1 r"]:
    """Derivatives of the wrenches on bodies by their twists, each marker vector being of one body.

    Args:
        stiffness: -d f/d(D x) of the marker vectors.
        forces: on the marker vectors.
        place: weights of the rows of the bodies in the vectors.
        motion: of the bodies, for one stage.
        h: step.
        turning: whether bodies turn.
    """
    n, k, m = place.shape[:3]
    blocks = stiffness.reshape(n, k, m, 3, k, m, 3)
    if not turning:
        weights = place[..., 0]
        found = jnp.einsum("nam,namxbly,nbl->naxby", weights, blocks, weights)
        return -h * found[:, :, None, :, :, None]
    across, along, middle = twist_maps(place, motion, h)
    found = -h * jnp.einsum("namux,namxbly,nblvy->naubv", across, blocks, along)
    # What turns the directors also turns the arms of the forces on them.
    arms = jnp.einsum("nkmi,nkmx->nkix", place[..., 1:], forces)
    turned = jnp.sum(cross(middle, arms[:, :, None]), axis=3)
    own = jnp.zeros((n, k, 6, 6), place.dtype).at[:, :, 3:, 3:].set(jnp.swapaxes(turned, 2, 3))
    found = found + own[:, :, :, None] * jnp.eye(k)[:, None, :, None]
    return found[:, :, None, :, :, None]


def twist_maps(
    place: Float[Array, "n k m 4"], motion: Motion, h: Float[Array, ""]
) -> tuple[Float[Array, "n k m 6 3"], Float[Array, "n k m 6 3"], Float[Array, "n k 3 3 3"]]:
    """Velocities of marker vectors by the twists of their bodies, as they are and as increments follow them.

    And derivatives of the directors in the middle of the step by the spin, see `_turned_by`.
    """
    n, k, m = place.shape[:3]
    unit = jnp.eye(3, dtype=place.dtype)
    spin, directors, start = motion.spin[0], motion.rows[0, :, :, 1:], motion.start[:, :, 1:]
    # Velocities of the rows for a unit angular velocity, as they are; and as increments follow the twist,
    # which turns the directors in the middle of the step, too.
    pulls = cross(unit[:, None], directors[:, :, None])
    middle = _turned_by(spin, start, directors, h)
    moves = pulls + cross(spin[:, :, None, None], middle)
    across, along = (
        jnp.concatenate(
            [
                jnp.broadcast_to(place[..., :1, None] * unit, (n, k, m, 3, 3)),
                jnp.einsum("nkmi,nkuix->nkmux", place[..., 1:], x),
            ],
            axis=3,
        )
        for x in (pulls, moves)
    )
    return across, along, middle


def _turned_by(
    spin: Float[Array, "n k 3"],
    start: Float[Array, "n k 3 3"],
    middle: Float[Array, "n k 3 3"],
    h: Float[Array, ""],
) -> Float[Array, "n k 3 3 3"]:
    """Derivatives (component of spin, director, place) of the directors in the middle by the spin.

    With half the rotation vector a = h/2 w the directors obey d = d_0 + a x d, so that (1 - a x) d' = e x d.
    """
    unit, half = jnp.eye(3, dtype=spin.dtype), 0.5 * h * spin
    right = 0.5 * h * cross(unit[:, None], middle[:, :, None])
    a = half[:, :, None, None]
    solved = right + cross(a, right) + a * jnp.sum(a * right, axis=-1, keepdims=True)
    return solved / (1.0 + jnp.sum(half * half, axis=-1))[:, :, None, None, None]
