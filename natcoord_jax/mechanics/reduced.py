"""Equations of a step in the joint null space: rates of the spanning tree and multipliers of loops.

Unknowns y: mean rates w of the tree's free motions, stage by stage, then the multipliers of the joints that
close loops and of relations between coordinates.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.dense import Inverse
from natcoord_jax.linsolve.stages import fitted, stagewise_inverse
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.projectors import range_projector
from natcoord_jax.maths.vectors import dot
from natcoord_jax.mechanics.block_tangent_space import Tangents, tangents_at, with_system
from natcoord_jax.mechanics.equations_of_motion import constraint_matrix
from natcoord_jax.mechanics.momentum import least_inertias
from natcoord_jax.mechanics.redundancy import (
    contact_mobilities,
    least_change,
    places_by_stage,
)
from natcoord_jax.mechanics.response import (
    StageKinematics,
    stations,
)
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.mechanics.step_equations import StepEquations
from natcoord_jax.mechanics.sweeps import sweep_motion, turned_directors
from natcoord_jax.mechanics.tangent_space import TangentSpace
from natcoord_jax.model.axisymmetric_axes import frame_axes
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.tree import SLOTS, TreeMotion, gather_slots, project, start_rates, turns

PROBE = 1e-6
"""Change of a rotation [rad] that gives a column of the Jacobian."""


def active_groups(system: Model) -> tuple[Group, ...]:
    """Groups that take part in the equations: all effects and the joints that close loops."""
    return (*system.effects, *(g for g in system.joints if not g.in_tree))


def at_rest(step: Any) -> Any:
    """The same equations for a step of length zero and one stage, where they are linear."""
    situations = [
        replace_fields(where, inputs=where.inputs[:, 0]) if where.inputs.ndim == 3 else where
        for where in step.situations
    ]
    return replace_fields(
        step,
        h=jnp.zeros_like(step.h),
        situations=tuple(situations),
        start_cache=NOTHING,
        tableau=gauss(1),
    )


class ReducedStep(StepEquations):
    """One step in the joint null space: all that does not depend on the unknowns, and the equations."""

    by_differences = True

    frames: Float[Array, "bodies 2 4 4"]

    @classmethod
    def groups_of(cls, system: Model) -> tuple[Group, ...]:
        """Those that take part in the equations."""
        return active_groups(system)

    @classmethod
    def geometry_of(cls, system: Model, state: State) -> dict[str, Array]:
        """Rows at the start, and the frames of the joints of the tree."""
        return {"start": state.rows, "frames": system.tree.frames(system.frames)}

    @classmethod
    def held_range(cls, system: Model, state: State, rank: int, tangents: Tangents | None) -> Array:
        """That of the tangent space, if it is known."""
        if isinstance(tangents, TangentSpace) and tangents.admissible.range is not None:
            return tangents.admissible.range
        return range_projector(constraint_matrix(system, state), rank, least_change(system))

    @property
    def balances(self) -> int:
        """Number of balance equations; the rest are constraints."""
        return self.system.structure.unknowns * self.tableau.stages

    def rates(self, y: Float[Array, " balances"]) -> Float[Array, "s unknowns"]:
        """Rates of the tree, stage by stage."""
        return y.reshape(self.tableau.stages, self.system.structure.unknowns)

    def moved(self, w: Float[Array, "s unknowns"]) -> tuple[StageKinematics, Any]:
        """Motion as the effects see it, and the geometry of the joints where forces take hold."""
        motion, geometry = self.motion(w)
        at = self.stations(motion)
        if self.tableau.variational:
            return replace_fields(at, force_rows=at.start[None]), at_rest(self).motion(w)[1]
        return at, geometry

    def motion(self, w: Float[Array, "s unknowns"]) -> tuple[TreeMotion, Any]:
        """Stage motion of the bodies at given rates, and the geometry of the joints."""
        slots = gather_slots(self.system.tree, w)
        turned = None
        if self._swings:
            # Another basis of the same motion: derivatives need not know how it turns.
            turned = turned_directors(self.start, self.velocity, self.h, self.tableau)
            turned = jax.lax.stop_gradient(turned)
        given = self.frames, self.start, slots, self.h, self.tableau, turned
        return sweep_motion(self.system.tree, *given)

    @property
    def _swings(self) -> bool:
        """Whether the axes of free bodies' rates turn with them within a step of several stages.

        Along these, springs between the bodies act nearly alike at all stages, however stiff they are.
        """
        elastic = any(group.effect.elastic for group in self.groups)
        return elastic and self.tableau.stages > 1 and bool(self.system.tree.free.members)

    def generalised(
        self, geometry: Any, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
    ) -> Float[Array, "s unknowns"]:
        """Generalised forces of the free motions from forces and torques at the reference points."""
        return project(self.system.tree, geometry, force, torque)[0]

    def stations(self, motion: TreeMotion) -> StageKinematics:
        """Motion as the effects see it."""
        a = self.h * jnp.asarray(self.tableau.a, motion.velocity.dtype)
        points = self.start[:, 0] + jnp.sum(a[:, :, None, None] * motion.velocity, axis=1)
        return stations(self.start, points, motion.directors, motion.velocity, motion.spin)

    def guess(self) -> Float[Array, " unknowns"]:
        """Rates of the velocities at the start, repeated for every stage; multipliers zero."""
        return self.repeated(start_rates(self.system.tree, self.frames, self.start, self.velocity))

    def by_stage(self, y: Float[Array, " unknowns"]) -> Float[Array, "s rates"]:
        """Rates among the unknowns, or balances among the equations."""
        return y[: self.balances].reshape(self.tableau.stages, -1)

    def repeated(self, w: Float[Array, " rates"]) -> Float[Array, " unknowns"]:
        """The same at all stages; multipliers zero."""
        return self.with_multipliers(jnp.tile(w, self.tableau.stages))

    def jacobian(self, y: Float[Array, " unknowns"]) -> Float[Array, "unknowns unknowns"]:
        """Exact Jacobian of the residual."""
        return jax.jacfwd(lambda x: self.residual(x)[0])(y)

    def tangent(self, y: Float[Array, " unknowns"], loads: Any = None) -> Any:
        """What Newton's iteration takes for the Jacobian where it does not form it by differences."""
        return self.jacobian(y)

    @property
    def stage_places(self) -> np.ndarray:
        """Places (s, n) among the unknowns of the rates and multipliers of each stage."""
        stages, count = self.tableau.stages, self.system.structure.unknowns
        rates = np.arange(stages * count).reshape(stages, count)
        return np.concatenate([rates, self.balances + places_by_stage(self.groups, stages)], axis=1)

    def factorised_alike(
        self, columns: Float[Array, "n unknowns"]
    ) -> tuple[Inverse, Float[Array, " unknowns"]]:
        """Factors as of `factorised`, with what changes little within a step taken for constant.

        Args:
            columns: what changes do that are the same at all stages, one a row.
        """
        places, count = self.stage_places, self.system.structure.unknowns
        size = places.size
        alike = jnp.moveaxis(columns[:, places], 0, -1)
        own = self.own_inertia()
        inertia = jnp.zeros(alike.shape[1:], alike.dtype).at[:count, :count].set(own)
        damping, stiffness = fitted(alike, inertia, count, self.tableau)
        stages = jnp.asarray(np.stack([np.diag(self.tableau.a_inverse), np.diag(self.tableau.a)]))
        found = stages[0, :, None] * jnp.diagonal(inertia) + jnp.diagonal(damping)
        found = (found + stages[1, :, None] * jnp.diagonal(stiffness))[:, :count]
        inertias = self._at_least(jnp.abs(found).reshape(-1))
        inverse = stagewise_inverse(
            inertia, damping, stiffness, inertias[:count], self.tableau, dependent=self.dependent
        )
        whole = jnp.zeros((size, size), inverse.dtype)
        whole = whole.at[places[:, :, None, None], places[None, None, :, :]].set(inverse)
        return Inverse(whole), jnp.zeros(size, inverse.dtype).at[: self.balances].set(inertias)

    def own_inertia(self) -> Float[Array, "unknowns unknowns"]:
        """Inertia of the free motions at the start of the step, P^T M P."""
        tangents = self.start_cache.tangents
        if tangents is None:
            tangents = tangents_at(self.system, self.state)
        tangents = with_system(tangents, self.system)
        tree = self.system.tree
        body, kind, axis = tree.slot_of // SLOTS, tree.slot_of % SLOTS // 3, tree.slot_of % SLOTS % 3
        above = jnp.concatenate([self.start[:, 1:], jnp.eye(3, dtype=self.start.dtype)[None]])[tree.parent]
        parent = frame_axes(self.frames[:, 0, 1:, 1:], above[None])[0][body, axis]
        own = tree.ball_axes(self.frames, self.start[:, 1:])[0][body, axis]
        # There rates are along the axes of the parent, here those of balls along their own.
        together = (body[:, None] == body) & (kind[:, None] == kind)
        cosines = jnp.where(together, dot(parent[:, None], own), 0.0)
        balls = tree.ball if tree.directed is None else tree.ball & ~tree.directed
        turned = jnp.where(balls[body], cosines, jnp.eye(body.size, dtype=cosines.dtype))
        return turned.T @ tangents.inertia @ turned

    def inertias(self, matrix: Float[Array, "unknowns unknowns"]) -> Float[Array, " balances"]:
        """Inertias of the rates, from the Jacobian and from the mass.

        Kicks take up what moves against constraints: in the Jacobian the inertia of a rate that is
        prescribed, or that loops forbid, is missing.
        """
        return self._at_least(jnp.abs(jnp.diagonal(matrix))[: self.balances])

    def least_inertias(self) -> Float[Array, " balances"]:
        """Inertias that the rates have at least, by the mass of their own bodies; the same in every step."""
        body, slot = self.system.tree.slot_of // SLOTS, self.system.tree.slot_of % SLOTS
        return self._by_stage(least_inertias(self.system.mass)[body, turns(slot).astype(int)])

    def _at_least(self, found: Float[Array, " balances"]) -> Float[Array, " balances"]:
        """Inertias, none less than that of the mass at its stage."""
        if self.start_cache.tangents is None:
            return found
        return jnp.maximum(found, self._by_stage(jnp.diagonal(self.own_inertia())))

    def _by_stage(self, inertias: Float[Array, " rates"]) -> Float[Array, " balances"]:
        """Of the mass at every stage."""
        stages = jnp.diagonal(jnp.asarray(self.tableau.a_inverse, inertias.dtype))
        return (stages[:, None] * inertias).reshape(-1)

    def probes(self, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        """Changes of the unknowns that give columns of the Jacobian as quotients of differences.

        Small against a radian and against the extent of the system, so that the equations are
        nearly linear in them. In multipliers they are linear exactly; there a change as large as the
        multiplier itself loses no digits, which constraints on a light part between heavy ones cannot spare.
        """
        mass = self.system.mass
        total = mass[:, 0, 0]
        gyration = jnp.trace(mass[:, 1:, 1:], axis1=1, axis2=2) / jnp.where(total > 0, total, 1.0)
        apart = jnp.max(jnp.abs(self.start[:, 0] - self.start[0, 0]))
        extent = jnp.sqrt(jnp.max(gyration)) + jnp.max(jnp.abs(self.frames[:, :, 0, 1:])) + apart
        extent = jnp.where(extent > 0, extent, 1.0)
        turning = jnp.ones((self.start.shape[0], 3), mass.dtype)
        scales = jnp.concatenate([turning, extent * turning, turning[:, :1]], axis=1)
        rates = PROBE / self.h * scales.reshape(-1)[self.system.tree.slot_of]
        multipliers = 1.0 + jnp.abs(y[self.balances :])
        if self.system.structure.inequalities:
            # Those of contacts by as little, and downwards: the smaller of gap and impulse vanishes, and
            # where both do, that is the impulse.
            speed, mobility = PROBE / self.h * extent, contact_mobilities(self)
            lower = -2.0 * speed / jnp.where(mobility > 0, mobility, 1.0)
            multipliers = jnp.where(mobility > 0, lower, multipliers)
        return jnp.concatenate([jnp.tile(rates, self.tableau.stages), multipliers])
