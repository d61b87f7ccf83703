"""Local equations: the momentum of one body and the response of one effect, as functions of twists.

The twist of a body is its mean velocity of the reference point and its angular velocity (the local null
space: director rates are omega x d). Jacobians are taken here, over the few unknowns of a body or an effect.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.momentum import stage_momentum
from natcoord_jax.assembly.response import Situation
from natcoord_jax.assembly.system import Group
from natcoord_jax.core.effect import Motion, Now
from natcoord_jax.maths.collocation import Tableau, rotate_stages
from natcoord_jax.maths.vectors import cross


def body_motion(
    start: Float[Array, "k 4 3"], twists: Float[Array, "k s 6"], h: Array, tableau: Tableau
) -> Motion:
    """Stage motion of bodies from their twists (velocity, angular velocity)."""
    velocity, spin = jnp.moveaxis(twists[..., :3], 0, 1), jnp.moveaxis(twists[..., 3:], 0, 1)
    directors = rotate_stages(h * spin[:, :, None], start[None, :, 1:], tableau)
    a = h * jnp.asarray(tableau.a, start.dtype)
    points = start[:, 0] + jnp.einsum("ij,jkc->ikc", a, velocity)
    rows = jnp.concatenate([points[:, :, None], directors], axis=2)
    rates = jnp.concatenate([velocity[:, :, None], cross(spin[:, :, None], directors)], axis=2)
    return Motion(start, rows, rates, spin)


def wrenches(
    rows: Float[Array, "s k 4 3"], torques: Float[Array, "s k 3"], motion: Motion
) -> Float[Array, "k s 6"]:
    """Force and torque about the reference point of forces on rows and torques."""
    turning = jnp.sum(cross(motion.rows[:, :, 1:], rows[:, :, 1:]), axis=2) + torques
    return jnp.moveaxis(jnp.concatenate([rows[:, :, 0], turning], axis=-1), 0, 1)


def body_balance(
    mass: Float[Array, "4 4"],
    start: Float[Array, "4 3"],
    velocity: Float[Array, "4 3"],
    twist: Float[Array, "s 6"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "s 6"]:
    """Change of momentum of one body as a wrench; a point mass keeps its directors by a unit inertia."""
    motion = body_motion(start[None], twist[None], h, tableau)
    momentum = stage_momentum(mass[None], motion.rates - velocity[None, None], tableau)
    massless = jnp.trace(mass[1:, 1:]) <= 0
    idle = jnp.where(massless, motion.spin, 0.0)
    return wrenches(momentum, idle, motion)[0]


def effect_balance(
    group: Group,
    effect,
    place: Array,
    inputs: Array,
    coordinates: Array,
    rates: Array,
    start: Float[Array, "k 4 3"],
    twists: Float[Array, "k s 6"],
    lam: Float[Array, "s m"],
    where: Situation,
    tableau: Tableau,
) -> tuple[Float[Array, "k s 6"], Float[Array, "s m"]]:
    """Impulsive wrench of one effect on its bodies, and its constraint rates."""
    motion = body_motion(start, twists, where.h, tableau)
    answer = effect.respond(place, motion, Now(where.t, where.h, inputs, coordinates, rates, tableau), lam)
    scale = 1.0 if group.effect.impulsive else where.h
    forces = jnp.zeros_like(motion.rows) if answer.forces is None else scale * answer.forces
    torques = jnp.zeros_like(motion.spin) if answer.torques is None else scale * answer.torques
    return wrenches(forces, torques, motion), answer.rows


def jacobians(
    group: Group,
    where: Situation,
    tableau: Tableau,
    start: Array,
    twists: Array,
    lam: Array,
    *,
    exact: bool = True,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivatives of `effect_balance` by twists and multipliers, of all instances; leading axis n.

    With `exact` False, those of what effects give for their linearisation.
    """

    def one(effect, place, inputs, coordinates, rates, start, twists, lam):
        if not exact:
            now = Now(where.t, where.h, inputs, coordinates, rates, tableau)
            effect = effect.linearised(place, body_motion(start, twists, where.h, tableau), now, lam)

        def f(twists, lam):
            return effect_balance(
                group, effect, place, inputs, coordinates, rates, start, twists, lam, where, tableau
            )

        return jax.jacfwd(f, argnums=(0, 1))(twists, lam)

    numbers = (group.effect, where.place, where.inputs, where.coordinates, where.rates)
    axes = (None if group.source == "mass" else 0, 0, 0, 0, 0, 0, 0, 0)
    with jax.named_scope(group.effect.kind.replace(" ", "_")):
        return jax.vmap(one, in_axes=axes)(*numbers, start, twists, lam)
