"""Equations of a step in the local null space: six rates a body, multipliers for every joint.

The most general form: any joint, any loop, any coupling. The Jacobian is assembled from those of single
bodies and effects. Systems that are no tree, too large for the reduced form and too small for the sparse one
are solved so, densely; for all others it is an independent way to the same trajectory.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.state import State
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.maths.projectors import range_projector
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.block_tangent_space import Tangents
from natcoord_jax.mechanics.element_matrices import dense, part_matrices, products, rates_of, touches
from natcoord_jax.mechanics.local import body_balance, body_motion, jacobians, wrenches
from natcoord_jax.mechanics.momentum import least_inertias, stage_changes
from natcoord_jax.mechanics.redundancy import held_multipliers, least_change, project_multipliers
from natcoord_jax.mechanics.response import StageKinematics, stations
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.mechanics.step_equations import StepEquations
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST
from natcoord_jax.model.masses import MassBetween
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import rows_with_ground


class FullStep(StepEquations):
    """One step with multipliers for every joint: all that does not depend on the unknowns."""

    @classmethod
    def groups_of(cls, system: Model) -> tuple[Group, ...]:
        """All groups, in the order of their multipliers."""
        return (*system.effects, *system.joints)

    @classmethod
    def geometry_of(cls, system: Model, state: State) -> dict[str, Array]:
        """Rows at the start, those of the ground last."""
        return {"start": rows_with_ground(state.q)}

    @classmethod
    def held_range(cls, system: Model, state: State, rank: int, tangents: Tangents | None) -> Array:
        """From the rows of the Jacobian of a step of no length."""
        no_inputs = jnp.zeros(len(system.structure.inputs), state.q.dtype)
        resting = cls.prepare(system, state, no_inputs, jnp.zeros((), state.q.dtype), gauss(1), NOTHING)
        matrix = resting.jacobian(jnp.zeros(resting.unknowns, state.q.dtype))
        rows = matrix[resting.balances :, : resting.balances][held_multipliers(resting.groups)]
        in_tree = sum(g.count * g.multipliers for g in system.joints if g.in_tree)
        return range_projector(rows, rank + in_tree, least_change(system))

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return self.velocity.shape[0]

    @property
    def balances(self) -> int:
        """Number of balance equations."""
        return self.system.local_rates.count * self.tableau.stages

    def rates(self, y: Float[Array, " balances"]) -> Float[Array, "bodies s 6"]:
        """Twists of the bodies."""
        return self.system.local_rates.twists(y, self.start[:-1])

    def moved(self, w: Float[Array, "bodies s 6"]) -> tuple[StageKinematics, None]:
        """Stage motion of all bodies."""
        motion = body_motion(self.start[:-1], w, self.h, self.tableau)
        points, directors = motion.rows[:, :, 0], motion.rows[:, :, 1:]
        return stations(self.start[:-1], points, directors, motion.rates[:, :, 0], motion.spin), None

    def generalised(
        self, geometry: None, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
    ) -> Float[Array, " balances"]:
        """Wrenches along the rates of every body."""
        wrenches = jnp.moveaxis(jnp.concatenate([force, torque], axis=-1), 0, 1)
        return self.system.local_rates.balances(wrenches, self.start[:-1])

    def _with_ground(self, twists: Array) -> Array:
        return jnp.concatenate([twists, jnp.zeros_like(twists[:1])])

    def body_jacobians(self, twists: Float[Array, "bodies s 6"]) -> Float[Array, "bodies n n"]:
        """Jacobians of the bodies' own balances."""
        width = TWIST * self.tableau.stages
        local = jax.vmap(jax.jacfwd(body_balance, argnums=3), in_axes=(0, 0, 0, 0, None, None))
        found = local(self.system.mass, self.start[:-1], self.velocity, twists, self.h, self.tableau)
        along = self.system.local_rates.blocks(np.arange(self.bodies)[:, None], self.start)
        found = along(along(found[:, None, :, :, None], 1), 4)
        return found.reshape(self.bodies, width, width)

    def tangent(self, y: Float[Array, " unknowns"], loads: Any = None) -> Any:
        """The Jacobian nearly, from linearised effects: what Newton's iteration needs."""
        return self.jacobian(y, exact=False)

    def jacobian(
        self, y: Float[Array, " unknowns"], *, exact: bool = True
    ) -> Float[Array, "unknowns unknowns"]:
        """Jacobian, put together from those of bodies, effects and joints."""
        y = project_multipliers(y, self.balances, self.start_cache.projector)
        given = self.matrices(y, exact), self.unknowns, self.tableau.stages, self.products(y)
        return self._projected(dense(self.system, *given))

    def products(self, y: Float[Array, " unknowns"]) -> tuple[Products | NeighbourCouplings, ...]:
        """What effects on many bodies add to `matrices`."""
        return products(self, self._with_ground(self.split(y)[0]))

    def matrices(self, y: Float[Array, " unknowns"], exact: bool) -> list[Float[Array, "_ _ _"]]:
        """Jacobians of the bodies and of the instances of each group, by the unknowns in `elements`."""
        twists, multipliers = self.split(y)
        every = self._with_ground(twists)
        found = [self.body_jacobians(twists)]
        if self.system.mass_between is not None:
            found.append(pair_matrices(self, self.system.mass_between, twists))
        for group, where, lam in zip(self.groups, self.situations, multipliers):
            if not touches(group):
                continue
            if group.effect.spread:
                found.append(part_matrices(self, group, where, every))
                continue
            bodies, rates = group.bodies, rates_of(group)
            (by_twist, by_lam), (g_by_twist, g_by_lam) = jacobians(
                group, where, self.tableau, self.start[bodies], every[bodies][..., :rates], lam, exact=exact
            )
            if group.turning:
                along = self.system.local_rates.blocks(bodies, self.start)
                by_twist, by_lam, g_by_twist = along(by_twist, 1), along(by_lam, 1), along(g_by_twist, 3)
                by_twist = along(by_twist, 4)
            count, width = group.count, bodies.shape[1] * self.tableau.stages * rates
            rows = self.tableau.stages * group.multipliers
            above = [-by_twist.reshape(count, width, width), -by_lam.reshape(count, width, rows)]
            below = [g_by_twist.reshape(count, rows, width), g_by_lam.reshape(count, rows, rows)]
            whole = [jnp.concatenate(parts, axis=2) for parts in (above, below)]
            found.append(jnp.concatenate(whole, axis=1) if rows else above[0])
        return found

    def _projected(self, matrix: Array) -> Array:
        """Columns of multipliers and rows of constraints in the range of the constraints."""
        if self.start_cache.projector is None:
            return matrix
        first = self.balances
        count = matrix.shape[0] - first
        idle = (jnp.eye(count, dtype=matrix.dtype) - self.start_cache.projector) / (1.0 + count)
        matrix = matrix.at[:first, first:].set(matrix[:first, first:] @ self.start_cache.projector)
        matrix = matrix.at[first:, :first].set(self.start_cache.projector @ matrix[first:, :first])
        own = self.start_cache.projector @ matrix[first:, first:] @ self.start_cache.projector
        return matrix.at[first:, first:].set(own + idle)

    def inertias(self, matrix: Float[Array, "unknowns unknowns"]) -> Float[Array, " balances"]:
        """Inertias of the rates."""
        return jnp.abs(jnp.diagonal(matrix))[: self.balances]

    def least_inertias(self) -> Float[Array, " balances"]:
        """Inertias that the rates have at least, by the mass of their bodies; the same in every step."""
        own = jnp.repeat(least_inertias(self.system.mass), 3, axis=1)
        stages = jnp.diagonal(jnp.asarray(self.tableau.a_inverse, own.dtype))
        return self.system.local_rates.picked(own[:, None, :] * stages[:, None])

    def guess(self) -> Float[Array, " unknowns"]:
        """Rates at the start, repeated for every stage; multipliers zero."""
        start = self.start[:-1]
        spin = 0.5 * jnp.sum(cross(start[:, 1:], self.velocity[:, 1:]), axis=1)
        twists = jnp.concatenate([self.velocity[:, 0], spin], axis=1)
        return self.repeated(self.system.local_rates.balances(twists[:, None], start))

    def by_stage(self, y: Float[Array, " unknowns"]) -> Float[Array, "s rates"]:
        """Rates among the unknowns, or balances among the equations."""
        return self.system.local_rates.by_stage(y[: self.balances], self.tableau.stages)

    def repeated(self, w: Float[Array, " rates"]) -> Float[Array, " unknowns"]:
        """The same at all stages; multipliers zero."""
        return self.with_multipliers(self.system.local_rates.repeated(w, self.tableau.stages))


