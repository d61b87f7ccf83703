"""The equations of equilibrium: no resultant force or torque on any body, no gap in any joint.

Unknowns are the displacements and rotations of all bodies (Cayley's vectors, along the rates that a body
has) from a given configuration, and the multipliers of all joints and of relations between coordinates. The
time of the state is the parameter of the load: forces, drives and inputs that are functions of time follow
it.
"""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.dense import Inverse
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.linsolve.sparse import factorised
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.elimination import pivoted_inverse
from natcoord_jax.mechanics.element_matrices import bodies_of_elements, dense, rates_of, touches
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.mechanics.local import body_motion
from natcoord_jax.mechanics.momentum import wrench
from natcoord_jax.mechanics.node_sweeps import sweep_nodes
from natcoord_jax.mechanics.projection import nearest_coordinates
from natcoord_jax.mechanics.response import gather, respond, situation, stations
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.mechanics.violations import violations_of
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST
from natcoord_jax.model.rows import group_places, row_rates
from natcoord_jax.model.tree import gather_slots, start_rates
from natcoord_jax.system import System

NO_MASS = 1e-30
"""Factor on masses that leaves them no weight in the equations, but tells bodies from point masses."""

DENSE = 400
"""Unknowns up to which the Jacobian is inverted as a dense matrix, with pivots."""

SHIFT = 1e-10
"""Compliance given to constraints, relative to that of the structure: redundant ones share their load."""


