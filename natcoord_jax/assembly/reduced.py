"""Equations of a step in the joint null space: rates of the spanning tree and multipliers of loops.

Unknowns y: mean rates w of the tree's free motions, stage by stage, then the multipliers (times the step)
of the joints that close loops and of relations between coordinates. Residual: the momentum balance of the
step (57) projected on the free motions, P^T [M sum_j (A^-1)_ij (V_j - v_0) - h F_i - G_i^T lambda_i],
then the rates of the constraints. Working with rates and multipliers times h keeps the equations of one
size as h goes to zero.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.response import (
    Situation,
    Stations,
    body_rows,
    gather,
    respond,
    situation,
    stations,
)
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.assembly.tree import (
    JointGeometry,
    TreeMotion,
    gather_slots,
    joint_rates,
    project,
    sweep_motion,
)
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.maths.projectors import range_projector
from natcoord_jax.maths.vectors import cross


def project_multipliers(y: Array, balances: int, projector: Array | None) -> Array:
    """Unknowns with their multipliers in the range of the constraints: reactions of minimum norm.

    At the mid-point of a step, off the manifold, redundant constraints are not quite dependent; multipliers
    outside of the range would then push along the free motion.
    """
    if projector is None:
        return y
    return jnp.concatenate([y[:balances], projector @ y[balances:]])


def project_rows(rows: Array, y: Array, balances: int, projector: Array | None) -> Array:
    """Constraint rates in the range of the constraints; the other rows set idle multipliers to zero."""
    if projector is None:
        return rows
    idle = y[balances:] - projector @ y[balances:]
    return projector @ rows + idle / (1.0 + rows.shape[0])


def active_groups(system: System) -> tuple[Group, ...]:
    """Groups that take part in the equations: all effects and the joints that close loops."""
    return (*system.effects, *(g for g in system.joints if not g.in_tree))


def inertia(
    mass: Float[Array, "bodies 4 4"], rates: Float[Array, "*s bodies 4 3"]
) -> Float[Array, "*s bodies 4 3"]:
    """Rows of m v."""
    return jnp.sum(mass[:, :, :, None] * rates[..., None, :, :], axis=-2)


def wrench(
    rows: Float[Array, "s bodies 4 3"], directors: Float[Array, "s bodies 3 3"]
) -> tuple[Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]:
    """Force and torque about the reference point of forces on rows: r_phi and sum d_i x r_i (26, 31)."""
    return rows[:, :, 0], jnp.sum(cross(directors, rows[:, :, 1:]), axis=2)


def row_weights(mass: Float[Array, "bodies 4 4"]) -> Float[Array, "bodies 4"]:
    """Reciprocal mass of each row, so that weight times impulse squared is an energy; 0 for massless rows."""
    turning = jnp.trace(mass[:, 1:, 1:], axis1=1, axis2=2)
    sizes = jnp.stack([mass[:, 0, 0], turning, turning, turning], axis=1)
    return jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)


class ReducedStep(eqx.Module):
    """One step in the joint null space: all that does not depend on the unknowns, and the equations."""

    system: System
    state: State
    start: Float[Array, "bodies 4 3"]
    velocity: Float[Array, "bodies 4 3"]
    frames: Float[Array, "bodies 2 4 4"]
    situations: tuple[Situation, ...]
    h: Float[Array, ""]
    projector: Float[Array, "m m"] | None
    tableau: Tableau = eqx.field(static=True)

    @classmethod
    def prepare(cls, system: System, state: State, u: Array, h: Array, tableau: Tableau) -> "ReducedStep":
        """Gather what the step needs, once."""
        start = body_rows(state.q)
        plain = cls(
            system,
            state,
            start,
            body_rows(state.v),
            system.tree.frames(system.frames),
            tuple(situation(system, g, state, u, h) for g in active_groups(system)),
            h,
            None,
            tableau,
        )
        if system.structure.rank is None or tableau.stages > 1:
            return plain
        projector = range_projector(plain.constraint_matrix(), system.structure.rank)
        return eqx.tree_at(lambda s: s.projector, plain, projector, is_leaf=lambda x: x is None)

    def constraint_matrix(self) -> Float[Array, "m unknowns"]:
        """Rates of all constraints per rate of the free motions, at the start of the step."""
        resting = replace_fields(self, h=jnp.zeros_like(self.h))
        count = self.system.structure.unknowns
        rest = jnp.zeros(self.system.structure.multipliers, self.start.dtype)

        def rows(w: Array) -> Array:
            return resting.residual(jnp.concatenate([w, rest]))[0][count:]

        return jax.jacfwd(rows)(jnp.zeros(count, self.start.dtype))

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups with a part in the equations, in the order of their multipliers."""
        return active_groups(self.system)

    @property
    def balances(self) -> int:
        """Number of balance equations; the rest are constraints."""
        return self.system.structure.unknowns * self.tableau.stages

    def split(self, y: Float[Array, " unknowns"]) -> tuple[Array, list[Array]]:
        """Rates (s, unknowns) and multipliers of each active group (n, s, m)."""
        s, position = self.tableau.stages, self.balances
        w, multipliers = y[:position].reshape(s, -1), []
        if position == 0:
            w = y[:0].reshape(s, 0)
        for group in active_groups(self.system):
            shape = (group.count, s, group.multipliers)
            size = group.count * s * group.multipliers
            multipliers.append(y[position : position + size].reshape(shape))
            position += size
        return w, multipliers

    def motion(self, w: Float[Array, "s unknowns"]) -> tuple[TreeMotion, list[JointGeometry]]:
        """Stage motion of the bodies at given rates."""
        slots = gather_slots(self.system.tree, w)
        return sweep_motion(self.system.tree, self.frames, self.start, slots, self.h, self.tableau)

    def stations(self, motion: TreeMotion) -> Stations:
        """Motion as the effects see it."""
        a = self.h * jnp.asarray(self.tableau.a, motion.velocity.dtype)
        points = self.start[:, 0] + jnp.sum(a[:, :, None, None] * motion.velocity, axis=1)
        return stations(self.start, points, motion.directors, motion.velocity, motion.spin)

    def residual(self, y: Float[Array, " unknowns"]) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
        """Residual [N s, N m s; m/s, 1/s for constraints] and the size of its terms [sqrt(J)]."""
        system, tableau = self.system, self.tableau
        w, multipliers = self.split(project_multipliers(y, self.balances, self.projector))
        motion, geometry = self.motion(w)
        rates = jnp.concatenate(
            [motion.velocity[:, :, None], cross(motion.spin[:, :, None], motion.directors)], axis=2
        )
        momentum = stage_momentum(system.mass, rates - self.velocity, tableau)
        weights = row_weights(system.mass)[..., None]
        size = jnp.sum(weights * (momentum**2 + 4 * inertia(system.mass, self.velocity) ** 2))
        torque = None
        rows = []
        groups = active_groups(system)
        at = self.stations(motion)
        for group, where, lam in zip(groups, self.situations, multipliers):
            answer = respond(group, where, gather(group, at), lam, tableau)
            scale = 1.0 if group.effect.impulsive else self.h
            if answer.forces is not None:
                forces = self._scatter(group, scale * answer.forces)
                momentum = momentum - forces
                size = size + jnp.sum(weights * forces**2)
            if answer.torques is not None:
                turning = self._scatter(group, scale * answer.torques)
                torque = turning if torque is None else torque + turning
                size = size + jnp.sum(weights[:, 1] * turning**2)
            rows.append(answer.rows.reshape(-1))
        force, moment = wrench(momentum, motion.directors)
        moment = moment if torque is None else moment - torque
        generalised = project(system.tree, geometry, force, moment)[0]
        rows = project_rows(jnp.concatenate([jnp.zeros(0), *rows]), y, self.balances, self.projector)
        return jnp.concatenate([generalised.reshape(-1), rows]), jnp.sqrt(size)

    def _scatter(self, group: Group, loads: Float[Array, "n s k *rest"]) -> Float[Array, "s bodies *rest"]:
        """Sum of the loads of all instances by body; those on the ground fall away."""
        loads = jnp.moveaxis(loads, 1, 0)
        if group.source == "mass":
            return loads[:, :, 0]
        bodies = self.start.shape[0]
        total = jnp.zeros((self.tableau.stages, bodies + 1, *loads.shape[3:]), loads.dtype)
        return total.at[:, group.bodies].add(loads)[:, :bodies]

    def _start_geometry(self) -> list[JointGeometry]:
        zero = jnp.zeros((1, self.system.structure.unknowns), self.start.dtype)
        slots = gather_slots(self.system.tree, zero)
        return sweep_motion(self.system.tree, self.frames, self.start, slots, 0.0 * self.h, gauss(1))[1]

    def guess(self) -> Float[Array, " unknowns"]:
        """Rates of the velocities at the start, repeated for every stage; multipliers zero."""
        spin = 0.5 * jnp.sum(cross(self.start[:, 1:], self.velocity[:, 1:]), axis=1)[None]
        w = joint_rates(self.system.tree, self._start_geometry(), self.velocity[None, :, 0], spin)
        w = jnp.tile(w.reshape(-1), self.tableau.stages)
        return jnp.concatenate([w, jnp.zeros(self.system.structure.multipliers * self.tableau.stages)])

    def jacobian(self, y: Float[Array, " unknowns"]) -> Float[Array, "unknowns unknowns"]:
        """Exact Jacobian of the residual."""
        return jax.jacfwd(lambda x: self.residual(x)[0])(y)

    def end_motion(self, y: Float[Array, " unknowns"]) -> tuple[Stations, list[Array]]:
        """Stage motion of all bodies and the multipliers, for the end of the step."""
        w, multipliers = self.split(project_multipliers(y, self.balances, self.projector))
        return self.stations(self.motion(w)[0]), multipliers


def stage_momentum(
    mass: Float[Array, "bodies 4 4"], difference: Float[Array, "s bodies 4 3"], tableau: Tableau
) -> Float[Array, "s bodies 4 3"]:
    """M sum_j (A^-1)_ij (V_j - v_0)."""
    if tableau.stages == 1:
        return inertia(mass, tableau.a_inverse[0][0] * difference)
    return inertia(mass, jnp.einsum("ij,jbrc->ibrc", jnp.asarray(tableau.a_inverse), difference))
