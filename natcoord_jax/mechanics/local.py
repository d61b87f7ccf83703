"""Local equations: the momentum of one body and the response of one effect, as functions of twists.

The twist of a body is its mean velocity of the reference point and its angular velocity (the local null
space: director rates are omega x d). Jacobians are taken here, over the few unknowns of a body or an effect.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.momentum import inertia_alone, stage_changes
from natcoord_jax.mechanics.response import GroupData, respond, step_context
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST


def body_motion(
    start: Float[Array, "*n k 4 3"], twists: Float[Array, "*n k s 6"], h: Array, tableau: Tableau
) -> Motion:
    """Stage motion of bodies from their twists (velocity, angular velocity)."""
    velocity, spin = jnp.moveaxis(twists[..., :3], -2, 0), jnp.moveaxis(twists[..., 3:], -2, 0)
    directors = rotate_stages(h * spin[..., None, :], start[None, ..., 1:, :], tableau)
    a = h * jnp.asarray(tableau.a, start.dtype)
    points = start[..., 0, :] + jnp.einsum("ij,j...->i...", a, velocity)
    rows = jnp.concatenate([points[..., None, :], directors], axis=-2)
    rates = jnp.concatenate([velocity[..., None, :], cross(spin[..., None, :], directors)], axis=-2)
    return Motion(start, rows, rates, spin)


def wrenches(
    rows: Float[Array, "s *n k 4 3"], torques: Float[Array, "s *n k 3"], motion: Motion
) -> Float[Array, "*n k s 6"]:
    """Force and torque about the reference point of forces on rows and torques."""
    turning = jnp.sum(cross(motion.rows[..., 1:, :], rows[..., 1:, :]), axis=-2) + torques
    return jnp.moveaxis(jnp.concatenate([rows[..., 0, :], turning], axis=-1), 0, -2)


def body_balance(
    mass: Float[Array, "4 4"],
    start: Float[Array, "4 3"],
    velocity: Float[Array, "4 3"],
    twist: Float[Array, "s 6"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "s 6"]:
    """Change of momentum of one body as a wrench."""
    motion = body_motion(start[None], twist[None], h, tableau)
    momentum = inertia_alone(mass[None], stage_changes(motion.rates - velocity[None, None], tableau))
    return wrenches(momentum, jnp.zeros_like(motion.spin), motion)[0]


def _impulses(
    group: Group, answer: Response, motion: Motion, h: Array
) -> tuple[Float[Array, "*n k s 6"], Float[Array, "*n s m"]]:
    """Impulsive wrenches on the bodies, and constraint rates, of the response of one effect or of many."""
    scale = 1.0 if group.effect.impulsive else h
    forces = jnp.zeros_like(motion.rows)
    torques = jnp.zeros_like(motion.spin)
    if answer.forces is not None:
        forces = scale * jnp.moveaxis(answer.forces, -4, 0)
    if answer.torques is not None:
        torques = scale * jnp.moveaxis(answer.torques, -3, 0)
    return wrenches(forces, torques, motion), answer.rows


def effect_balances(
    group: Group,
    where: GroupData,
    tableau: Tableau,
    start: Float[Array, "n k 4 3"],
    twists: Float[Array, "n k s r"],
    lam: Float[Array, "n s m"],
) -> tuple[Float[Array, "n k s r"], Float[Array, "n s m"]]:
    """Impulsive wrenches of all effects of a group on their bodies, and their constraint rates.

    Of what does not turn, twists and wrenches are velocities and forces.
    """
    motion = body_motion(start, whole(twists), where.h, tableau)
    found, rows = _impulses(group, respond(group, where, motion, lam, tableau), motion, where.h)
    return found[..., : twists.shape[-1]], rows


def whole(twists: Float[Array, "*n r"]) -> Float[Array, "*n 6"]:
    """Twists of what need not turn."""
    missing = TWIST - twists.shape[-1]
    return jnp.pad(twists, ((0, 0),) * (twists.ndim - 1) + ((0, missing),)) if missing else twists


def jacobians(
    group: Group,
    where: GroupData,
    tableau: Tableau,
    start: Array,
    twists: Float[Array, "n k s r"],
    lam: Array,
    *,
    exact: bool = True,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivatives of `effect_balances` by twists and multipliers; leading axis n.

    With `exact` False, those of what effects give for their linearisation, or of their formulas.
    """
    if not exact:
        return _linearised_jacobians(group, where, tableau, start, twists, lam)

    def f(twists: Array, lam: Array) -> tuple[Array, Array]:
        return effect_balances(group, where, tableau, start, twists, lam)

    def columns(at: Array, of: Callable[[Array], tuple[Array, Array]]) -> tuple[Array, Array]:
        """Derivatives by what each instance has: every instance sees its own only."""
        shape = at.shape[1:]
        count = math.prod(shape)
        units = jnp.eye(count, dtype=at.dtype).reshape(count, *shape)
        found = jax.vmap(lambda unit: jax.jvp(of, (at,), (jnp.broadcast_to(unit, at.shape),))[1])(units)
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:], *shape), found)

    by_twist, g_by_twist = columns(twists, lambda x: f(x, lam))
    by_lam, g_by_lam = columns(lam, lambda x: f(twists, x))
    return (by_twist, by_lam), (g_by_twist, g_by_lam)


def _linearised_jacobians(
    group: Group, where: GroupData, tableau: Tableau, start: Array, twists: Array, lam: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    rates = twists.shape[-1]
    with jax.named_scope(group.effect.kind.replace(" ", "_")):
        now = step_context(where, tableau)
        motion = body_motion(start, whole(twists), where.h, tableau)
        found = group.effect.tangents(where.place, motion, now, lam, turning=rates == TWIST)
        if found is not None:
            scale = 1.0 if group.effect.impulsive else where.h
            return _without_multipliers(scale * found, lam)

        def one(effect, place, inputs, coordinates, rates, stress, start, twists, lam):
            now = StepContext(where.t, where.h, inputs, coordinates, rates, tableau, stress)
            effect = effect.linearised(place, body_motion(start, whole(twists), where.h, tableau), now, lam)

            def f(twists: Array, lam: Array) -> tuple[Array, Array]:
                motion = body_motion(start, whole(twists), where.h, tableau)
                found, rows = _impulses(group, effect.respond(place, motion, now, lam), motion, where.h)
                return found[..., : twists.shape[-1]], rows

            return jax.jacfwd(f, argnums=(0, 1))(twists, lam)

        axes = (None if group.effect.shared else 0, 0, 0, 0, 0, 0, 0, 0, 0)
        numbers = (group.effect, where.place, where.inputs, where.coordinates, where.rates, where.stress)
        return jax.vmap(one, in_axes=axes)(*numbers, start, twists, lam)


def _without_multipliers(
    by_twist: Float[Array, "n k s r k s r"], lam: Float[Array, "n s 0"]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivatives of an effect that has no multipliers."""
    n, k, s, r = by_twist.shape[:4]
    rows = jnp.zeros((n, s, 0, k, s, r), lam.dtype), jnp.zeros((n, s, 0, s, 0), lam.dtype)
    return (by_twist, jnp.zeros((n, k, s, r, s, 0), lam.dtype)), rows
