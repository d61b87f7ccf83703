"""The equations of motion (2) at one instant: inertia, loads and constraints as functions of the unknowns.

Unknowns are the rates w' of the tree's free motions and the multipliers lambda of relations between
coordinates and of joints that close loops. With row velocities V = P(q) w and constraints c(q, V, t) = 0:

    P^T [M (P w)' - F - (dc/dV)^T lambda] = 0,    c' = 0.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.coordinates import coordinate_rates, frames_of
from natcoord_jax.mechanics.momentum import inertia, wrench
from natcoord_jax.mechanics.rates import Twists, null_space, passed_on, twists
from natcoord_jax.mechanics.response import gather, no_multipliers, respond, situation, stations
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, row_rates, rows_with_ground


def with_rest(x: Float[Array, "bodies *k"]) -> Float[Array, "bodies_and_ground *k"]:
    """Velocities with those of the ground, which rests, last."""
    return jnp.concatenate([x, jnp.zeros_like(x[:1])])


def relations_of(system: Model) -> list[Group]:
    """Relations between joint coordinates and constraints on markers, the first of the constraints."""
    return [g for g in system.effects if g.holds]


def drives_of(system: Model) -> list[Group]:
    """Relations between joint coordinates that prescribe motions."""
    return [g for g in relations_of(system) if g.effect.works and g.source == "coordinates"]


def loops_of(system: Model) -> list[Group]:
    """Joints that close loops, the last of the constraints."""
    return [g for g in system.joints if not g.in_tree]


def rotors_of(system: Model) -> list[Group]:
    """Rotors on joint coordinates."""
    return [g for g in system.effects if g.effect.rotors]


def rotor_inertias(system: Model) -> Float[Array, " rotors"]:
    """Inertias of all rotors."""
    parts = [jax.vmap(lambda e: e.inertia_of())(g.effect) for g in rotors_of(system)]
    return jnp.concatenate([jnp.zeros(0, system.mass.dtype), *parts])


def relative_rates(
    system: Model,
    rows: Float[Array, "bodies 4 3"],
    velocity: Float[Array, "bodies_and_ground 3"],
    spin: Float[Array, "bodies_and_ground 3"],
    t: Float[Array, ""],
) -> tuple[Float[Array, " rotors"], Float[Array, " c"]]:
    """Rates of rotors and of the constraints of relations and loops, affine in the velocities."""
    relations, rotors = relations_of(system), rotors_of(system)
    extended = rows_with_ground(rows.reshape(-1, 3))
    along = jnp.zeros(0, rows.dtype)
    if rotors or any(g.source == "coordinates" for g in relations):
        along = coordinate_rates(system, extended, row_rates(extended, velocity, spin), spin)
    turning = [along[g.coordinates[:, 0]] for g in rotors]

    def relation(effect, index):
        wanted = jax.jvp(effect.target, (t,), (jnp.ones_like(t),))[1]
        return effect.coefficients() @ along[index] - wanted

    def constraint(effect, place, rows, velocity, spin):
        return effect.violation_rate(place, rows, row_rates(rows, velocity, spin), spin, t, 1.0)

    found = []
    for group in (*relations, *loops_of(system)):
        if group.source == "coordinates":
            found.append(jax.vmap(relation)(group.effect, np.asarray(group.coordinates)))
        else:
            here = (x[group.bodies] for x in (extended, velocity, spin))
            rates = jax.vmap(constraint)(group.effect, group_places(system, group), *here)
            found.append(rates.reshape(-1))
    none = [along[:0]]
    return jnp.concatenate(none + turning), jnp.concatenate(none + found)


UnitLoads = tuple[Float[Array, "c bodies_and_ground 3"], Float[Array, "c bodies_and_ground 3"]]
"""Forces and torques on all bodies, by what they belong to."""


class Accelerations(eqx.Module):
    """What belongs to a motion, either as rates or, one derivative higher, as accelerations.

    Attributes:
        rows: of the rows of the bodies.
        rotors: of the joint coordinates that carry rotors.
        constraints: of relations between coordinates and between markers, then of joints that close loops.
    """

    rows: Float[Array, "*u bodies 4 3"]
    rotors: Float[Array, "*u rotors"]
    constraints: Float[Array, "*u constraints"]


class EquationsOfMotion(eqx.Module):
    """Inertia and constraints of a system at given rows.

    Attributes:
        system: compiled system.
        rows: rows of all bodies.
        t: time [s].
        free: velocities and angular velocities of the bodies per unit rate of each free motion.
    """

    system: Model
    rows: Float[Array, "bodies 4 3"]
    t: Float[Array, ""]
    free: tuple[Float[Array, "bodies unknowns 3"], Float[Array, "bodies unknowns 3"]]

    @classmethod
    def at(cls, system: Model, state: State) -> "EquationsOfMotion":
        """The balances of a state."""
        return cls(system, state.rows, state.t, null_space(system, state.rows))

    @property
    def unit_loads(self) -> tuple[UnitLoads, UnitLoads]:
        """Forces and torques of unit multipliers of rotors and of constraints, on the ground last.

        Derivatives of their rates by the velocities and by the angular velocities of the bodies.
        """
        still = jnp.zeros((self.rows.shape[0] + 1, 3), self.rows.dtype)

        def rates(velocity, spin):
            return relative_rates(self.system, self.rows, velocity, spin, self.t)

        return jax.jacfwd(rates, argnums=(0, 1))(still, still)

    def twists(self, w: Float[Array, " unknowns"]) -> Twists:
        """Velocities and angular velocities of all bodies from the rates of the tree's free motions."""
        velocity, spin = self.free
        return jnp.einsum("buc,u->bc", velocity, w), jnp.einsum("buc,u->bc", spin, w)

    def rates(self, w: Float[Array, " unknowns"]) -> Accelerations:
        """Rates of everything."""
        velocity, spin = self.twists(w)
        moving = row_rates(self.rows, velocity, spin)
        relative = relative_rates(self.system, self.rows, with_rest(velocity), with_rest(spin), self.t)
        return Accelerations(moving, *relative)

    def bias(self, w: Float[Array, " unknowns"]) -> Accelerations:
        """Accelerations of everything while the rates of the free motions stay as they are."""

        def composed(rows, t):
            velocity, spin = twists(self.system, rows, w)
            relative = relative_rates(self.system, rows, with_rest(velocity), with_rest(spin), t)
            return Accelerations(row_rates(rows, velocity, spin), *relative)

        moving = row_rates(self.rows, *self.twists(w))
        return jax.jvp(composed, (self.rows, self.t), (moving, jnp.ones_like(self.t)))[1]

    def columns(self) -> Accelerations:
        """Accelerations of everything per unit of w', leading axis the unknowns."""
        velocity, spin = self.free
        at_rest = jnp.zeros_like(velocity[:, 0])

        def relative(velocity: Array, spin: Array) -> tuple[Array, Array]:
            return relative_rates(self.system, self.rows, with_rest(velocity), with_rest(spin), self.t)

        def column(velocity: Array, spin: Array) -> Accelerations:
            # Of what drives prescribe nothing: one motion of the tree at a time, of which there are fewer
            # than velocities of bodies.
            found = jax.jvp(relative, (at_rest, at_rest), (velocity, spin))[1]
            return Accelerations(row_rates(self.rows, velocity, spin), *found)

        return jax.vmap(column, in_axes=1)(velocity, spin)

    def inertial(self, gains: Accelerations) -> Twists:
        """Forces and torques that give bodies and rotors their accelerations."""
        impulses = inertia(self.system, gains.rows)
        force, torque = (x[0] for x in wrench(impulses[None], self.rows[None, :, 1:]))
        if rotors_of(self.system):
            pulled = _weighted(rotor_inertias(self.system) * gains.rotors, self.unit_loads[0])
            force, torque = force + pulled[0], torque + pulled[1]
        return force, torque

    def constrained(self, lam: Float[Array, " c"]) -> Twists:
        """Forces and torques of relations and loops on the bodies."""
        return _weighted(lam, self.unit_loads[1])

    def project(self, force: Array, torque: Array) -> Float[Array, " unknowns"]:
        """Generalised forces of the free motions from forces and torques at the reference points."""
        velocity, spin = self.free
        return jnp.einsum("buc,bc->u", velocity, force) + jnp.einsum("buc,bc->u", spin, torque)

    def reactions(
        self, force: Array, torque: Array, lam: Float[Array, " c"]
    ) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Reactions of all joints on their children about the joints' points.

        Args:
            force: inertial less applied forces on all bodies, those of relations and loops included [N].
            torque: the same about the reference points [N m].
            lam: multipliers of relations and loops.
        """
        system, bodies = self.system, self.rows.shape[0]
        count = len(system.structure.joints)
        extended = rows_with_ground(self.rows.reshape(-1, 3))
        parent, child = frames_of(system, jnp.arange(count), extended)
        forces, torques = passed_on(system, self.rows, force, torque)
        backwards = system.tree.side[:, :1] == 1
        gap = parent.point[:bodies] - child.point[:bodies]
        torques = jnp.where(backwards, -(torques + cross(gap, forces)), torques)
        forces = jnp.where(backwards, -forces, forces)
        rest = jnp.zeros((count - bodies, 3), forces.dtype)
        forces, torques = jnp.concatenate([forces, rest]), jnp.concatenate([torques, rest])
        position = sum(g.count * g.multipliers for g in relations_of(system))
        for group in loops_of(system):
            size = group.count * group.multipliers
            here = slice(position, position + size)
            position += size
            body = jnp.repeat(group.bodies[:, 1], group.multipliers)
            shares = [lam[here, None] * x[here][jnp.arange(size), body] for x in self.unit_loads[1]]
            f, n = (x.reshape(group.count, group.multipliers, 3).sum(1) for x in shares)
            index = group.joints[:, 0]
            arm = child.point[index] - extended[group.bodies[:, 1], 0]
            forces = forces.at[index].set(f)
            torques = torques.at[index].set(n - cross(arm, f))
        return forces, torques


def constraint_matrix(system: Model, state: State) -> Float[Array, "c unknowns"]:
    """Rates of relations and loops per unit rate of each free motion of the tree."""
    return EquationsOfMotion.at(system, state).columns().constraints.T


def _weighted(lam: Array, loads: tuple[Array, Array]) -> Twists:
    """Sum of unit loads on the bodies, without the ground."""
    return jnp.tensordot(lam, loads[0][:, :-1], 1), jnp.tensordot(lam, loads[1][:, :-1], 1)


def loads(
    system: Model,
    state: State,
    u: Array,
    velocity: Array,
    spin: Array,
    acting: Sequence[tuple[Group, Array]] | None = None,
) -> Twists:
    """Forces and torques of groups with multipliers: what they do in a step of length zero.

    By default those of all effects but rotors and relations.
    """
    rows, tableau = state.rows, gauss(1)
    if acting is None:
        effects = (g for g in system.effects if not g.effect.impulsive)
        acting = [(g, no_multipliers(g, tableau, rows.dtype)) for g in effects]
    at = stations(rows, rows[None, :, 0], rows[None, :, 1:], velocity[None], spin[None])
    on_rows = jnp.zeros((rows.shape[0] + 1, *NODE), rows.dtype)
    torques = jnp.zeros((rows.shape[0] + 1, 3), rows.dtype)
    for group, lam in acting:
        where = situation(system, group, state, u, jnp.zeros((), rows.dtype))
        answer = respond(group, where, gather(group, at), lam, tableau)
        if answer.forces is not None:
            on_rows = on_rows.at[group.bodies].add(answer.forces[:, 0])
        if answer.torques is not None:
            torques = torques.at[group.bodies].add(answer.torques[:, 0])
    force, torque = wrench(on_rows[None, :-1], rows[None, :, 1:])
    return force[0], torque[0] + torques[:-1]
