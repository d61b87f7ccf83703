"""Numerical dissipation of fast oscillations by internal impulses, which leave all momenta alone.

Two things oscillate, strains and their rates, and each is damped by a pair of terms that vanish with the
square of the step. In the one-stage step (57) with increments d = pi_1 - pi_0 of all invariants, their rates
e = D pi(q_0) v_0 - d/h ahead of the mean, stiffnesses K = V'' at the start (at least semidefinite), the
inertia M and, with B = D pi(q_0) P on the tangent space at q_0,

    H = P^T M P + theta h^2 B^T K B,    chi = (1 - rho)/(1 + rho),

*stress*: the force -D pi(q_mid)^T chi/2 K B a with H a = theta h^2 B^T K d is added. It dissipates
chi/2 a^T H a / (theta h^2).

*rate*: before the stages the velocity jumps by P delta, H delta = -(1 - rho) theta h^2 B^T K e. That is the
impulse -D pi(q_0)^T tau of tau = theta h^2 K (e_+ - rho e), e_+ = e + B delta, whose opposite
D pi(q_mid)^T tau acts at the stage. Together the two do the work -tau.(e + e_+)/2, which is never positive.

On an oscillation of frequency omega, theta (h omega)^2 compared with 1 decides: far below, both terms are of
third order in the step, so that the scheme stays of order two; far above, strain and rate are multiplied by
-rho in a step. Velocities along the normals of constraints, the limit of infinite stiffness, are multiplied
by rho. All impulses are along D pi at one configuration: they have neither resultant nor moment.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.mechanics.kick import with_rotors
from natcoord_jax.mechanics.response import GroupData, StageKinematics, gather
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground

ONSET = 0.05
"""theta: damping sets in about omega h = theta^(-1/2) = 4.5, which is 1.4 steps a period."""

CONVEX = -1e-9
"""Smallest pivot of a stiffness, in terms of its trace, that counts as semidefinite."""


class Damped(eqx.Module):
    """What is damped in one step.

    Attributes:
        velocity: at the start of the stages.
        stresses: added to the gradients of each group; None: it is not elastic.
        work: of relations and loops in the jump of the velocity [J].
        loss: energy dissipated in the step [J].
    """

    velocity: Velocity
    stresses: tuple[Float[Array, "_ 1 _"] | None, ...]
    work: Float[Array, " c"]
    loss: Float[Array, ""]

    def started(
        self, groups: Sequence[Group], situations: Sequence[GroupData]
    ) -> tuple[Float[Array, "bodies 4 3"], list[GroupData]]:
        """Velocities of rows and situations of the groups with which the stages start."""
        moved = with_rotors(groups, situations, self.velocity.rotors)
        return self.velocity.rows, [
            where if stress is None else replace_fields(where, stress=stress)
            for where, stress in zip(moved, self.stresses)
        ]


class Damping(eqx.Module):
    """What can be damped in a step that starts from a configuration.

    Attributes:
        space: tangent space there.
        rates: of the invariants of each elastic group per unit rate of the free motions, B.
        stiffnesses: K of each elastic group.
    """

    space: TangentSpace
    rates: list[Float[Array, "u _ _"]]
    stiffnesses: list[Float[Array, "_ p p"]]

    @classmethod
    def at(cls, system: Model, state: State) -> "Damping":
        """That of a state; its velocities play no part."""
        space = TangentSpace.at(system, state)
        rows, unit = rows_with_ground(state.q), space.columns
        still = jnp.zeros((unit.shape[0], 1, *NODE), unit.dtype)
        moving = jnp.concatenate([unit, still], axis=1)
        turning = jnp.concatenate([jnp.swapaxes(space.free[1], 0, 1), still[:, :, 0]], axis=1)
        groups = [g for g in system.effects if g.effect.elastic]
        rates = [jax.vmap(partial(_instant_rates, system, g, rows))(moving, turning) for g in groups]
        return cls(space, rates, [_stiffness(system, g, rows, state.coordinates) for g in groups])

    def over(
        self, state: State, groups: Sequence[Group], at: StageKinematics, h: Array, tableau: Tableau
    ) -> Damped:
        """What is damped in a step.

        Args:
            state: at the start.
            groups: that act.
            at: stage motion.
            h: step [s].
            tableau: of the scheme.
        """
        space, rho = self.space, tableau.spectral_radius
        strength, part = ONSET * h**2, (1.0 - rho) / (1.0 + rho)
        v = Velocity(state.row_rates, state.rates)
        known = space.admissible
        assert space.system is not None and known.lift is not None and known.prescribed is not None
        w = known.frame.T @ known.within(space.framed(v)) + space.drift_rates
        along = space.projected(v)
        normal = v - along
        # Per component along the frame of what the constraints admit.
        framed = [jnp.einsum("unp,fu->fnp", b, self._admitted) for b in self.rates]
        mean = [_mean_rates(g, space.system, at, h) for g in groups if g.effect.elastic]
        ahead = [jnp.einsum("unp,u->np", b, w) - r for b, r in zip(self.rates, mean)]
        inverse = definite_inverse(jnp.eye(w.shape[0], dtype=w.dtype) + strength * self._stiffened(framed))
        a = strength * h * (inverse @ self._pulled(framed, mean))
        jump = -(1.0 - rho) * strength * (inverse @ self._pulled(framed, ahead))
        stresses, loss, pull = [], 0.0, jnp.zeros_like(w)
        for b, k, full, r, e in zip(framed, self.stiffnesses, self.rates, mean, ahead):
            viscous = 0.5 * part * _times(k, jnp.einsum("fnp,f->np", b, a))
            changed = e + jnp.einsum("fnp,f->np", b, jump)
            tau = strength * _times(k, changed - rho * e)
            stresses.append((viscous - tau / h)[:, None])
            loss = loss + h * jnp.sum(viscous * r) + 0.5 * jnp.sum(tau * (e + changed))
            pull = pull + jnp.einsum("unp,np->u", full, tau)
        kick, back = space.along(jump), 1.0 - rho
        kick = kick - back * normal
        work = known.prescribed * (known.lift.T @ (space.pulled(space.impulse(kick)) + pull))
        loss = loss + (1.0 - rho**2) * space.energy(normal)
        given = iter(stresses)
        return Damped(v + kick, tuple(next(given) if g.effect.elastic else None for g in groups), work, loss)

    @property
    def _admitted(self) -> Float[Array, "u u"]:
        """Rates of the free motions, one admitted component along the frame a row."""
        known = self.space.admissible
        return known.frame if known.subspace is None else known.subspace @ known.frame

    def _stiffened(self, framed: list[Array]) -> Float[Array, "u u"]:
        """B^T K B."""
        count = self.space.admissible.frame.shape[0]
        total = jnp.zeros((count, count), self.space.admissible.frame.dtype)
        for b, k in zip(framed, self.stiffnesses):
            total = total + jnp.einsum("fnp,npr,gnr->fg", b, k, b)
        return total

    def _pulled(self, framed: list[Array], strains: list[Array]) -> Float[Array, " u"]:
        """B^T K of strains or their rates."""
        total = jnp.zeros(self.space.admissible.frame.shape[0], self.space.admissible.frame.dtype)
        for b, k, x in zip(framed, self.stiffnesses, strains):
            total = total + jnp.einsum("fnp,np->f", b, _times(k, x))
        return total


def _times(k: Float[Array, "n p p"], x: Float[Array, "n p"]) -> Float[Array, "n p"]:
    return jnp.sum(k * x[:, None, :], axis=-1)


def _instant_rates(system: Model, group: Group, rows: Array, moving: Array, turning: Array) -> Array:
    """Rates of the invariants of a group at given rows and velocities of all bodies, shape (n, p)."""

    def one(effect, place, rows, moving, turning):
        motion = Motion(rows, rows[None], moving[None], turning[None])
        return effect.strain_rates(place, motion, jnp.zeros((), rows.dtype))[0]

    given = (x[group.bodies] for x in (rows, moving, turning))
    return jax.vmap(one)(group.effect, group_places(system, group), *given)


def _mean_rates(group: Group, system: Model, at: StageKinematics, h: Array) -> Float[Array, "n p"]:
    """Mean rates of the invariants of a group over the step."""

    def one(effect, place, start, rows, rates, spin):
        return effect.strain_rates(place, Motion(start, rows, rates, spin), h)[0]

    motion = gather(group, at)
    given = motion.start, motion.rows, motion.rates, motion.spin
    return jax.vmap(one, in_axes=(0, 0, 0, 1, 1, 1))(group.effect, group_places(system, group), *given)


def _stiffness(system: Model, group: Group, rows: Array, coordinates: Array) -> Float[Array, "n p p"]:
    """Stiffnesses of a group, zero where its energy is not convex: there nothing is damped."""

    def one(effect, place, rows, coordinates):
        k = effect.curvature(place, rows, coordinates)
        return jnp.where(_semidefinite(k), k, 0.0)

    places = group_places(system, group)
    return jax.vmap(one)(group.effect, places, rows[group.bodies], coordinates[group.coordinates])


def _semidefinite(k: Float[Array, "p p"]) -> Array:
    """Whether no pivot of an elimination is negative; false if a number is not finite."""
    least, sound = CONVEX * jnp.trace(k), jnp.isfinite(jnp.sum(k))
    for number in range(k.shape[0]):
        pivot = k[number, number]
        sound = sound & (pivot >= least)
        positive = pivot > 0
        column = jnp.where(positive, k[:, number] / jnp.where(positive, pivot, 1.0), 0.0)
        k = k - column[:, None] * k[number][None, :]
    return sound
