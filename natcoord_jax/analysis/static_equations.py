"""The equations of equilibrium: no resultant force or torque on any body, no gap in any joint.

In a steady rotation inertia is one of the forces: it is an equilibrium in a frame that rotates. Unknowns are
the displacements and rotations of all bodies (Cayley's vectors, along the rates that a body has) from a given
configuration, and the multipliers of all joints and of relations between coordinates. The time of the state
is the parameter of the load: forces, drives and inputs that are functions of time follow it.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.dense import Inverse
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.linsolve.sparse import factorised
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.elimination import pivoted_inverse
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.admissible_velocities import rotor_rates
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.element_matrices import bodies_of_elements, dense, rates_of, touches
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.mechanics.local import body_motion
from natcoord_jax.mechanics.momentum import inertia, wrench
from natcoord_jax.mechanics.node_sweeps import sweep_nodes
from natcoord_jax.mechanics.projection import moved, moving, nearest_coordinates
from natcoord_jax.mechanics.response import stations
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.mechanics.violations import (
    GAP,
    constrained,
    largest,
    rate_size,
    relative,
    violation_rates_of,
    violations_of,
)
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST
from natcoord_jax.model.rows import group_places, row_rates, rows_with_ground
from natcoord_jax.model.tree import gather_slots, start_rates
from natcoord_jax.system import System

NO_MASS = 1e-30
"""Factor on masses that leaves them no weight in the equations, but tells bodies from point masses."""

DENSE = 400
"""Unknowns up to which the Jacobian is inverted as a dense matrix, with pivots."""

BALANCE = 1e-6
"""Largest unbalanced force, relative to the forces that balance each other, of what counts as steady."""

SHIFT = 1e-10
"""Compliance given to constraints, relative to that of the structure: redundant ones share their load. And
the stiffness, relative, along the axis of a rotation that is the rounding of none."""


class Loading(eqx.Module):
    """What acts at one load.

    Attributes:
        inputs: [N, N m].
        rotation: angular velocity of a steady rotation of everything (3,) [rad/s]; None: all is at rest.
        axis: its direction (3,), also where it is zero [-].
        about: a point of its axis (3,) [m].
    """

    inputs: Float[Array, " inputs"]
    rotation: Any = None
    axis: Any = None
    about: Any = None

    def turning(self, rate: Array, rows: Float[Array, "*n 4 3"]) -> tuple[Array, Array]:
        """Velocities and angular velocities of nodes that turn about the axis at a rate [rad/s]."""
        return cross(rate, rows[..., 0, :] - self.about), jnp.broadcast_to(rate, rows[..., 0, :].shape)

    def accelerations(self, rows: Float[Array, "*n 4 3"], rates: Array | float = 0.0) -> Array:
        """Those of rows that move at rates in the frame that rotates: centripetal, and of Coriolis."""
        arms = rows.at[..., 0, :].add(-self.about)
        return cross(self.rotation, cross(self.rotation, arms) + 2.0 * rates)


class Static(eqx.Module):
    """Equations of equilibrium near one configuration.

    Attributes:
        system: compiled system.
        state: the configuration that displacements count from; its time is the load parameter.
        loading: inputs, and the rotation.
    """

    system: System
    state: State
    loading: Loading

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
        """The state, at rest or in steady rotation, after the displacements in `y`."""
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
        if self.loading.rotation is not None:
            state = self.rotating(state, self.loading.rotation)
            state = replace_fields(state, rates=rotor_rates(self.system, state))
        return replace_fields(state, coordinates=nearest_coordinates(self.system, state))

    def rotating(self, state: State, rate: Float[Array, "3"]) -> State:
        """The state with velocities of a rotation of everything; points do not turn."""
        rows, rates = state.rows, self.system.local_rates
        twists = jnp.concatenate(self.loading.turning(rate, rows), axis=1)
        return moving(state, rates.twists(rates.balances(twists[:, None], rows), rows)[:, 0])

    def residual(self, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        """Unbalanced forces [N] and torques [N m], with opposite sign, and gaps [m, -]."""
        return jnp.concatenate([self.forces(y), self.gaps(self.displaced(y))])

    def forces(self, y: Array, rates: Float[Array, " balances"] | None = None) -> Float[Array, " balances"]:
        """Inertia less loads and reactions [N, N m], while displacements change at rates."""
        return self.balanced(jnp.sum(self.wrenches(y, rates), axis=0))

    def balanced(self, wrenches: Float[Array, "bodies 6"]) -> Float[Array, " balances"]:
        """What wrenches on all bodies do along their rates."""
        return self.system.local_rates.balances(wrenches[:, None], self.state.rows)

    def wrenches(self, y: Array, rates: Array | None = None) -> Float[Array, "terms bodies 6"]:
        """Forces and torques of inertia, of loads and of reactions, whose sum vanishes."""
        state = self.displaced(y)
        rows = state.rows
        moving_by = jnp.zeros((rows.shape[0], TWIST), rows.dtype) if rates is None else self.twists(rates)
        velocity, spin = jnp.split(moving_by, 2, axis=1)
        terms = []
        if self.loading.rotation is not None:
            gains = self.loading.accelerations(rows, row_rates(rows, velocity, spin))
            parts = wrench(inertia(self.system, gains)[None], rows[None, :, 1:])
            terms.append([-x[0] for x in parts])
            carried = self.loading.turning(self.loading.rotation, rows)
            velocity, spin = velocity + carried[0], spin + carried[1]
        terms.append(loads(self.system, state, self.loading.inputs, velocity, spin))
        terms.append(self.constraint_loads(state, y))
        return -jnp.stack([jnp.concatenate(x, axis=1) for x in terms])

    def constraint_loads(self, state: State, y: Array) -> tuple[Array, Array]:
        """Forces and torques of the multipliers on all bodies."""
        position, acting, still = self.balances, [], jnp.zeros_like(state.rows[:, 0])
        for group in self.groups:
            size = group.count * group.multipliers
            acting.append((group, y[position : position + size].reshape(group.count, 1, group.multipliers)))
            position += size
        return loads(self.system, state, self.loading.inputs, still, still, acting)

    def gaps(self, state: State) -> Array:
        """What constraints miss."""
        missing = (x.reshape(-1) for x in violations_of(self.system, self.groups, state))
        return jnp.concatenate([jnp.zeros(0, state.q.dtype), *missing])

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
        here = replace_fields(self.displaced(jnp.zeros_like(y)), v=jnp.zeros_like(self.state.v))
        step = FullStep.prepare(
            system, here, self.loading.inputs, jnp.ones((), y.dtype), gauss(1), StartCache(None, None)
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
        if self.loading.rotation is not None:
            bodies, between = np.arange(self.system.local_rates.bodies), self.system.mass_between
            blocks = self.system.mass[:, None, :, None]
            doubled[0] = doubled[0] + self._centrifugal(blocks, bodies[:, None], TWIST)
            if between is not None:
                rows = between.rows
                blocks = jnp.zeros((len(between.blocks), 2, rows, 2, rows), y.dtype)
                blocks = blocks.at[:, 0, :, 1].set(between.blocks)
                blocks = blocks.at[:, 1, :, 0].set(jnp.swapaxes(between.blocks, 1, 2))
                doubled[1] = doubled[1] + self._centrifugal(blocks, between.bodies, between.rates)
        return doubled, tuple(product.times(2.0) for product in products)

    def _centrifugal(self, blocks: Float[Array, "n k r k r"], bodies: Any, components: int) -> Array:
        """Derivatives of wrenches of inertia on some bodies by their twists, by mass of and between them."""
        start, carried = self.state.rows, blocks.shape[2]

        def inertial(twists: Array, blocks: Array, rows: Array) -> Array:
            twists = jnp.pad(twists, ((0, 0), (0, TWIST - components)))
            rows = rows + row_rates(rows, twists[:, :3], twists[:, 3:])
            gains = self.loading.accelerations(rows)[:, :carried]
            momenta = jnp.zeros_like(rows).at[:, :carried].set(jnp.einsum("arbs,bsx->arx", blocks, gains))
            parts = wrench(momenta[None], rows[None, :, 1:])
            return jnp.concatenate([x[0] for x in parts], axis=1)[:, :components]

        still, width = jnp.zeros((bodies.shape[1], components), start.dtype), bodies.shape[1] * components
        found = jax.vmap(jax.jacfwd(inertial), (None, 0, 0))(still, blocks, start[bodies])
        if components == TWIST:
            along = self.system.local_rates.blocks(bodies, rows_with_ground(self.state.q))
            found = along(along(found[:, :, None, :, :, None], 1), 4)
        return found.reshape(-1, width, width)

    @property
    def _widths(self) -> list[int]:
        """Components of twists among the unknowns of each element; multipliers follow them."""
        groups = (g for g in (*self.system.effects, *self.system.joints) if touches(g))
        between = self.system.mass_between
        coupled = [] if between is None else [2 * between.rates]
        return [TWIST, *coupled, *(rates_of(g) * bodies_of_elements(g).shape[1] for g in groups)]

    def solver(self, y: Float[Array, " unknowns"], weight: Array | float = 0.0) -> tuple[Any, Array]:
        """What solves equations with the Jacobian at displacements zero, slightly regularised.

        Returns:
            An object with `solve(right)` and `transpose()`; stiffnesses against what nothing resists.
        """
        (given, products), sparsity = self.matrices(y, weight), self.system.sparsity
        if sparsity is None or self.unknowns <= DENSE:
            return self.inverse(dense(self.system, given, self.unknowns, products=products))
        pulls = (jnp.max(jnp.abs(x[:, w:, :w]), initial=1e-300) for x, w in zip(given, self._widths))
        arms = functools.reduce(jnp.maximum, pulls)
        matrix: Any = sparsity.pattern.assemble(*given)
        shifts, pins = self._shifts(matrix.multiply, matrix.diagonal(), arms)
        found = factorised(sparsity.plan, matrix.with_diagonal(shifts))
        for product in products:
            found = product.around(found)
        return found, pins

    def inverse(self, matrix: Float[Array, "unknowns unknowns"]) -> tuple[Inverse, Array]:
        """Inverse of the Jacobian, slightly regularised, and what holds motions that nothing resists."""
        arms = jnp.max(jnp.abs(matrix[self.balances :, : self.balances]), initial=1e-300)
        shifts, pins = self._shifts(lambda x: matrix @ x, jnp.diagonal(matrix), arms)
        return Inverse(pivoted_inverse(matrix + jnp.diag(shifts))), pins

    def _shifts(
        self, multiply: Callable[[Array], Array], diagonal: Float[Array, " unknowns"], arms: Array
    ) -> tuple[Array, Array]:
        """What is added to the diagonal: compliances of constraints, stiffnesses where there are none."""
        stiffness = jnp.max(jnp.abs(diagonal[: self.balances]), initial=0.0)
        size = jnp.where(stiffness > 0, stiffness, 1.0)
        pins, balances = jnp.zeros_like(diagonal), jnp.arange(diagonal.shape[0]) < self.balances
        if self.loading.rotation is not None:
            (turn, shift), free, _ = self.free_motions()
            pull = jnp.max(jnp.abs(multiply(jnp.zeros_like(diagonal).at[: self.balances].set(shift))))
            free = free & jnp.stack([True, pull <= SHIFT * size * jnp.max(jnp.abs(shift))])
            # Each by one of its rates, that which takes most of its energy.
            moment = jnp.trace(self.system.mass[:, 1:, 1:], axis1=1, axis2=2)
            parts = jnp.repeat(jnp.stack([self.system.mass[:, 0, 0], moment], axis=1), 3, axis=1)
            energies = jnp.stack([turn, shift]) ** 2 * self.system.local_rates.picked(parts[:, None])
            pins = pins.at[jnp.argmax(energies, axis=1)].max(jnp.where(free, size / SHIFT, 0.0))
        return jnp.where(balances, pins, SHIFT * arms**2 / size), pins

    def free_motions(self) -> tuple[Float[Array, "2 balances"], Bool[Array, "2"], Float[Array, "2"]]:
        """Turn of everything about the axis and shift along it, whether constraints admit them; inertias."""
        rows, rates, groups = self.state.rows, self.system.local_rates, constrained(self.system)

        def motion(velocity: Array, spin: Array) -> tuple[Array, Array, Array]:
            w = self.balanced(jnp.concatenate([velocity, spin], axis=1))
            state = moving(self.state, rates.twists(w, rows)[:, 0])
            changes = relative(self.system, groups, violation_rates_of(self.system, groups, state, 0.0))
            size = rate_size(self.system, state)
            moment = jnp.sum(state.row_rates * inertia(self.system, state.row_rates))
            return w, (largest(changes) <= GAP * size) & (size > 0), moment

        velocity, spin = self.loading.turning(self.loading.axis, rows)
        return jax.vmap(motion)(jnp.stack([velocity, spin]), jnp.stack([spin, jnp.zeros_like(spin)]))

    def turned(self) -> "Static":
        """The same when everything has turned on by a radian."""
        state, axis = self.state, self.loading.axis
        arms = state.rows[:, 0] - self.loading.about
        shifts = arms @ from_rotation_vector(axis).T - arms
        twists = jnp.concatenate([shifts, jnp.broadcast_to(axis, arms.shape)], axis=1)
        increments = state_rates(self.system, self.rotating(state, axis))
        return replace_fields(self, state=moved(self.system, state, twists, increments))

    def pulls(self, wrenches: Float[Array, "terms bodies 6"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
        """Torque about the axis [N m] and force along it [N] that nothing balances; if both are slight."""
        motions, free, inertias = self.free_motions()
        terms = jax.vmap(self.balanced)(wrenches)
        pulls = jnp.where(free, motions @ jnp.sum(terms, axis=0), 0.0)
        # Where forces cancel in each of the terms, in terms of centrifugal ones.
        sizes = jnp.sum(self.loading.rotation**2) * jnp.sqrt(inertias[0] * inertias)
        sizes = sizes + jnp.abs(motions) @ jnp.sum(jnp.abs(terms), axis=0)
        return pulls, jnp.all(jnp.abs(pulls) <= BALANCE * sizes)
