"""Projection of a state onto the constraints, as one step of a body system without forces.

Positions: a step of unit size from rest, 2 M V = G(q_mid)^T lambda with g(q_0) + G(q_mid) V = 0, which for
quadratic constraints is g(q_1) = 0. Velocities: a step of size zero, 2 M (V - v_0) = G^T lambda, G V = 0.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.assembly.diagnostics import joint_residuals
from natcoord_jax.assembly.form import Form
from natcoord_jax.assembly.full import FullStep
from natcoord_jax.assembly.system import System
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss


def constraints_only(system: System) -> System:
    """The system without effects other than relations between coordinates, its inertia made regular.

    Ideal rods get a small inertia about their axis, and nodes without rotary inertia one like that of a
    point mass; these only weigh how a gap is shared.
    """
    relations = tuple(g for g in system.effects if g.multipliers)
    moment = system.mass[:, 1:, 1:]
    size = jnp.trace(moment, axis1=1, axis2=2)
    filled = moment + jnp.where(size > 0, 1e-3 * size, 1.0)[:, None, None] * jnp.eye(3)
    mass = system.mass.at[:, 1:, 1:].set(filled)
    return replace_fields(system, effects=relations, mass=mass)


class Projection(Form):
    """Equations of a projection; same interface as the equations of a step."""

    step: FullStep
    offset: Float[Array, " rows"]
    extent: Float[Array, ""]

    @classmethod
    def of_positions(cls, system: System, state: State) -> "Projection":
        """Positions of `state` with orthonormal directors; its velocities play no part."""
        bare = constraints_only(system)
        resting = replace_fields(
            state, v=jnp.zeros_like(state.v), t=state.t - 1.0, rates=jnp.zeros_like(state.rates)
        )
        inputs = jnp.zeros(len(system.structure.inputs))
        step = FullStep.prepare(bare, resting, inputs, jnp.ones(()), gauss(1))
        gaps = [jnp.zeros(g.count * g.multipliers) for g in bare.effects]
        gaps += [value.reshape(-1) for _, value, _ in joint_residuals(bare, resting)]
        points = state.q.reshape(-1, 4, 3)[:, 0]
        extent = jnp.sqrt(jnp.sum(system.mass[:, 0, 0])) * (1e-3 + jnp.max(jnp.abs(points)))
        return cls(step, jnp.concatenate(gaps) if gaps else jnp.zeros(0), extent)

    @classmethod
    def of_velocities(cls, system: System, state: State) -> "Projection":
        """Velocities of `state` at its positions."""
        bare = constraints_only(system)
        inputs = jnp.zeros(len(system.structure.inputs))
        step = FullStep.prepare(bare, state, inputs, jnp.zeros(()), gauss(1))
        return cls(step, jnp.zeros(step.unknowns - step.balances), jnp.zeros(()))

    @property
    def system(self) -> System:
        """The system without its effects."""
        return self.step.system

    @property
    def balances(self) -> int:
        """Number of balance equations."""
        return self.step.balances

    @property
    def tableau(self) -> Tableau:
        """One stage."""
        return self.step.tableau

    def guess(self) -> Float[Array, " unknowns"]:
        """That of the step."""
        return self.step.guess()

    def residual(self, y: Float[Array, " unknowns"]) -> tuple[Array, Array]:
        """Residual of the step with the initial gaps added to the constraint rows."""
        residual, size = self.step.residual(y)
        return residual.at[self.balances :].add(self.offset), size + self.extent

    def jacobian(self, y: Float[Array, " unknowns"]) -> Array:
        """That of the step."""
        return self.step.jacobian(y)

    def tangent(self, y: Float[Array, " unknowns"]) -> Array:
        """The same."""
        return self.step.jacobian(y)

    def inertias(self, matrix: Float[Array, "unknowns unknowns"]) -> Float[Array, " balances"]:
        """Inertias of the rates."""
        return jnp.abs(jnp.diagonal(matrix))[: self.balances]

    def moved(self, y: Float[Array, " unknowns"]) -> Float[Array, "rows 3"]:
        """Mean velocities of all rows: the displacement of positions, or the projected velocities."""
        return self.step.motion_of(y).rates[0, :-1].reshape(-1, 3)