class Static(eqx.Module):
    """Equations of equilibrium near one configuration.

    Attributes:
        system: compiled system.
        state: the configuration that displacements count from; its time is the load parameter.
        inputs: [N, N m].
    """

    system: System
    state: State
    inputs: Float[Array, " inputs"]

    @property
    def balances(self) -> int:
        """Number of balances of forces and torques: as many as the bodies have rates."""
        return self.system.local_rates.count

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups with multipliers, relations between coordinates first."""
        return tuple(g for g in (*self.system.effects, *self.system.joints) if g.multipliers)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.balances + sum(g.count * g.multipliers for g in self.groups)

    def displaced(self, y: Float[Array, " unknowns"]) -> State:
        """The state at rest after the displacements in `y`."""
        rows = self.state.rows
        twists = self.twists(y)[:, None]
        return self._at(rows + body_motion(rows, twists, jnp.ones((), rows.dtype), gauss(1)).rates[0])

    def twists(self, y: Float[Array, " unknowns"]) -> Float[Array, "bodies 6"]:
        """Displacements and rotations of all bodies."""
        rows = self.state.rows
        return self.system.local_rates.twists(y[: self.balances], rows)[:, 0]

    def moved_along_tree(self, y: Float[Array, " unknowns"]) -> State:
        """The same to first order, but every body is carried along by its neighbour in the tree.

        Neighbours that turn far together stay together, so that Newton's method does not stretch a stiff
        beam that it bends; the joints of the tree stay closed.
        """
        system, rows = self.system, self.state.rows
        velocity, spin = jnp.split(self.twists(y), 2, axis=1)
        tree, h = system.tree.chained(), jnp.ones((), rows.dtype)
        frames = tree.frames(system.frames)
        w = start_rates(tree, frames, rows, row_rates(rows, velocity, spin))[None]
        motion, _ = sweep_nodes(tree, frames, rows, gather_slots(tree, w), h, gauss(1))
        points = rows[:, 0] + 0.5 * motion.velocity
        at = stations(rows, points, motion.directors, motion.velocity, motion.spin)
        return self._at(rows + at.rates[0, :-1])

    def _at(self, rows: Float[Array, "bodies 4 3"]) -> State:
        still = {name: jnp.zeros_like(getattr(self.state, name)) for name in ("v", "rates")}
        state = replace_fields(self.state, q=rows.reshape(-1, 3), **still)
        return replace_fields(state, coordinates=nearest_coordinates(self.system, state))

    def residual(self, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        """Unbalanced forces [N] and torques [N m], with opposite sign, and gaps [m, -]."""
        state = self.displaced(y)
        rows = state.rows
        still = jnp.zeros_like(rows[:, 0])
        force, torque = loads(self.system, state, self.inputs, still, still)
        pulled = self.constraint_loads(state, y)
        sums = -(jnp.concatenate([force, torque], axis=1) + jnp.concatenate(pulled, axis=1))
        balances = self.system.local_rates.balances(sums[:, None], self.state.rows)
        return jnp.concatenate([balances, self.gaps(state)])

    def constraint_loads(self, state: State, y: Array) -> tuple[Array, Array]:
        """Forces and torques of the multipliers on all bodies."""
        rows, tableau = state.rows, gauss(1)
        still = jnp.zeros((1, rows.shape[0], 3), rows.dtype)
        at = stations(rows, rows[None, :, 0], rows[None, :, 1:], still, still)
        on_rows = jnp.zeros((rows.shape[0] + 1, *NODE), rows.dtype)
        torques = jnp.zeros((rows.shape[0] + 1, 3), rows.dtype)
        position = self.balances
        for group in self.groups:
            size = group.count * group.multipliers
            lam = y[position : position + size].reshape(group.count, 1, group.multipliers)
            position += size
            where = situation(self.system, group, state, self.inputs, jnp.zeros((), rows.dtype))
            answer = respond(group, where, gather(group, at), lam, tableau)
            if answer.forces is not None:
                on_rows = on_rows.at[group.bodies].add(answer.forces[:, 0])
            if answer.torques is not None:
                torques = torques.at[group.bodies].add(answer.torques[:, 0])
        force, torque = wrench(on_rows[None, :-1], rows[None, :, 1:])
        return force[0], torque[0] + torques[:-1]

    def gaps(self, state: State) -> Array:
        """What constraints miss."""
        found = (x.reshape(-1) for x in violations_of(self.system, self.groups, state))
        return jnp.concatenate([jnp.zeros(0, state.q.dtype), *found])

    def matrices(
        self, y: Float[Array, " unknowns"], weight: Array | float = 0.0
    ) -> tuple[list[Float[Array, "_ _ _"]], tuple[Products | NeighbourCouplings, ...]]:
        """Jacobian of the residual at displacements zero: matrices of bodies and effects, and products.

        They are those of a step of the body system without mass: a step's forces are those of its middle,
        which moves by half the displacement. With a `weight` [1/s^2] that times the inertia is added to them
        (four times, to be exact), as of a short step.
        """
        scale, between = NO_MASS + weight, self.system.mass_between
        between = None if between is None else between.times(scale)
        system = replace_fields(self.system, mass=scale * self.system.mass, mass_between=between)
        here = self.displaced(jnp.zeros_like(y))
        step = FullStep.prepare(
            system, here, self.inputs, jnp.ones((), y.dtype), gauss(1), StartCache(None, None)
        )
        # Times of a step of length one, shifted to that of the load; fields act on masses as they are.
        situations = tuple(
            replace_fields(where, t=where.t - 0.5, place=group_places(self.system, group))
            for group, where in zip(step.groups, step.situations, strict=True)
        )
        step = eqx.tree_at(lambda s: s.situations, step, situations)
        resting = y.at[: self.balances].set(0.0)
        every, products = step.matrices(resting, exact=False), step.products(resting)
        doubled = [x.at[:, :w, :w].multiply(2.0) for x, w in zip(every, self._widths)]
        return doubled, tuple(product.times(2.0) for product in products)

    @property
    def _widths(self) -> list[int]:
        """Components of twists among the unknowns of each element; multipliers follow them."""
        groups = (g for g in (*self.system.effects, *self.system.joints) if touches(g))
        between = self.system.mass_between
        coupled = [] if between is None else [2 * between.rates]
        return [TWIST, *coupled, *(rates_of(g) * bodies_of_elements(g).shape[1] for g in groups)]

    def solver(self, y: Float[Array, " unknowns"], weight: Array | float = 0.0) -> Any:
        """What solves equations with the Jacobian at displacements zero, slightly regularised.

        Returns:
            An object with `solve(right)` and `transpose()`.
        """
        (given, products), sparsity = self.matrices(y, weight), self.system.sparsity
        if sparsity is None or self.unknowns <= DENSE:
            return self.inverse(dense(self.system, given, self.unknowns, products=products))
        pulls = (jnp.max(jnp.abs(x[:, w:, :w]), initial=1e-300) for x, w in zip(given, self._widths))
        arms = functools.reduce(jnp.maximum, pulls)
        matrix: Any = sparsity.pattern.assemble(*given)
        found = factorised(sparsity.plan, matrix.with_diagonal(self._shifts(matrix.diagonal(), arms)))
        for product in products:
            found = product.around(found)
        return found

    def inverse(self, matrix: Float[Array, "unknowns unknowns"]) -> Inverse:
        """Inverse of the Jacobian, slightly regularised."""
        arms = jnp.max(jnp.abs(matrix[self.balances :, : self.balances]), initial=1e-300)
        return Inverse(pivoted_inverse(matrix + jnp.diag(self._shifts(jnp.diagonal(matrix), arms))))

    def _shifts(self, diagonal: Float[Array, " unknowns"], arms: Array) -> Float[Array, " unknowns"]:
        """What is added to the diagonal: a compliance of the constraints."""
        stiffness = jnp.max(jnp.abs(diagonal[: self.balances]), initial=0.0)
        shift = SHIFT * arms**2 / jnp.where(stiffness > 0, stiffness, 1.0)
        return jnp.where(jnp.arange(diagonal.shape[0]) < self.balances, 0.0, shift)
