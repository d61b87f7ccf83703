"""The equations of motion at one instant (2): accelerations, reactions and multipliers of a state.

Unknowns are the rates w' of the tree's free motions and the multipliers of loops and relations, with
row velocities V = P(q) w and their constraints c(q, w, t) = 0:

    P^T [M (P w)' - F - (dc/dV)^T lambda] = 0,    c' = 0.

Effects are asked what they do in a step of length zero. Reactions of the tree's joints are what the
balance of each subtree leaves to its joint. Velocities are first projected on the constraints, which the
energy-momentum step keeps in position only.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.coordinates import coordinate_rates
from natcoord_jax.assembly.diagnostics import rows_with_ground, states_of
from natcoord_jax.assembly.reduced import inertia, wrench
from natcoord_jax.assembly.redundant import least_reactions
from natcoord_jax.assembly.response import gather, no_multipliers, respond, situation, stations
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.assembly.tree import JointGeometry, gather_slots, joint_rates, project, sweep_motion, tangent
from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import angular_velocity
from natcoord_jax.maths.vectors import cross

Twists = tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]
"""Velocities of the reference points [m/s] and angular velocities [rad/s]; or forces [N] and torques [N m]."""


class Instant(eqx.Module):
    """What the equations of motion say at one time, or along a trajectory.

    Attributes:
        accelerations: second time derivatives of the rows [m/s^2 for points, 1/s^2 for directors].
        forces: reaction force of each joint on its child [N], world components.
        torques: reaction torque of each joint on its child about the joint's point on the child [N m].
        multipliers: generalised forces of relations between coordinates [N m or N] and multipliers of the
            joints that close loops, by name.
    """

    accelerations: Float[Array, "*t rows 3"]
    forces: Float[Array, "*t joints 3"]
    torques: Float[Array, "*t joints 3"]
    multipliers: dict[str, Float[Array, "*t m"]]


def geometry_at(system: System, rows: Float[Array, "bodies 4 3"]) -> list[JointGeometry]:
    """Axes and arms of the tree's joints at given rows."""
    slots = gather_slots(system.tree, jnp.zeros((1, system.structure.unknowns), rows.dtype))
    frames = system.tree.frames(system.frames)
    return sweep_motion(system.tree, frames, rows, slots, jnp.zeros((), rows.dtype), gauss(1))[1]


def twists(system: System, rows: Float[Array, "bodies 4 3"], w: Float[Array, " unknowns"]) -> Twists:
    """Velocities and angular velocities of all bodies from the rates of the tree's free motions."""
    velocity, spin = tangent(system.tree, geometry_at(system, rows), gather_slots(system.tree, w[None]))
    return velocity[0], spin[0]


def tree_rates(system: System, state: State) -> Float[Array, " unknowns"]:
    """Rates of the tree's free motions of a state."""
    rows, rates = state.q.reshape(-1, 4, 3), state.v.reshape(-1, 4, 3)
    spin = angular_velocity(rows[:, 1:], rates[:, 1:])
    return joint_rates(system.tree, geometry_at(system, rows), rates[None, :, 0], spin[None])[0]


def row_rates(rows: Float[Array, "bodies 4 3"], velocity: Array, spin: Array) -> Float[Array, "bodies 4 3"]:
    """Velocities of the rows of bodies with given velocities and angular velocities."""
    return jnp.concatenate([velocity[:, None], cross(spin[:, None], rows[:, 1:])], axis=1)


def _with_ground(x: Float[Array, "bodies *k"]) -> Float[Array, "bodies_and_ground *k"]:
    return jnp.concatenate([x, jnp.zeros_like(x[:1])])


