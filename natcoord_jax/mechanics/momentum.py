"""Balances of momentum and angular momentum of all bodies, their momenta, and what effects store."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.vectors import cross, skew
from natcoord_jax.mechanics.response import GroupData, StageKinematics, collect, gather, respond
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground


def inertia(system: Model, rates: Float[Array, "*s bodies 4 3"]) -> Float[Array, "*s bodies 4 3"]:
    """Rows of M v."""
    found = inertia_alone(system.mass, rates)
    return found if system.mass_between is None else found + system.mass_between.momenta(rates)


def inertia_alone(
    mass: Float[Array, "bodies 4 4"], rates: Float[Array, "*s bodies 4 3"]
) -> Float[Array, "*s bodies 4 3"]:
    """Rows of m v of each body by itself."""
    return jnp.sum(mass[:, :, :, None] * rates[..., None, :, :], axis=-2)


def wrench(
    rows: Float[Array, "s bodies 4 3"], directors: Float[Array, "#s bodies 3 3"]
) -> tuple[Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]:
    """Force and torque about the reference point of forces on rows: r_phi and sum d_i x r_i (26, 31)."""
    force, pulls = jnp.split(rows, [1], axis=2)
    return force[:, :, 0], jnp.sum(cross(directors, pulls), axis=2)


def spatial_inertia(
    mass: Float[Array, "bodies 4 4"],
    directors: Float[Array, "bodies 3 3"],
    others: Float[Array, "bodies 3 3"],
) -> Float[Array, "bodies 6 6"]:
    """What `wrench` makes, with some directors, of the momenta of bodies that move with others.

    The momenta of a body with the velocity v of its reference point and the angular velocity w, r_phi and
    r_i of M (v, w x d_i'), are the force M_phi v + w x s' and the torque s x v + (tr S - S^T) w, with
    s = e_i d_i and S = E_ij d_i d_j'. Of one configuration this is the inertia of the bodies about their
    reference points.

    Args:
        mass: of the bodies.
        directors: d_i, by which forces on rows are taken together.
        others: d_j', with which the bodies move.

    Returns:
        Matrices from (v, w) to (force, torque).
    """
    first, second = mass[:, 0, 1:, None], mass[:, 1:, 1:]
    arm, moved = jnp.sum(first * directors, axis=1), jnp.sum(first * others, axis=1)
    products = jnp.einsum("bix,bij,bjy->bxy", directors, second, others)
    unit = jnp.eye(3, dtype=mass.dtype)
    # The trace less a diagonal element is the sum of the others: about the axis of a rod nothing may cancel.
    x, y, z = jnp.unstack(jnp.diagonal(products, axis1=1, axis2=2), axis=1)
    sums = jnp.stack([y + z, x + z, x + y], axis=1)
    turning = jnp.where(unit > 0, sums[:, :, None], -jnp.swapaxes(products, 1, 2))
    force = jnp.concatenate([mass[:, 0, 0, None, None] * unit, -skew(moved)], axis=2)
    torque = jnp.concatenate([skew(arm), turning], axis=2)
    return jnp.concatenate([force, torque], axis=1)


def weighs_only(mass: Float[Array, "bodies 4 4"]) -> Bool[Array, " bodies"]:
    """Bodies with mass and no moments of inertia, whose turns nothing resists.

    Those without any mass are none of them: between two joints they turn as what hangs on them asks.
    """
    return (jnp.trace(mass[:, 1:, 1:], axis1=1, axis2=2) <= 0) & (mass[:, 0, 0] > 0)


def row_weights(mass: Float[Array, "bodies 4 4"]) -> Float[Array, "bodies 4"]:
    """Reciprocal mass of each row, so that weight times impulse squared is an energy; 0 for massless rows."""
    turning = jnp.trace(mass[:, 1:, 1:], axis1=1, axis2=2)
    sizes = jnp.stack([mass[:, 0, 0], turning, turning, turning], axis=1)
    return jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)


def least_inertias(mass: Float[Array, "bodies 4 4"]) -> Float[Array, "bodies 2"]:
    """Mass of each body and a lower bound of its moments of inertia about any axis [kg, kg m^2].

    With the central second moments E, tr E is the sum of its eigenvalues and |E| bounds the largest. A rod
    has a thousandth of tr E about its axis here, a body without moments of inertia 0.
    """
    total, first = mass[:, 0, 0], mass[:, 0, 1:]
    moved = first[:, :, None] * first[:, None, :] / jnp.where(total > 0, total, 1.0)[:, None, None]
    central = mass[:, 1:, 1:] - moved
    trace = jnp.maximum(jnp.trace(central, axis1=1, axis2=2), 0.0)
    least = trace - jnp.sqrt(jnp.sum(central**2, axis=(1, 2)))
    return jnp.stack([total, jnp.maximum(least, 1e-3 * trace)], axis=1)


def motion(mass: Float[Array, "bodies 4 4"], rates: Float[Array, "bodies 4 3"]) -> Float[Array, ""]:
    """Energy of the bodies' motion, twice, within a small factor: each row by its own mass [J]."""
    return jnp.sum(row_weights(mass)[..., None] * inertia_alone(mass, rates) ** 2)


def stage_changes(difference: Float[Array, "s bodies 4 3"], tableau: Tableau) -> Float[Array, "s bodies 4 3"]:
    """sum_j (A^-1)_ij (V_j - v_0)."""
    if tableau.stages == 1:
        return tableau.a_inverse[0][0] * difference
    return tableau.differentiated(difference)


class Balance(eqx.Module):
    """What is missing in the balances of a step, and the constraints.

    Attributes:
        force: change of momentum less impulses, by stage and body [N s].
        torque: the same about the reference points [N m s].
        size: of the terms [sqrt(J)].
        rows: rates of all constraints.
        power: of each group, without what it releases from its store (instances, s) [W].
    """

    force: Float[Array, "s bodies 3"]
    torque: Float[Array, "s bodies 3"]
    size: Float[Array, ""]
    rows: Float[Array, " rows"]
    power: list[Float[Array, "_ s"]]


def momentum_balance(
    system: Model,
    groups: Sequence[Group],
    situations: Sequence[GroupData],
    at: StageKinematics,
    velocity: Float[Array, "bodies 4 3"],
    multipliers: Sequence[Array],
    h: Float[Array, ""],
    tableau: Tableau,
) -> Balance:
    """Balances of the step (57) for a given motion, M sum_j (A^-1)_ij (V_j - v_0) - h F_i - G_i^T lambda_i.

    Args:
        system: compiled system.
        groups: that act, with their situations and multipliers.
        situations: of the groups.
        at: stage motion.
        velocity: of the rows at the start of the step.
        multipliers: of the groups, times the step (n, s, m).
        h: step [s].
        tableau: the collocation method.
    """
    momentum = inertia(system, stage_changes(at.rates[:, :-1] - velocity, tableau))
    weights = row_weights(system.mass)[..., None]
    size = jnp.sum(weights * (momentum**2 + 4 * inertia(system, velocity) ** 2))
    torque, rows, power = None, [jnp.zeros(0, velocity.dtype)], []
    for group, where, lam in zip(groups, situations, multipliers):
        answer = respond(group, where, gather(group, at), lam, tableau)
        scale = 1.0 if group.effect.impulsive else h
        if answer.forces is not None:
            forces = jnp.moveaxis(collect(group, scale * answer.forces), 1, 0)
            momentum = momentum - forces
            size = size + jnp.sum(weights * forces**2)
        if answer.torques is not None:
            turning = jnp.moveaxis(collect(group, scale * answer.torques), 1, 0)
            torque = turning if torque is None else torque + turning
            size = size + jnp.sum(weights[:, 1] * turning**2)
        rows.append(answer.rows.reshape(-1))
        power.append(answer.power if answer.released is None else answer.power - answer.released)
    force, moment = wrench(momentum, at.held[:, :-1, 1:])
    moment = moment if torque is None else moment - torque
    return Balance(force, moment, jnp.sqrt(size), jnp.concatenate(rows), power)


def group_energies(system: Model, group: Group, state: State) -> Float[Array, " n"]:
    """Stored energy of every instance of a group."""
    place, rows = group_places(system, group), rows_with_ground(state.q)[group.bodies]
    given = place, rows, state.coordinates[group.coordinates], state.rates[group.rotors]
    each = jax.vmap(lambda e, *x: e.stored(*x), (None if group.source == "mass" else 0, 0, 0, 0, 0))
    with jax.named_scope(group.effect.kind.replace(" ", "_")):
        return each(group.effect, *given)


def body_momenta(system: Model, state: State) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Momentum and angular momentum about the origin of every body (24, 32)."""
    q, v = state.rows, state.row_rates
    impulse = inertia(system, v)
    return impulse[:, 0], jnp.sum(cross(q, impulse), axis=1)
