"""The velocities that the constraints admit at one configuration, with frames orthonormal in the mass.

Frames are functions of the configuration: P X^T with the null space P of the spanning tree and X its inverse
Cholesky factor, X P^T M P X^T = 1. Where constraints close loops, the tangents are a subspace of that.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import inverse_cholesky
from natcoord_jax.maths.projectors import direct_rotation, isometric, pseudo_inverse, range_projector
from natcoord_jax.mechanics.equations_of_motion import (
    Accelerations,
    EquationsOfMotion,
    loops_of,
    relations_of,
    rotor_inertias,
)
from natcoord_jax.mechanics.momentum import inertia, spatial_inertia, weighs_only, wrench
from natcoord_jax.mechanics.redundancy import RANK, least_change
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import row_rates


class Velocity(eqx.Module):
    """Velocities of all rows, and rates of the joint coordinates that carry rotors (or impulses on both)."""

    rows: Float[Array, "*u bodies 4 3"]
    rotors: Float[Array, "*u rotors"]

    def __add__(self, other: "Velocity") -> "Velocity":
        return Velocity(self.rows + other.rows, self.rotors + other.rotors)

    def __sub__(self, other: "Velocity") -> "Velocity":
        return Velocity(self.rows - other.rows, self.rotors - other.rotors)

    def __rmul__(self, factor: Any) -> "Velocity":
        return Velocity(factor * self.rows, factor * self.rotors)


class Admissible(eqx.Module):
    """What the constraints admit at one configuration, in the rates of the spanning tree.

    Attributes:
        frame: X, with X P^T M P X^T = 1.
        subspace: projector on what the constraints outside the tree admit, in the frame; None: everything.
        lift: rates of the smallest energy per unit rate of the constraints; None: not asked for.
        prescribed: rates that drives prescribe, zero for all other constraints; None: not asked for.
        range: projector on the range of the constraints' rates; None: they are independent.
    """

    frame: Float[Array, "u u"]
    subspace: Float[Array, "u u"] | None
    lift: Float[Array, "u c"] | None
    prescribed: Float[Array, " c"] | None
    range: Float[Array, "c c"] | None = None

    def within(self, y: Float[Array, " u"]) -> Float[Array, " u"]:
        """The part of a vector in the frame that the constraints admit."""
        return y if self.subspace is None else self.subspace @ y


class TangentSpace(eqx.Module):
    """Velocities that the constraints admit at one configuration.

    Attributes:
        system: whose tangents they are, None while they are carried along.
        rows: of the bodies.
        free: the null space P of the tree: velocities and angular velocities of the bodies per unit rate of
            each free motion.
        turning: the same of the rotors.
        inertias: of the rotors.
        admissible: what the constraints admit.
    """

    system: Model | None
    rows: Float[Array, "bodies 4 3"]
    free: tuple[Float[Array, "bodies u 3"], Float[Array, "bodies u 3"]]
    turning: Float[Array, "u rotors"]
    inertias: Float[Array, " rotors"]
    admissible: Admissible

    @classmethod
    def at(cls, system: Model, state: State, lifted: bool = True) -> "TangentSpace":
        """The tangent space of a state; its velocities play no part.

        Args:
            system: compiled system.
            state: where.
            lifted: whether impulses of the constraints are of interest, too.
        """
        balances = EquationsOfMotion.at(system, state)
        gains = balances.columns()
        space, own = cls.without_frame(balances, gains)
        # Symmetric but for rounding, which would otherwise enter the frame with the same sign in every step.
        frame = inverse_cholesky(0.5 * (own + own.T))
        return replace_fields(space, admissible=_admissible(balances, frame, gains.constraints.T, lifted))

    @classmethod
    def without_frame(
        cls, balances: EquationsOfMotion, gains: Accelerations
    ) -> tuple["TangentSpace", Float[Array, "u u"]]:
        """The tangents of the tree alone, with a unit matrix for a frame, and their inertia.

        Args:
            balances: where.
            gains: the columns of these.
        """
        system = balances.system
        unit = jnp.eye(gains.rows.shape[0], dtype=balances.rows.dtype)
        plain = Admissible(unit, None, None, None)
        inertias = rotor_inertias(system)
        space = cls(system, balances.rows, balances.free, gains.rotors, inertias, plain)
        # A unit inertia for turns of point masses, which nothing else sees.
        massless = weighs_only(system.mass)
        return space, space.coupled(space, idle=jnp.where(massless, 1.0, 0.0))

    def framed(self, v: Velocity) -> Float[Array, " u"]:
        """Components of a velocity along the frame, X P^T M v."""
        return self.admissible.frame @ self.pulled(self.impulse(v))

    def answers(
        self, forces: Float[Array, "n k 4 3"], bodies: Int[np.ndarray, "n k"]
    ) -> tuple[Float[Array, "n u"], Float[Array, "n c"]]:
        """The same of impulses on the rows of few bodies each, and their work on what drives prescribe.

        The ground, whose number is last, does not answer. The work [J] is that of each impulse on the motion
        that each constraint asks for; the opposite is done by what drives.
        """
        none = jnp.zeros((bodies.shape[0], *self.rows.shape), forces.dtype)
        rows = none.at[np.arange(bodies.shape[0])[:, None], bodies].add(forces, mode="drop")
        still = jnp.zeros((bodies.shape[0], self.turning.shape[1]), forces.dtype)
        pulled = jax.vmap(self.pulled)(Velocity(rows, still))
        known, none = self.admissible, jnp.zeros((bodies.shape[0], 0), forces.dtype)
        answers = jax.vmap(lambda x: known.within(known.frame @ x))(pulled)
        if known.lift is None or known.prescribed is None:
            return answers, none
        return answers, (pulled @ known.lift) * known.prescribed

    def along(self, y: Float[Array, " u"]) -> Velocity:
        """Velocity with given components along the frame."""
        return self.spread(self.admissible.frame.T @ y)

    def spread(self, w: Float[Array, " u"]) -> Velocity:
        """P w."""
        velocity, spin = (jnp.einsum("buc,u->bc", x, w) for x in self.free)
        return Velocity(row_rates(self.rows, velocity, spin), w @ self.turning)

    @property
    def columns(self) -> Float[Array, "u bodies 4 3"]:
        """Rates of the rows per unit rate of each free motion."""
        return jax.vmap(row_rates, in_axes=(None, 1, 1))(self.rows, *self.free)

    def generalised(self, force: Float[Array, "bodies 3"], torque: Float[Array, "bodies 3"]) -> Array:
        """Generalised forces of the free motions from forces and torques at the reference points."""
        velocity, spin = self.free
        return jnp.einsum("buc,bc->u", velocity, force) + jnp.einsum("buc,bc->u", spin, torque)

    def impulse(self, v: Velocity) -> Velocity:
        """M v."""
        assert self.system is not None
        return Velocity(inertia(self.system, v.rows), self.inertias * v.rotors)

    def energy(self, v: Velocity) -> Float[Array, ""]:
        """Kinetic energy [J]."""
        impulse = self.impulse(v)
        return 0.5 * (jnp.sum(impulse.rows * v.rows) + jnp.sum(impulse.rotors * v.rotors))

    def pulled(self, impulse: Velocity) -> Float[Array, " u"]:
        """P^T of impulses."""
        force, torque = wrench(impulse.rows[None], self.rows[None, :, 1:])
        return self.generalised(force[0], torque[0]) + self.turning @ impulse.rotors

    @property
    def drift(self) -> Velocity:
        """Velocity that drives prescribe, orthogonal to all admissible ones."""
        return self.spread(self.drift_rates)

    @property
    def drift_rates(self) -> Float[Array, " u"]:
        """The same as rates of the spanning tree."""
        known = self.admissible
        if known.lift is None or known.prescribed is None:
            return jnp.zeros(known.frame.shape[0], known.frame.dtype)
        return known.lift @ known.prescribed

    def work(self, kick: Velocity) -> Float[Array, " c"]:
        """Work of the constraints in a kick [J], drives being the only ones that do any.

        Empty where impulses of the constraints are not asked for.
        """
        known = self.admissible
        if known.lift is None or known.prescribed is None:
            return jnp.zeros(0, kick.rows.dtype)
        return known.prescribed * (known.lift.T @ self.pulled(self.impulse(kick)))

    @property
    def inertia(self) -> Float[Array, "u u"]:
        """P^T M P."""
        return self.coupled(self)

    def coupled(
        self, other: "TangentSpace", idle: Float[Array, " bodies"] | None = None
    ) -> Float[Array, "u u"]:
        """P_0^T M P_1 with the null space of another configuration.

        Args:
            other: that.
            idle: inertias of the bodies against all turns, in addition.
        """
        assert self.system is not None
        bodies = spatial_inertia(self.system.mass, self.rows[:, 1:], other.rows[:, 1:])
        if idle is not None:
            turning = jnp.diag(jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
            bodies = bodies + idle[:, None, None] * turning
        momenta = jnp.einsum("bij,bju->biu", bodies, other.motions)
        found = jnp.einsum("biu,biw->uw", self.motions, momenta)
        if self.system.mass_between is not None:
            between = self.system.mass_between.momenta(other.columns)
            found = found + jnp.einsum("ubjc,wbjc->uw", self.columns, between)
        if self.inertias.shape[0]:
            found = found + (self.turning * self.inertias) @ other.turning.T
        return found

    @property
    def motions(self) -> Float[Array, "bodies 6 u"]:
        """Velocities and angular velocities of the bodies per unit rate of each free motion."""
        return jnp.concatenate([jnp.swapaxes(x, 1, 2) for x in self.free], axis=1)

    def shares(self, after: "TangentSpace", d: Velocity) -> tuple[Velocity, Velocity]:
        """P^_0 u and P^_1 (b_1 - 2 u - K^T u) of the kick from here to another configuration, see `kick`."""
        start, end = self.admissible, after.admissible
        cosines = start.frame @ self.coupled(after) @ end.frame.T
        b0, b1 = start.within(self.framed(d)), end.within(after.framed(d))
        if start.subspace is None or end.subspace is None:
            first, last = isometric(cosines, b0, b1)
            return self.along(first), after.along(last)
        moved = direct_rotation(start.subspace, end.subspace)
        cosines = start.subspace @ cosines @ moved @ start.subspace
        first, last = isometric(cosines, b0, moved.T @ b1)
        return self.along(first), after.along(moved @ last)

    def projected(self, v: Velocity) -> Velocity:
        """Nearest velocity that the constraints admit.

        The frame is orthonormal to round-off, and its error nearly the same in every step: momenta would
        change steadily. What the first projection lost is projected once more.
        """
        known = self.admissible
        w = known.frame.T @ known.within(self.framed(v)) + self.drift_rates
        return self.spread(w + known.frame.T @ known.within(self.framed(v - self.spread(w))))

    def normal(self, v: Velocity) -> Velocity:
        """What of a velocity is orthogonal to all that the constraints admit."""
        return v - self.along(self.admissible.within(self.framed(v)))

    def with_momentum(self, momentum: Float[Array, " u"]) -> Velocity:
        """The admissible velocity with given momenta P^T M v; projected twice, as above."""
        known = self.admissible

        def rates(momentum: Array) -> Array:
            return known.frame.T @ known.within(known.frame @ momentum)

        w = rates(momentum) + self.drift_rates
        return self.spread(w + rates(momentum - self.pulled(self.impulse(self.spread(w)))))


def prescribing(system: Model) -> np.ndarray:
    """Which of the constraints of relations and loops prescribe motions."""
    groups = (*relations_of(system), *loops_of(system))
    parts = [np.full(g.count * g.multipliers, g.effect.works) for g in groups]
    return np.concatenate([np.zeros(0, bool), *parts])


def driven(system: Model) -> bool:
    """Whether constraints prescribe motions."""
    return bool(np.any(prescribing(system)))


def _admissible(
    balances: EquationsOfMotion, frame: Array, matrix: Float[Array, "c u"], lifted: bool
) -> Admissible:
    """What constraints of loops and relations admit, whose rates are the matrix times those of the tree."""
    if not matrix.shape[0]:
        lift, none = jnp.zeros((matrix.shape[1], 0), matrix.dtype), jnp.zeros(0, matrix.dtype)
        return Admissible(frame, None, *((lift, none) if lifted else (None, None)))
    framed, unit = frame @ matrix.T, jnp.eye(matrix.shape[1], dtype=matrix.dtype)
    rank, onto, reached, least = balances.system.structure.rank, None, framed, None
    if rank is None:
        rank = matrix.shape[0]
    else:
        # Only where constraints hold is that their rank. Elsewhere the weakest direction has to be left out,
        # and that among the constraints first: then the choice matters to second order only.
        onto = range_projector(matrix, rank, least_change(balances.system))
        reached = framed @ onto
        if not balances.system.structure.redundant:
            least = RANK * jnp.linalg.norm(reached)
    forbidden = range_projector(reached, rank, least)
    subspace = unit - 0.5 * (forbidden + forbidden.T)
    if not lifted:
        return Admissible(frame, subspace, None, None, onto)
    prescribed = -balances.rates(jnp.zeros(matrix.shape[1], matrix.dtype)).constraints
    lift = frame.T @ pseudo_inverse(reached, forbidden, rank).T
    return Admissible(frame, subspace, lift, prescribed, onto)