class Equations(eqx.Module):
    """The equations of one instant: applied loads, inertia and constraints as functions of the unknowns.

    Attributes:
        rows: rows of the bodies, with the ground last.
        applied: forces and torques of the effects about the reference points.
    """

    system: System
    rows: Float[Array, "bodies_and_ground 4 3"]
    w: Float[Array, " unknowns"]
    t: Float[Array, ""]

    @property
    def relations(self) -> list[Group]:
        """Relations between joint coordinates, the first of the constraints."""
        return [g for g in self.system.effects if g.multipliers]

    @property
    def loops(self) -> list[Group]:
        """Joints that close loops."""
        return [g for g in self.system.joints if not g.in_tree]

    def constraint_rates(self, rows: Array, velocity: Array, spin: Array, t: Array) -> Float[Array, " m"]:
        """Rates c of relations and loops; affine in the velocities."""
        extended = rows_with_ground(rows.reshape(-1, 3))
        moving = _with_ground(row_rates(rows, velocity, spin))
        along = coordinate_rates(self.system, extended, moving, _with_ground(spin))
        found = [jnp.zeros(0, rows.dtype)]
        for group in self.relations:

            def one(effect, index, along=along):
                wanted = jax.jvp(effect.target, (t,), (jnp.ones_like(t),))[1]
                return effect.coefficients() @ along[index] - wanted

            found.append(jax.vmap(one)(group.effect, group.coordinates))
        for group in self.loops:
            pair = group.bodies
            frames = self.system.frames[group.joints[:, 0]]
            rate = jax.vmap(_joint_rate)(group.effect, frames, extended[pair], moving[pair])
            found.append(rate.reshape(-1))
        return jnp.concatenate(found)

    def rotor_rates(self, rows: Array, velocity: Array, spin: Array) -> tuple[Array, Array]:
        """Rates of the coordinates that carry rotors, and the rotors' inertias."""
        groups = [g for g in self.system.effects if g.effect.rotors]
        moving = _with_ground(row_rates(rows, velocity, spin))
        extended = rows_with_ground(rows.reshape(-1, 3))
        along = coordinate_rates(self.system, extended, moving, _with_ground(spin))
        rates = jnp.concatenate([along[g.coordinates[:, 0]] for g in groups])
        return rates, jnp.concatenate([jax.vmap(lambda e: e.inertia_of())(g.effect) for g in groups])

    def _along(self, function, w_dot: Array) -> tuple[Array, Array]:
        """Value and time derivative of a function of rows, velocities, spins and time along the motion."""
        bodies = self.rows[:-1]

        def composed(rows, w, t):
            return function(rows, *twists(self.system, rows, w), t)

        moving = row_rates(bodies, *twists(self.system, bodies, self.w))
        unit = jnp.ones_like(self.t)
        return jax.jvp(composed, (bodies, self.w, self.t), (moving, w_dot, unit))

    def accelerations(self, w_dot: Float[Array, " unknowns"]) -> Float[Array, "bodies 4 3"]:
        """Accelerations of the rows."""
        return self._along(lambda rows, velocity, spin, t: row_rates(rows, velocity, spin), w_dot)[1]

    def inertial(self, w_dot: Float[Array, " unknowns"]) -> Twists:
        """Forces and torques that accelerate bodies and rotors."""
        rows = self.rows[None, :-1]
        force, torque = wrench(
            inertia(self.system.mass, self.accelerations(w_dot))[None], rows[:, :, 1:]
        )
        force, torque = force[0], torque[0]
        if self.system.structure.rotors:

            def rates(velocity, spin):
                return self.rotor_rates(self.rows[:-1], velocity, spin)

            gained = self._along(lambda rows, velocity, spin, t: self.rotor_rates(rows, velocity, spin)[0], w_dot)
            _, inertias = rates(force, torque)
            pull = jax.vjp(lambda *x: rates(*x)[0], force, torque)[1](inertias * gained[1])
            force, torque = force + pull[0], torque + pull[1]
        return force, torque

    def constraint_accelerations(self, w_dot: Float[Array, " unknowns"]) -> Float[Array, " m"]:
        """Time derivatives c' of the constraint rates."""
        return self._along(self.constraint_rates, w_dot)[1]

    def constrained(self, lam: Float[Array, " m"]) -> Twists:
        """Forces and torques of relations and loops on the bodies."""
        still = jnp.zeros_like(self.rows[:-1, 0])

        def rates(velocity, spin):
            return self.constraint_rates(self.rows[:-1], velocity, spin, self.t)

        return jax.vjp(rates, still, still)[1](lam)


def _joint_rate(effect, frames: Array, rows: Float[Array, "2 4 3"], rates: Float[Array, "2 4 3"]) -> Array:
    return jax.jvp(lambda x: effect.residual(*frames_at(frames, x)), (rows,), (rates,))[1]


def _loads(system: System, state: State, u: Array, velocity: Array, spin: Array) -> Twists:
    """Forces and torques of all effects but rotors and relations, in a step of length zero."""
    rows, tableau = state.q.reshape(-1, 4, 3), gauss(1)
    at = stations(rows, rows[None, :, 0], rows[None, :, 1:], velocity[None], spin[None])
    on_rows = jnp.zeros((rows.shape[0] + 1, 4, 3), rows.dtype)
    torques = jnp.zeros((rows.shape[0] + 1, 3), rows.dtype)
    for group in system.effects:
        if not group.effect.impulsive:
            where = situation(system, group, state, u, jnp.zeros((), rows.dtype))
            lam = no_multipliers(group, tableau, rows.dtype)
            answer = respond(group, where, gather(group, at), lam, tableau)
            on_rows = on_rows.at[group.bodies].add(answer.forces[:, 0])
            torques = torques.at[group.bodies].add(answer.torques[:, 0])
    force, torque = wrench(on_rows[None, :-1], rows[None, :, 1:])
    return force[0], torque[0] + torques[:-1]
