"""Isometric kicks along the normals of the constraints, which keep velocities tangent at any order.

Collocation keeps positions on the constraints, not velocities. Before the stages the velocity v_0 gets a
normal part n_0, after them it gives it back:

    v_+ = v_0 + n_0,    v_1 = v_- - sigma U n_0,    sigma = -R(infinity),

with U an isometry (in the metric of the mass) from the normals at q_0 to those at q_1, and n_0 such that v_1
is tangent. |U n_0| = |n_0|, so the energy is untouched; normals carry neither momentum nor angular momentum.
With frames P^ of the tangents that are orthonormal in the metric, and K = P^_0^T M P^_1,

    U n = n - (P^_0 + P^_1) (1 + K^T)^-1 P^_1^T M n,

whose inverse is the same with the ends exchanged. n_0 follows without iteration from c = sum beta_i V_i,
d = sigma c - v_0, b_0 = P^_0^T M d and b_1 = P^_1^T M d:

    (1 + 2 K + K K^T) u = K b_1 - b_0,    n_0 = 1/2 (d - P^_1 (b_1 - 2 u - K^T u) + P^_0 u).

Frames are functions of the configuration: P X^T with the null space P of the spanning tree and X its inverse
Cholesky factor, X P^T M P X^T = 1. Where constraints close loops, the tangents are a subspace of that; its
basis at q_1 is that at q_0 moved by the direct rotation between the two subspaces, so that no basis has to be
chosen, and redundant constraints are no special case.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.block_tangent_space import Tangents, tangents_at, with_system
from natcoord_jax.mechanics.coordinates import stage_rates
from natcoord_jax.mechanics.frozen_kick import NEGLIGIBLE, NEGLIGIBLE_ENERGY
from natcoord_jax.mechanics.response import GroupData, StageKinematics
from natcoord_jax.mechanics.tangent_space import Velocity, driven
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.xla.tracing import traced_once

LARGEST, DRIVEN = 0.51, 2.01
"""Kinetic energy of a kick in terms of that of the motion, twice, beyond which a step is refused; and
the same where drives prescribe motions, of which those that turn back at once have 2 exactly."""

UNSOUND = 1e-11
"""Energy made by kicks in terms of that of the motion, beyond which a step is refused."""

AT_REST = 1e-9
"""Way in a step, in terms of the positions, below which a motion is too small for kicks that are unsound: of
what is held still, velocities are round-off."""


class Kick(eqx.Module):
    """The kick of a step, and what is admitted at its ends.

    Attributes:
        kick: that the stages begin with.
        before: tangent space at the start of the step.
        after: at its end.
        exact: the kick that belongs to the stages; the same, but for what is negligible.
        change: by which it differs from that which was held before, if that is not negligible [sqrt(J)].
        motion: size of the velocities at the ends [sqrt(J)].
    """

    kick: Velocity
    before: Tangents
    after: Tangents
    exact: Velocity
    change: Float[Array, ""]
    motion: Float[Array, ""]


class Ends(eqx.Module):
    """The end of a step with kicks.

    Attributes:
        velocity: v_1.
        work: of the constraints at the ends of the step, drives being the only ones that do any [J].
        sound: whether the kicks are small against the motion and leave the energy alone. Far off, where the
            tangents at the two ends are nearly orthogonal, the equations have solutions that are neither.
    """

    velocity: Velocity
    work: Float[Array, " c"]
    sound: Bool[Array, ""]


def end_of(equations: Any, at: StageKinematics) -> State:
    """Positions and time at the end of a step; nothing else of it is of use."""
    state, h, b = equations.state, equations.h, jnp.asarray(equations.tableau.b)
    q = (at.start[:-1] + h * jnp.tensordot(b, at.rates[:, :-1], 1)).reshape(-1, 3)
    return State(state.t + h, q, q, state.coordinates, state.rates, state.work)


def rotor_rates(equations: Any, at: StageKinematics) -> Float[Array, "s rotors"]:
    """Rates at the stages of the joint coordinates that carry rotors."""
    carrying = [g.coordinates[:, 0] for g in equations.groups if g.effect.rotors]
    if not carrying:
        return jnp.zeros((at.rates.shape[0], 0), at.rates.dtype)
    return stage_rates(equations.system, at, equations.h)[:, np.concatenate(carrying)]


def kick_of(equations: Any, at: StageKinematics) -> Kick:
    """The kick that belongs to given stages; that at hand where the difference is negligible."""
    system, state, tableau = equations.system, equations.state, equations.tableau
    known, lag = equations.start_cache.tangents, equations.start_cache.lag
    beta, sigma = jnp.asarray(tableau.beta), tableau.reflection
    end = end_of(equations, at)
    if known is None:
        before, after = _both(system, state, end)
    else:
        before, after = with_system(known, system), tangents_at(system, end)
    v = Velocity(state.row_rates, state.rates)
    carried = Velocity(jnp.tensordot(beta, at.rates[:, :-1], 1), beta @ rotor_rates(equations, at))
    d = sigma * (carried - after.drift) - v
    first, last = before.shares(after, d)  # pyright: ignore[reportArgumentType]  (they are of one kind)
    found = 0.5 * (d + first - last)
    if lag is None:
        nothing = jnp.zeros_like(equations.h)
        return Kick(found, before, after, found, nothing, nothing)
    change = found - lag.held
    motion = jnp.maximum(before.energy(v), before.energy(d))
    size, kick, motion = (jnp.sqrt(2.0 * x) for x in (before.energy(change), before.energy(found), motion))
    serves = (size <= NEGLIGIBLE * motion) & (size * kick <= NEGLIGIBLE_ENERGY * motion**2)
    kept = (serves & ~lag.everywhere) | lag.held_fast
    used = jax.tree.map(lambda x, y: jnp.where(kept, x, y), lag.held, found)
    return Kick(used, before, after, found, jnp.where(serves, 0.0, size), motion)


def _both(system: Model, start: State, end: State) -> tuple[Tangents, Tangents]:
    """The tangent spaces of two states by one program for both, half as long as two."""

    def at(q: Array, t: Array) -> Tangents:
        return with_system(tangents_at(system, replace_fields(end, q=q, v=q, t=t)), None)

    found = jax.vmap(at)(jnp.stack([start.q, end.q]), jnp.stack([start.t, end.t]))
    parts, structure = jax.tree.flatten(found)
    before, after = (jax.tree.unflatten(structure, x) for x in zip(*map(jnp.unstack, parts)))
    return with_system((before, after), system)


def ends_of(equations: Any, at: StageKinematics, kick: Kick) -> Ends:
    """The velocity at the end of a step: that of its stages, less the kick taken back."""
    state, tableau, before, after = equations.state, equations.tableau, kick.before, kick.after
    rates, turning = at.rates[:, :-1], rotor_rates(equations, at)
    v = Velocity(state.row_rates, state.rates)
    start = v + kick.kick
    last = start + Velocity(tableau.gained(rates - start.rows), tableau.gained(turning - start.rotors))
    end = after.projected(last)
    work = before.work(kick.kick) + after.work(end - last)
    little = jax.tree.map(
        lambda x: AT_REST * x / equations.h, Velocity(state.rows, jnp.zeros_like(state.rates))
    )
    energies = before.energy(v), before.energy(start), after.energy(last), after.energy(end)
    moving = jnp.maximum(functools.reduce(jnp.maximum, energies), before.energy(little))
    missing = energies[1] - energies[0] + energies[3] - energies[2] - jnp.sum(work)
    small = 2.0 * before.energy(kick.kick) <= (DRIVEN if driven(equations.system) else LARGEST) * moving
    return Ends(end, work, small & (jnp.abs(missing) <= UNSOUND * moving))


def kicked(equations: Any, at: StageKinematics) -> tuple[Array, Sequence[GroupData], Kick | None]:
    """What the stages begin with: velocities of rows, situations with rates of rotors; and the kick.

    Where the kick lags behind the stages and is not due, it is that which is held, and nothing else of it is
    of use.
    """
    state, situations = equations.state, equations.situations
    velocity = state.row_rates
    if not equations.tableau.kick:
        return velocity, situations, None
    found = kick_of(equations, at) if equations.start_cache.lag is None else _lagging(equations, at)
    moved = with_rotors(equations.groups, situations, state.rates + found.kick.rotors)
    return velocity + found.kick.rows, moved, found


def _lagging(equations: Any, at: StageKinematics) -> Kick:
    """The kick, found anew if it is due."""
    lag = equations.start_cache.lag

    def anew() -> Kick:
        return with_system(kick_of(equations, at), None)

    def renewed(_: tuple[Array, Kick]) -> tuple[Array, Kick]:
        return jnp.array(False), anew()

    anew, blank = traced_once(anew)
    start = eqx.tree_at(lambda found: (found.kick, found.exact), blank, (lag.held, lag.held))
    # A loop of no or one trip leaves what it carries where it is; a conditional would copy it.
    _, found = jax.lax.while_loop(lambda carry: carry[0], renewed, (lag.due, start))
    return with_system(found, equations.system)


def with_rotors(
    groups: Sequence[Group], situations: Sequence[GroupData], rotors: Float[Array, " rotors"]
) -> list[GroupData]:
    """Situations with other rates of the rotors at the start of the step."""
    return [
        replace_fields(where, rates=rotors[group.rotors]) if group.effect.rotors else where
        for group, where in zip(groups, situations)
    ]
