"""The velocities that the constraints admit at one configuration, with frames orthonormal in the mass.

Frames are functions of the configuration: P X^T with the null space P of the spanning tree and X its inverse
Cholesky factor, X P^T M P X^T = 1. Where constraints close loops, the tangents are a subspace of that.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.balances import Balances
from natcoord_jax.assembly.momentum import inertia, wrench
from natcoord_jax.assembly.rates import row_rates
from natcoord_jax.assembly.system import System
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import definite_inverse, inverse_cholesky
from natcoord_jax.maths.projectors import range_projector

POLISHING = 9
"""Newton-Schulz iterations for the direct rotation of subspaces: enough for cosines from 0.4 on."""


class Velocity(eqx.Module):
    """Velocities of all rows, and rates of the joint coordinates that carry rotors (or impulses on both)."""

    rows: Float[Array, "*u bodies 4 3"]
    rotors: Float[Array, "*u rotors"]


class Admissible(eqx.Module):
    """What the constraints admit at one configuration, in the rates of the spanning tree.

    Attributes:
        frame: X, with X P^T M P X^T = 1.
        subspace: projector on what the constraints outside the tree admit, in the frame; None: everything.
        lift: rates of the smallest energy per unit rate of the constraints.
        prescribed: rates that drives prescribe, zero for all other constraints.
    """

    frame: Float[Array, "u u"]
    subspace: Float[Array, "u u"] | None
    lift: Float[Array, "u c"]
    prescribed: Float[Array, " c"]

    def within(self, y: Float[Array, " u"]) -> Float[Array, " u"]:
        """The part of a vector in the frame that the constraints admit."""
        return y if self.subspace is None else self.subspace @ y


class TangentSpace(eqx.Module):
    """Velocities that the constraints admit at one configuration.

    Attributes:
        balances: inertia and constraints there; the null space P of the tree.
        columns: P, one free motion after the other.
        impulses: M P.
        inertias: of the rotors.
        admissible: what the constraints admit.
    """

    balances: Balances
    columns: Velocity
    impulses: Velocity
    inertias: Float[Array, " rotors"]
    admissible: Admissible

    @classmethod
    def at(cls, system: System, state: State) -> "TangentSpace":
        """The tangent space of a state; its velocities play no part."""
        balances, inertias = Balances.at(system, state), rotor_inertias(system)
        gains = balances.columns()
        columns = Velocity(gains.rows, gains.rotors)
        impulses = Velocity(inertia(system.mass, gains.rows), inertias * gains.rotors)
        unit = jnp.eye(gains.rows.shape[0], dtype=state.q.dtype)
        lift = jnp.zeros((unit.shape[0], gains.constraints.shape[1]), unit.dtype)
        plain = Admissible(unit, None, lift, jnp.zeros(lift.shape[1], unit.dtype))
        space = cls(balances, columns, impulses, inertias, plain)
        plain = replace_fields(plain, frame=inverse_cholesky(space.pulled(impulses) + _idle(balances)))
        if gains.constraints.shape[1]:
            plain = _constrained(balances, plain.frame, gains.constraints.T)
        return replace_fields(space, admissible=plain)

    def without_system(self) -> "TangentSpace":
        """What belongs to the configuration alone; `with_system` puts the rest back."""
        return eqx.tree_at(lambda space: space.balances.system, self, None)

    def with_system(self, system: System) -> "TangentSpace":
        """Ready for use."""
        return eqx.tree_at(lambda space: space.balances.system, self, system, is_leaf=lambda x: x is None)

    def framed(self, v: Velocity) -> Float[Array, " u"]:
        """Components of a velocity along the frame, X P^T M v."""
        return self.admissible.frame @ self.pulled(self.impulse(v))

    def along(self, y: Float[Array, " u"]) -> Velocity:
        """Velocity with given components along the frame."""
        return self.spread(self.admissible.frame.T @ y)

    def spread(self, w: Float[Array, " u"]) -> Velocity:
        """P w."""
        velocity, spin = self.balances.twists(w)
        return Velocity(row_rates(self.balances.rows, velocity, spin), w @ self.columns.rotors)

    def impulse(self, v: Velocity) -> Velocity:
        """M v."""
        return Velocity(inertia(self.balances.system.mass, v.rows), self.inertias * v.rotors)

    def energy(self, v: Velocity) -> Float[Array, ""]:
        """Kinetic energy [J]."""
        impulse = self.impulse(v)
        return 0.5 * (jnp.sum(impulse.rows * v.rows) + jnp.sum(impulse.rotors * v.rotors))

    def pulled(self, impulse: Velocity) -> Float[Array, "u *k"]:
        """P^T of impulses (with a leading axis: of several, to columns)."""
        rows = impulse.rows.reshape(-1, *impulse.rows.shape[-3:])
        force, torque = wrench(rows, self.balances.rows[None, :, 1:])
        velocity, spin = self.balances.free
        found = jnp.einsum("buc,kbc->uk", velocity, force) + jnp.einsum("buc,kbc->uk", spin, torque)
        if self.inertias.shape[0]:
            found = found + self.columns.rotors @ impulse.rotors.reshape(rows.shape[0], -1).T
        return found if impulse.rows.ndim == 4 else found[:, 0]

    @property
    def drift(self) -> Velocity:
        """Velocity that drives prescribe, orthogonal to all admissible ones."""
        return self.spread(self.drift_rates)

    @property
    def drift_rates(self) -> Float[Array, " u"]:
        """The same as rates of the spanning tree."""
        return self.admissible.lift @ self.admissible.prescribed

    def work(self, kick: Velocity) -> Float[Array, " c"]:
        """Work of the constraints in a kick [J], drives being the only ones that do any."""
        known = self.admissible
        return known.prescribed * (known.lift.T @ self.pulled(self.impulse(kick)))

    @property
    def inertia(self) -> Float[Array, "u u"]:
        """P^T M P."""
        return self.pulled(self.impulses)

    def shares(self, after: "TangentSpace", d: Velocity) -> tuple[Velocity, Velocity]:
        """P^_0 u and P^_1 (b_1 - 2 u - K^T u) of the kick from here to another configuration, see `kick`."""
        start, end = self.admissible, after.admissible
        cosines = start.frame @ self.pulled(after.impulses) @ end.frame.T
        b0, b1 = start.within(self.framed(d)), end.within(after.framed(d))
        if start.subspace is None or end.subspace is None:
            first, last = isometric(cosines, b0, b1)
            return self.along(first), after.along(last)
        moved = _direct_rotation(start.subspace, end.subspace)
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
        found = self.spread(w)
        lost = Velocity(v.rows - found.rows, v.rotors - found.rotors)
        return self.spread(w + known.frame.T @ known.within(self.framed(lost)))

    def normal(self, v: Velocity) -> Velocity:
        """What of a velocity is orthogonal to all that the constraints admit."""
        along = self.along(self.admissible.within(self.framed(v)))
        return Velocity(v.rows - along.rows, v.rotors - along.rotors)

    def with_momentum(self, momentum: Float[Array, " u"]) -> Velocity:
        """The admissible velocity with given momenta P^T M v; projected twice, as above."""
        known = self.admissible

        def rates(momentum: Array) -> Array:
            return known.frame.T @ known.within(known.frame @ momentum)

        w = rates(momentum) + self.drift_rates
        return self.spread(w + rates(momentum - self.pulled(self.impulse(self.spread(w)))))


def isometric(
    cosines: Float[Array, "u u"], b0: Float[Array, " u"], b1: Float[Array, " u"]
) -> tuple[Float[Array, " u"], Float[Array, " u"]]:
    """U and b_1 - 2 u - K^T u, see `kick`."""
    matrix = jnp.eye(b0.shape[0], dtype=b0.dtype) + 2.0 * cosines + cosines @ cosines.T
    u = definite_inverse(matrix) @ (cosines @ b1 - b0)
    return u, b1 - 2.0 * u - cosines.T @ u


def _direct_rotation(start: Float[Array, "u u"], end: Float[Array, "u u"]) -> Float[Array, "u u"]:
    """The smallest rotation that takes one subspace to another, from their projectors."""
    unit = jnp.eye(start.shape[0], dtype=start.dtype)
    x = end @ start + (unit - end) @ (unit - start)
    for _ in range(POLISHING):
        x = 1.5 * x - 0.5 * x @ (x.T @ x)
    return x


def rotor_inertias(system: System) -> Float[Array, " rotors"]:
    """Inertias of all rotors."""
    groups = [g for g in system.effects if g.effect.rotors]
    parts = [jax.vmap(lambda e: e.inertia_of())(g.effect) for g in groups]
    return jnp.concatenate([jnp.zeros(0, system.mass.dtype), *parts])


def _idle(balances: Balances) -> Float[Array, "u u"]:
    """A unit inertia for turns of point masses, which nothing else sees."""
    massless = jnp.trace(balances.system.mass[:, 1:, 1:], axis1=1, axis2=2) <= 0
    spin = jnp.where(massless[:, None, None], balances.free[1], 0.0)
    return jnp.einsum("buc,bwc->uw", spin, spin)


def _constrained(balances: Balances, frame: Array, matrix: Float[Array, "c u"]) -> Admissible:
    """With the constraints of loops and relations, whose rates are the matrix times those of the tree."""
    structure = balances.system.structure
    prescribed = -balances.rates(jnp.zeros(matrix.shape[1], matrix.dtype)).constraints
    framed = matrix @ frame.T
    coupling = framed @ framed.T
    if structure.rank is None:
        inverse = definite_inverse(coupling)
    else:
        # What redundant rows never reach gets a unit matrix.
        onto = range_projector(matrix, structure.rank)
        idle = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - onto
        filled = onto @ coupling @ onto + idle * jnp.trace(coupling) / matrix.shape[0]
        inverse = onto @ definite_inverse(filled) @ onto
    back = framed.T @ inverse
    subspace = jnp.eye(framed.shape[1], dtype=matrix.dtype) - back @ framed
    subspace = 0.5 * (subspace + subspace.T)
    return Admissible(frame, subspace, frame.T @ back, prescribed)
