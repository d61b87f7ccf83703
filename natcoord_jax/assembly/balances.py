"""The equations of motion (2) at one instant: inertia, loads and constraints as functions of the unknowns.

Unknowns are the rates w' of the tree's free motions and the multipliers lambda of relations between
coordinates and of joints that close loops. With row velocities V = P(q) w and constraints c(q, V, t) = 0:

    P^T [M (P w)' - F - (dc/dV)^T lambda] = 0,    c' = 0.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.coordinates import coordinate_rates, frames_of
from natcoord_jax.assembly.diagnostics import rows_with_ground
from natcoord_jax.assembly.rates import Twists, geometry_at, row_rates, twists
from natcoord_jax.assembly.reduced import inertia, wrench
from natcoord_jax.assembly.response import gather, no_multipliers, respond, situation, stations
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.assembly.tree import JointGeometry, project
from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.vectors import cross


def with_rest(x: Float[Array, "bodies *k"]) -> Float[Array, "bodies_and_ground *k"]:
    """Velocities with those of the ground, which rests, last."""
    return jnp.concatenate([x, jnp.zeros_like(x[:1])])


def joint_constraint_rates(
    effect, frames: Array, rows: Float[Array, "2 4 3"], velocity: Array, spin: Array
) -> Float[Array, " m"]:
    """Rates of the constraints of one joint from velocities and angular velocities of its two bodies."""
    rates = row_rates(rows, velocity, spin)
    return jax.jvp(lambda x: effect.residual(*frames_at(frames, x)), (rows,), (rates,))[1]


class Gains(eqx.Module):
    """What belongs to a motion, either as rates or, one derivative higher, as accelerations.

    Attributes:
        rows: of the rows of the bodies.
        rotors: of the joint coordinates that carry rotors.
        constraints: of relations between coordinates, then of joints that close loops.
    """

    rows: Float[Array, "bodies 4 3"]
    rotors: Float[Array, " rotors"]
    constraints: Float[Array, " constraints"]


class Balances(eqx.Module):
    """Inertia and constraints of a system at given rows.

    Attributes:
        system: compiled system.
        rows: rows of all bodies.
        geometry: axes and arms of the tree's joints there.
        t: time [s].
    """

    system: System
    rows: Float[Array, "bodies 4 3"]
    geometry: list[JointGeometry]
    t: Float[Array, ""]

    @classmethod
    def at(cls, system: System, state: State) -> "Balances":
        """The balances of a state."""
        rows = state.q.reshape(-1, 4, 3)
        return cls(system, rows, geometry_at(system, rows), state.t)

    @property
    def relations(self) -> list[Group]:
        """Relations between joint coordinates, the first of the constraints."""
        return [g for g in self.system.effects if g.multipliers]

    @property
    def loops(self) -> list[Group]:
        """Joints that close loops, the last of the constraints."""
        return [g for g in self.system.joints if not g.in_tree]

    @property
    def rotors(self) -> list[Group]:
        """Rotors on joint coordinates."""
        return [g for g in self.system.effects if g.effect.rotors]

    def twists(self, w: Float[Array, " unknowns"]) -> Twists:
        """Velocities and angular velocities of all bodies from the rates of the tree's free motions."""
        return twists(self.system, self.geometry, w)

    def rates(self, rows: Array, velocity: Array, spin: Array, t: Array) -> Gains:
        """Rates of everything, affine in the velocities."""
        moving = row_rates(rows, velocity, spin)
        along = jnp.zeros(0, rows.dtype)
        extended = rows_with_ground(rows.reshape(-1, 3))
        if self.relations or self.rotors:
            along = coordinate_rates(self.system, extended, with_rest(moving), with_rest(spin))
        turning = [along[g.coordinates[:, 0]] for g in self.rotors]

        def relation(effect, index):
            wanted = jax.jvp(effect.target, (t,), (jnp.ones_like(t),))[1]
            return effect.coefficients() @ along[index] - wanted

        found = [jax.vmap(relation)(g.effect, g.coordinates) for g in self.relations]
        everywhere = extended, with_rest(velocity), with_rest(spin)
        for group in self.loops:
            pairs = [x[group.bodies] for x in everywhere]
            frames = self.system.frames[group.joints[:, 0]]
            found.append(jax.vmap(joint_constraint_rates)(group.effect, frames, *pairs).reshape(-1))
        none = [along[:0]]
        return Gains(moving, jnp.concatenate(none + turning), jnp.concatenate(none + found))

    def bias(self, w: Float[Array, " unknowns"]) -> Gains:
        """Accelerations of everything while the rates of the free motions stay as they are."""

        def composed(rows, t):
            return self.rates(rows, *twists(self.system, geometry_at(self.system, rows), w), t)

        moving = row_rates(self.rows, *self.twists(w))
        return jax.jvp(composed, (self.rows, self.t), (moving, jnp.ones_like(self.t)))[1]

    def columns(self) -> Gains:
        """Accelerations of everything per unit of w', leading axis the unknowns."""
        still = jnp.zeros_like(self.rows[:, 0])
        rest = self.rates(self.rows, still, still, self.t)

        def column(unit: Array) -> Gains:
            gains = self.rates(self.rows, *self.twists(unit), self.t)
            return jax.tree.map(jnp.subtract, gains, rest)

        return jax.vmap(column)(jnp.eye(self.system.structure.unknowns, dtype=self.rows.dtype))

    def inertial(self, gains: Gains) -> Twists:
        """Forces and torques that give bodies and rotors their accelerations."""
        impulses = inertia(self.system.mass, gains.rows)
        force, torque = (x[0] for x in wrench(impulses[None], self.rows[None, :, 1:]))
        if self.rotors:
            inertias = jnp.concatenate([jax.vmap(lambda e: e.inertia_of())(g.effect) for g in self.rotors])
            pulled = self._pull(lambda g: g.rotors, inertias * gains.rotors)
            force, torque = force + pulled[0], torque + pulled[1]
        return force, torque

    def constrained(self, lam: Float[Array, " constraints"]) -> Twists:
        """Forces and torques of relations and loops on the bodies."""
        return self._pull(lambda g: g.constraints, lam)

    def _pull(self, part: Callable[[Gains], Array], load: Array) -> Twists:
        """Forces and torques on the bodies with the power of a load on some of the rates."""
        still = jnp.zeros_like(self.rows[:, 0])

        def rates(velocity, spin):
            return part(self.rates(self.rows, velocity, spin, self.t))

        return jax.vjp(rates, still, still)[1](load)

    def project(self, force: Array, torque: Array) -> tuple[Array, Array, Array]:
        """Generalised forces of the unknowns; force and torque that each tree joint passes on."""
        return tuple(x[0] for x in project(self.system.tree, self.geometry, force[None], torque[None]))

    def reactions(
        self, force: Array, torque: Array, lam: Float[Array, " constraints"]
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
        _, forces, torques = self.project(force, torque)
        backwards = (system.tree.side[:, :1] == 1)
        gap = parent.point[:bodies] - child.point[:bodies]
        torques = jnp.where(backwards, -(torques + cross(gap, forces)), torques)
        forces = jnp.where(backwards, -forces, forces)
        rest = jnp.zeros((count - bodies, 3), forces.dtype)
        forces, torques = jnp.concatenate([forces, rest]), jnp.concatenate([torques, rest])
        position = sum(g.count for g in self.relations)
        for group in self.loops:
            size = group.count * group.multipliers
            own = lam[position : position + size].reshape(group.count, group.multipliers)
            position += size
            index, still = group.joints[:, 0], jnp.zeros((2, 3), lam.dtype)

            def one(effect, frames, rows, multipliers, still=still):
                def rate(v, spin):
                    return joint_constraint_rates(effect, frames, rows, v, spin)

                return jax.vjp(rate, still, still)[1](multipliers)

            f, n = jax.vmap(one)(group.effect, system.frames[index], extended[group.bodies], own)
            arm = child.point[index] - extended[group.bodies[:, 1], 0]
            forces = forces.at[index].set(f[:, 1])
            torques = torques.at[index].set(n[:, 1] - cross(arm, f[:, 1]))
        return forces, torques


def loads(system: System, state: State, u: Array, velocity: Array, spin: Array) -> Twists:
    """Forces and torques of all effects but rotors and relations: what they do in a step of length zero."""
    rows, tableau = state.q.reshape(-1, 4, 3), gauss(1)
    at = stations(rows, rows[None, :, 0], rows[None, :, 1:], velocity[None], spin[None])
    on_rows = jnp.zeros((rows.shape[0] + 1, 4, 3), rows.dtype)
    torques = jnp.zeros((rows.shape[0] + 1, 3), rows.dtype)
    for group in system.effects:
        if not group.effect.impulsive:
            where = situation(system, group, state, u, jnp.zeros((), rows.dtype))
            lam = no_multipliers(group, tableau, rows.dtype)
            answer = respond(group, where, gather(group, at), lam, tableau)
            if answer.forces is not None:
                on_rows = on_rows.at[group.bodies].add(answer.forces[:, 0])
            if answer.torques is not None:
                torques = torques.at[group.bodies].add(answer.torques[:, 0])
    force, torque = wrench(on_rows[None, :-1], rows[None, :, 1:])
    return force[0], torque[0] + torques[:-1]
