"""The impulses of friction at any number of contacts at once, together with those along the normals.

What friction stops changes the rates at which surfaces close, and impulses along the normals change slip, but
for what is hit in line with its centre. So contacts that push keep the rates that the law of impacts
(`natcoord_jax.maths.impact_law`) has given them: with W of normals (n) and of slip (t), impulses f of
friction come with impulses -X f along the normals, X = W_nn^+ W_nt, and act on slip by W_tt - W_tn X. Of
impulses within the cones of friction, which depend on f thereby, those are looked for that stop slip, or
oppose it: Coulomb's law with Newton's restitution. (Of several contacts nearly so: after the rounds that are
made some may be a few hundredths beyond their cones.) What is hit off its centre that law may give energy
(W. J. Stronge, Impact Mechanics, 2000); impulses stop short of that.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.maths.impact_law import held_alone, semidefinite_solution
from natcoord_jax.maths.vectors import positive_part, safe_norm, safe_sqrt

ROUNDS = 16
"""Of what friction does at all contacts at once; one or two are enough for a single contact."""

PARTING = 1e-9
"""Rate in terms of the largest before beyond which a contact without an impulse opens."""

PLANE = 1e-9
"""Determinant in terms of the square of the trace below which impulses in one direction alone change slip."""


def impulses_with_friction(
    normal: Float[Array, "c c"],
    mixed: Float[Array, "3c c"],
    tangential: Float[Array, "3c 3c"],
    rates: Float[Array, " c"],
    slip: Float[Array, "c 3"],
    held: Float[Array, "c 4"],
    friction: Float[Array, " c"],
    plastic: Float[Array, " c"],
    smooth: Float[Array, " c"],
    on: Bool[Array, " c"],
    bouncing: Bool[Array, " c"],
    room: Float[Array, " c"],
) -> tuple[Float[Array, "c 4"], Float[Array, " c"]]:
    """Impulses along the normals and of friction [N s], and their work [J].

    Args:
        normal: W_nn [1/kg].
        mixed: W_tn.
        tangential: W_tt.
        rates: of the gaps [m/s].
        slip: velocities of slip [m/s].
        held: impulses in the step already, along the normal and of friction.
        friction: mu [-].
        plastic: impulses of the law of impacts without restitution.
        smooth: those of the restitutions that are asked for, without friction.
        on: contacts that touch.
        bouncing: those that have impacts.
        room: energy that each may give [J].
    """
    pressed = jnp.where(on, positive_part(held[:, 0] + smooth), 0.0)
    change = normal @ smooth
    # What has pushed until the impact, and parts by it, does not pull.
    parting = (smooth <= 0) & (jnp.minimum(change, rates + change) > PARTING * jnp.max(jnp.abs(rates)))
    slipping = slip + (mixed @ smooth).reshape(slip.shape)
    moving = normal, mixed, tangential, slipping, held[:, 1:], pressed, friction

    def changes(holding: Array, normal: Array, mixed: Array, tangential: Array, *more: Array) -> Any:
        """X of the contacts that hold their rates, and impulses of friction with these."""
        taken = normal_changes(normal, mixed, holding)
        return taken, friction_impulses(tangential - mixed @ taken, taken, *more).reshape(-1)

    # Which of them hold is found apart from derivatives, which hold it, as `pressing_impulses` has it.
    fixed, start = jax.lax.stop_gradient(moving), bouncing & (pressed > 0) & ~parting

    def trip(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        taken, rubbing = changes(carry[0], *fixed)
        # A contact does not pull to hold its rate: it keeps the impulse that it has.
        holding = carry[0] & (fixed[5] - taken @ rubbing >= 0)
        return holding, jnp.any(holding != carry[0])

    holding = jax.lax.while_loop(lambda c: c[1], trip, (start, jnp.any(start)))[0]
    taken, rubbing = changes(holding, *moving)
    matrix = jnp.block([[normal, mixed.T], [mixed, tangential]])
    given = jnp.concatenate([rates, slip.reshape(-1)])
    safe, wanted = jnp.pad(plastic, (0, rubbing.size)), jnp.concatenate([smooth - taken @ rubbing, rubbing])
    found = without_gain(matrix, given, safe, wanted, jnp.sum(room))
    done = found * (given + 0.5 * matrix @ found)
    both, count = jnp.stack([found, done]), rates.shape[0]
    each = jnp.concatenate([both[:, :count, None], both[:, count:].reshape(2, count, 3)], axis=2)
    return each[0], jnp.sum(each[1], axis=1)


def normal_changes(
    normal: Float[Array, "c c"], mixed: Float[Array, "3c c"], holding: Bool[Array, " c"]
) -> Float[Array, "c 3c"]:
    """X: what impulses of friction take from those along the normals of contacts that hold their rates.

    Args:
        normal: W_nn [1/kg].
        mixed: W_tn.
        holding: contacts that do.
    """
    right = jnp.where(holding[:, None], mixed.T, 0.0)
    return semidefinite_solution(held_alone(normal, holding), right)


def without_friction(
    normal: Float[Array, "c c"],
    mixed: Float[Array, "3c c"],
    held: Float[Array, "c 4"],
    active: Bool[Array, " c"],
) -> Float[Array, " c"]:
    """Impulses along the normals that would have closed the gaps in a step without friction [N s].

    Args:
        normal: W_nn [1/kg].
        mixed: W_tn.
        held: impulses that have done so with friction, along the normal and of friction.
        active: contacts whose gaps these closed.
    """
    return held[:, 0] + normal_changes(normal, mixed, active) @ held[:, 1:].reshape(-1)


def friction_impulses(
    matrix: Float[Array, "3c 3c"],
    taken: Float[Array, "c 3c"],
    slip: Float[Array, "c 3"],
    held: Float[Array, "c 3"],
    pressed: Float[Array, " c"],
    friction: Float[Array, " c"],
) -> Float[Array, "c 3"]:
    """Impulses that stop slip as far as friction can [N s].

    Args:
        matrix: W_tt - W_tn X [1/kg].
        taken: X, see `normal_changes`.
        slip: velocities of slip [m/s].
        held: impulses of friction in the step already.
        pressed: impulses along the normals.
        friction: mu [-].
    """
    count, number = pressed.shape[0], jnp.arange(pressed.shape[0])
    own = matrix.reshape(count, 3, count, 3)[number, :, number]
    slope = taken.reshape(count, count, 3)[number, number]
    trace = jnp.trace(own, axis1=1, axis2=2)
    # Of the block, in the plane of slip: two of its three principal values.
    product = 0.5 * (trace**2 - jnp.sum(own**2, axis=(1, 2)))
    plane = product > PLANE * trace**2
    length = jnp.where(trace > 0, 1.0 / jnp.where(trace > 0, trace, 1.0), 0.0)
    over = jnp.where(plane, 1.0 / jnp.where(plane, product, 1.0), 0.0)
    size = safe_norm(held)
    reach = size + friction * jnp.sum(slope * held, axis=1)

    def trip(_: Array, found: Float[Array, "c 3"]) -> Float[Array, "c 3"]:
        moving = slip + (matrix @ found.reshape(-1)).reshape(count, 3)
        total = held + found
        turned = trace[:, None] * moving - jnp.sum(own * moving[:, None], axis=2)
        stopping = jnp.where(plane[:, None], over[:, None] * turned, length[:, None] * moving)
        sticking = total - stopping
        # What the contact's own friction leaves of the impulse along its normal.
        alone = pressed - taken @ found.reshape(-1) + jnp.sum(slope * total, axis=1)
        most = friction * positive_part(alone - jnp.sum(slope * sticking, axis=1))
        sticks = jnp.sum(sticking**2, axis=1) <= most**2
        # What has opposed slip in the step stays, as far as the cone goes; more opposes what is left of it.
        # (Quotients only where they count: what decays in open contacts is no divisor.)
        limit, reached = friction * positive_part(alone), jnp.maximum(reach, 0.1 * size)
        part = limit / jnp.where((limit > 0) & (limit < reached), reached, 1.0)
        kept = jnp.where((limit > 0) & (limit >= reached), 1.0, part)
        wanted = total - kept[:, None] * held - 2.0 * length[:, None] * moving
        beyond, far = positive_part(limit - kept * reach), safe_norm(wanted)
        along = wanted / jnp.where((beyond > 0) & (far > 0), far, 1.0)[:, None]
        less = 1.0 + friction * jnp.sum(slope * along, axis=1)
        # (Where friction would press more than it takes, as a jamming rod does, it grows step by step.)
        more = beyond / jnp.where(less > 0.1, less, 1.0)
        change = jnp.where(sticks[:, None], sticking, kept[:, None] * held + more[:, None] * along) - total
        falls = -jnp.sum(moving * change)
        needed = change.reshape(-1) @ (matrix @ change.reshape(-1))
        short = (falls > 0) & (needed > falls)
        return found + jnp.where(short, falls / jnp.where(short, needed, 1.0), 1.0) * change

    return jax.lax.fori_loop(0, ROUNDS, trip, jnp.zeros_like(held))


def without_gain(
    matrix: Float[Array, "m m"],
    rates: Float[Array, " m"],
    safe: Float[Array, " m"],
    wanted: Float[Array, " m"],
    room: Float[Array, ""],
) -> Float[Array, " m"]:
    """The impulses that are wanted, or that part of the way to them from safe ones at which energy is kept.

    Args:
        matrix: W of all impulses [1/kg].
        rates: of what they do work on [m/s].
        safe: impulses that take energy [N s].
        wanted: those that are wanted.
        room: energy that they may give [J].
    """
    change = wanted - safe
    pushed = matrix @ safe
    given = safe @ (rates + 0.5 * pushed)
    slope, curvature = change @ (rates + pushed), change @ (matrix @ change)
    too_much = given + slope + 0.5 * curvature > room
    left = positive_part(room - given)
    curved = jnp.where(too_much & (curvature > 0), curvature, 1.0)
    part = (safe_sqrt(slope**2 + 2.0 * curvature * left) - slope) / curved
    return safe + jnp.where(too_much, jnp.clip(part, 0.0, 1.0), 1.0) * change
