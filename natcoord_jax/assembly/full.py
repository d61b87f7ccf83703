"""Equations of a step in the local null space: six rates a body, multipliers for every joint.

The most general form: any joint, any loop, any coupling. The Jacobian is assembled from those of single
bodies and effects. Systems that are no tree, too large for the reduced form and too small for the sparse one
are solved so, densely; for all others it is an independent way to the same trajectory.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.diagnostics import rows_with_ground
from natcoord_jax.assembly.form import Form
from natcoord_jax.assembly.grain import cancelling_size
from natcoord_jax.assembly.kick import kicked
from natcoord_jax.assembly.local import body_balance, body_motion, jacobians
from natcoord_jax.assembly.momentum import idle_torque, least_inertias, momentum_balance
from natcoord_jax.assembly.outset import Outset
from natcoord_jax.assembly.reduced import NOTHING
from natcoord_jax.assembly.redundancy import at_every_stage, project_multipliers, project_rows
from natcoord_jax.assembly.response import (
    Evaluation,
    Situation,
    Stations,
    body_rows,
    situation,
    stations,
)
from natcoord_jax.assembly.separate import Tangents
from natcoord_jax.assembly.system import Group, System
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.maths.projectors import range_projector
from natcoord_jax.maths.vectors import cross


class FullStep(Form):
    """One step with multipliers for every joint: all that does not depend on the unknowns."""

    system: System
    state: State
    start: Float[Array, "bodies_and_ground 4 3"]
    velocity: Float[Array, "bodies 4 3"]
    situations: tuple[Situation, ...]
    h: Float[Array, ""]
    outset: Outset
    tableau: Tableau = eqx.field(static=True)

    @classmethod
    def prepare(
        cls,
        system: System,
        state: State,
        u: Array,
        h: Array,
        tableau: Tableau,
        outset: Outset | None = None,
    ) -> "FullStep":
        """Gather what the step needs, once; see `ReducedStep.prepare`."""
        groups = (*system.effects, *system.joints)
        return cls(
            system,
            state,
            rows_with_ground(state.q),
            body_rows(state.v),
            tuple(situation(system, g, state, u, h) for g in groups),
            h,
            cls.starting(system, state, tableau) if outset is None else outset,
            tableau,
        )

    @classmethod
    def starting(
        cls,
        system: System,
        state: State,
        tableau: Tableau,
        tangents: Tangents | None = None,
        later: bool = False,
    ) -> Outset:
        """What a step needs of its start, see `Outset.of`."""
        projector, rank = None, system.structure.rank
        if rank is not None:
            no_inputs = jnp.zeros(len(system.structure.inputs), state.q.dtype)
            resting = cls.prepare(system, state, no_inputs, jnp.zeros((), state.q.dtype), gauss(1), NOTHING)
            matrix = resting.jacobian(jnp.zeros(resting.unknowns, state.q.dtype))
            rows = matrix[resting.balances :, : resting.balances]
            in_tree = sum(g.count * g.multipliers for g in system.joints if g.in_tree)
            projector = range_projector(rows, rank + in_tree)
            projector = at_every_stage(projector, resting.groups, tableau.stages)
        return Outset.of(system, state, tableau, projector, tangents, later)

    @property
    def groups(self) -> tuple[Group, ...]:
        """All groups, in the order of their multipliers."""
        return (*self.system.effects, *self.system.joints)

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return self.velocity.shape[0]

    @property
    def dependent(self) -> bool:
        """Whether constraints depend on each other."""
        return self.system.structure.rank is not None

    @property
    def balances(self) -> int:
        """Number of balance equations."""
        return 6 * self.bodies * self.tableau.stages

    @property
    def grain(self) -> Float[Array, ""]:
        """Size of the terms that cancel in the forces [sqrt(J)]."""
        return cancelling_size(self.system, self.groups, self.situations, self.state, self.h)

    def _blocks(self) -> list[tuple[int, int]]:
        """First unknown and size of the multipliers of each group."""
        blocks, position = [], self.balances
        for group in self.groups:
            size = group.count * self.tableau.stages * group.multipliers
            blocks.append((position, size))
            position += size
        return blocks

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        last = self._blocks()[-1] if self.groups else (self.balances, 0)
        return sum(last)

    def split(self, y: Float[Array, " unknowns"]) -> tuple[Array, list[Array]]:
        """Twists (bodies, s, 6) and multipliers of each group (n, s, m)."""
        s = self.tableau.stages
        twists = y[: self.balances].reshape(self.bodies, s, 6)
        multipliers = [
            y[first : first + size].reshape(group.count, s, group.multipliers)
            for group, (first, size) in zip(self.groups, self._blocks())
        ]
        return twists, multipliers

    def _with_ground(self, twists: Array) -> Array:
        return jnp.concatenate([twists, jnp.zeros_like(twists[:1])])

    def residual(self, y: Float[Array, " unknowns"]) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
        """Residual [N s, N m s; m/s, 1/s for constraints] and the size of its terms [sqrt(J)]."""
        found = self.evaluate(y)
        return found.residual, found.size

    def evaluate(self, y: Float[Array, " unknowns"]) -> Evaluation:
        """Residual, and what the end of the step needs."""
        twists, multipliers = self.split(project_multipliers(y, self.balances, self.outset.projector))
        at = self._stations(twists)
        velocity, situations, kick = kicked(
            self.system,
            self.state,
            self.outset.tangents,
            self.outset.lag,
            self.groups,
            self.situations,
            at,
            self.h,
            self.tableau,
        )
        given = self.system, self.groups, situations, at, velocity
        found = momentum_balance(*given, multipliers, self.h, self.tableau)
        # A point mass keeps its directors by an idle inertia, as in `body_balance`.
        torque = found.torque + idle_torque(self.system, self.start[:-1], at.spin[:, :-1])
        wrenches = jnp.moveaxis(jnp.concatenate([found.force, torque], axis=-1), 0, 1)
        rows = project_rows(found.rows, y, self.balances, self.outset.projector)
        residual = jnp.concatenate([wrenches.reshape(-1), rows])
        return Evaluation(residual, found.size, at, found.power, (found.force, found.torque), kick)

    def body_jacobians(self, twists: Float[Array, "bodies s 6"]) -> Float[Array, "bodies n n"]:
        """Jacobians of the bodies' own balances."""
        width = 6 * self.tableau.stages
        local = jax.vmap(jax.jacfwd(body_balance, argnums=3), in_axes=(0, 0, 0, 0, None, None, 0))
        given = self.system.mass, self.start[:-1], self.velocity, twists, self.h, self.tableau
        unit = jnp.broadcast_to(jnp.eye(3, dtype=twists.dtype)[:, None], (3, self.bodies, 3))
        found = local(*given, jnp.swapaxes(idle_torque(self.system, self.start[:-1], unit), 0, 1))
        return found.reshape(self.bodies, width, width)

    def tangent(self, y: Float[Array, " unknowns"], loads: Any = None) -> Float[Array, "unknowns unknowns"]:
        """The Jacobian nearly, from linearised effects: what Newton's iteration needs."""
        return self.jacobian(y, exact=False)

    def jacobian(
        self, y: Float[Array, " unknowns"], *, exact: bool = True
    ) -> Float[Array, "unknowns unknowns"]:
        """Jacobian, assembled from local ones."""
        twists, multipliers = self.split(project_multipliers(y, self.balances, self.outset.projector))
        s, bodies, size = self.tableau.stages, self.bodies, self.unknowns
        width = 6 * s
        own = self.body_jacobians(twists)
        columns = np.arange(bodies)[:, None] * width + np.arange(width)
        matrix = jnp.zeros((size + width, size + width), y.dtype)
        matrix = matrix.at[columns[:, :, None], columns[:, None, :]].add(own)
        every = self._with_ground(twists)
        for group, where, lam, (first, _) in zip(self.groups, self.situations, multipliers, self._blocks()):
            (by_twist, by_lam), (g_by_twist, _) = jacobians(
                group,
                where,
                self.tableau,
                self.start[group.bodies],
                every[group.bodies],
                lam,
                exact=exact,
            )
            n, k = group.bodies.shape
            m = s * group.multipliers
            # ground columns and rows go beyond the matrix and are cut off at the end
            base = jnp.where(group.bodies == bodies, size, group.bodies * width)
            touched = (base[:, :, None] + jnp.arange(width)).reshape(n, k * width)
            local = by_twist.reshape(n, k * width, k * width)
            matrix = matrix.at[touched[:, :, None], touched[:, None, :]].add(-local)
            if m:
                lams = first + jnp.arange(n)[:, None] * m + jnp.arange(m)
                matrix = matrix.at[touched[:, :, None], lams[:, None, :]].add(
                    -by_lam.reshape(n, k * width, m)
                )
                matrix = matrix.at[lams[:, :, None], touched[:, None, :]].add(
                    g_by_twist.reshape(n, m, k * width)
                )
        return self._projected(matrix[:size, :size])

    def _projected(self, matrix: Array) -> Array:
        """Columns of multipliers and rows of constraints in the range of the constraints."""
        if self.outset.projector is None:
            return matrix
        first = self.balances
        count = matrix.shape[0] - first
        idle = (jnp.eye(count, dtype=matrix.dtype) - self.outset.projector) / (1.0 + count)
        matrix = matrix.at[:first, first:].set(matrix[:first, first:] @ self.outset.projector)
        matrix = matrix.at[first:, :first].set(self.outset.projector @ matrix[first:, :first])
        return matrix.at[first:, first:].set(idle)

    def inertias(self, matrix: Float[Array, "unknowns unknowns"]) -> Float[Array, " balances"]:
        """Inertias of the rates."""
        return jnp.abs(jnp.diagonal(matrix))[: self.balances]

    def least_inertias(self) -> Float[Array, " balances"]:
        """Inertias that the rates have at least, by the mass of their bodies; the same in every step."""
        own = jnp.repeat(least_inertias(self.system.mass), 3, axis=1)
        stages = jnp.diagonal(jnp.asarray(self.tableau.a_inverse, own.dtype))
        return (own[:, None, :] * stages[:, None]).reshape(-1)

    def guess(self) -> Float[Array, " unknowns"]:
        """Twists at the start, repeated for every stage; multipliers zero."""
        start = self.start[:-1]
        spin = 0.5 * jnp.sum(cross(start[:, 1:], self.velocity[:, 1:]), axis=1)
        return self.repeated(jnp.concatenate([self.velocity[:, 0], spin], axis=1).reshape(-1))

    def by_stage(self, y: Float[Array, " unknowns"]) -> Float[Array, "s rates"]:
        """Twists among the unknowns, or balances among the equations."""
        twists = y[: self.balances].reshape(self.bodies, self.tableau.stages, 6)
        return jnp.moveaxis(twists, 1, 0).reshape(self.tableau.stages, -1)

    def repeated(self, w: Float[Array, " rates"]) -> Float[Array, " unknowns"]:
        """The same at all stages; multipliers zero."""
        shape = self.bodies, self.tableau.stages, 6
        twists = jnp.broadcast_to(w.reshape(self.bodies, 1, 6), shape).reshape(-1)
        return jnp.concatenate([twists, jnp.zeros(self.unknowns - self.balances, twists.dtype)])

    def motion_of(self, y: Float[Array, " unknowns"]) -> Stations:
        """Stage motion of all bodies."""
        return self._stations(self.split(y)[0])

    def _stations(self, twists: Float[Array, "bodies s 6"]) -> Stations:
        motion = body_motion(self.start[:-1], twists, self.h, self.tableau)
        return stations(
            self.start[:-1],
            motion.rows[:, :, 0],
            motion.rows[:, :, 1:],
            motion.rates[:, :, 0],
            motion.spin,
        )