def pair_balance(
    block: Float[Array, "r r"],
    start: Float[Array, "2 4 3"],
    velocity: Float[Array, "2 4 3"],
    twists: Float[Array, "2 s 6"],
    h: Array,
    tableau: Tableau,
) -> Float[Array, "2 s 6"]:
    """Change of the momenta that two bodies have by mass between them, as wrenches."""
    motion, rows = body_motion(start, twists, h, tableau), block.shape[0]
    changes = stage_changes(motion.rates - velocity[None], tableau)[..., :rows, :]
    onto_first = jnp.sum(block[:, :, None] * changes[:, 1, None], axis=-2)
    onto_second = jnp.sum(block[:, :, None] * changes[:, 0, :, None], axis=-3)
    momentum = (
        jnp.zeros_like(motion.rates).at[..., :rows, :].set(jnp.stack([onto_first, onto_second], axis=1))
    )
    return wrenches(momentum, jnp.zeros_like(motion.spin), motion)


def pair_matrices(
    step: Any, mass: MassBetween, twists: Float[Array, "bodies s 6"]
) -> Float[Array, "pairs n n"]:
    """Jacobians of that, see `FullStep.matrices`."""
    bodies, stages = mass.bodies, step.tableau.stages
    width = 2 * stages * mass.rates
    if not mass.turning:
        # Momenta of points are linear in their velocities.
        other, unit, inverse = 1.0 - np.eye(2), np.eye(3), np.array(step.tableau.a_inverse)
        pattern = np.einsum("ab,ij,xy->aixbjy", other, inverse, unit).reshape(width, width)
        return mass.blocks * pattern
    local = jax.vmap(jax.jacfwd(pair_balance, argnums=3), in_axes=(0, 0, 0, 0, None, None))
    given = step.start[bodies], step.velocity[bodies], twists[bodies]
    found = local(mass.blocks, *given, step.h, step.tableau)
    along = step.system.local_rates.blocks(bodies, step.start)
    return along(along(found, 1), 4).reshape(-1, width, width)
