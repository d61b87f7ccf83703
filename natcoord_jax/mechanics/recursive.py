"""Equations of a step on an open tree: those of `ReducedStep`, with loops along the tree node by node.

A node is a body with the rates of its joint (and multipliers of drives and couplings on it). Every effect
couples a body with its neighbour at most, so that the Jacobian is kept as blocks, see `linsolve.tree`: twists
are passed down, forces and torques are handed up. What moves freely follows its neighbour in the elimination
only: its motion is its own.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.linsolve import neighbours
from natcoord_jax.linsolve import tree as tree_solver
from natcoord_jax.linsolve.refinement import RefinedSolver
from natcoord_jax.maths.collocation import rotate_stages
from natcoord_jax.maths.components import products
from natcoord_jax.mechanics.effect_blocks import borders, by_place, seated, with_coupling, with_multipliers
from natcoord_jax.mechanics.joint_blocks import joint_blocks, rooted_blocks
from natcoord_jax.mechanics.local import jacobians
from natcoord_jax.mechanics.momentum import momentum_balance
from natcoord_jax.mechanics.node_sweeps import Geometry, hinging, load_nodes, on_slots, sweep_nodes
from natcoord_jax.mechanics.reduced import ReducedStep
from natcoord_jax.mechanics.response import StageKinematics, no_multipliers
from natcoord_jax.model.groups import Elimination
from natcoord_jax.model.node_layout import ByNode, NodeLayout, unknowns_of_slots
from natcoord_jax.model.tree import TreeMotion, gather_slots

Blocks = tuple[Array, ...]
"""Blocks of a Jacobian: A, (X, Z), (T, S) and N of `linsolve.tree`; or, where all bodies hang on the ground
and nothing has multipliers, those of `linsolve.neighbours`."""


class RecursiveStep(ReducedStep):
    """One step on an open tree of bodies."""

    by_differences = False
    by_formulas = True
    renewal = 8

    @property
    def elimination(self) -> Elimination:
        """Order of elimination; a system that is solved recursively has one."""
        assert self.system.elimination is not None
        return self.system.elimination

    @property
    def layout(self) -> NodeLayout:
        """Where the unknowns sit in the nodes."""
        return NodeLayout(
            self.system.tree,
            self.elimination.slots,
            self.elimination.places,
            tuple((g.count, g.multipliers) for g in self.groups),
            self.tableau.stages,
        )

    def motion(self, w: Float[Array, "s unknowns"]) -> tuple[TreeMotion, Geometry]:
        """Stage motion of the bodies at given rates."""
        slots = gather_slots(self.system.tree, w)
        return sweep_nodes(self.system.tree, self.frames, self.start, slots, self.h, self.tableau)

    def generalised(
        self, geometry: Geometry, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
    ) -> Float[Array, "s unknowns"]:
        """Generalised forces of the free motions."""
        tree = self.system.tree
        through = load_nodes(tree, geometry, force, torque)
        return unknowns_of_slots(tree, on_slots(tree, geometry, through))

    def jacobian(self, y: Float[Array, " unknowns"], *, exact: bool = True, loads: Any = None) -> Blocks:
        """Blocks of the Jacobian; loads as in `tangent`."""
        tree = self.system.tree
        w, multipliers = self.split(y)
        motion, geometry = self.motion(w)
        at = self.stations(motion)
        if loads is None:
            given = self.system, self.groups, self.situations, at, self.velocity
            found = momentum_balance(*given, multipliers, self.h, self.tableau)
            loads = found.force, found.torque
        these = hinging(tree, self.frames, self.start)
        present = tree.slot_index[:, np.array(tree.slots, int)] < tree.slot_of.shape[0]
        rates, through = gather_slots(tree, w), load_nodes(tree, geometry, *loads)
        rest = rates, geometry, through, self.h, self.tableau
        if self._alone:
            return self._between_neighbours(
                at, multipliers, rooted_blocks(tree, these, present, *rest), exact
            )
        return self._with_effects(at, multipliers, joint_blocks(tree, these, present, at.spin, *rest), exact)

    @property
    def _alone(self) -> bool:
        """Whether nothing is carried and nothing has multipliers: nodes see the rates of their neighbour."""
        return len(self.system.tree.levels) == 1 and not self.elimination.slots.shape[1]

    def tangent(self, y: Float[Array, " unknowns"], loads: Any = None) -> Blocks:
        """The Jacobian nearly, from linearised effects: what Newton's iteration needs.

        Args:
            y: unknowns.
            loads: of the equations evaluated there, see `Evaluation.loads`; None: they are evaluated.
        """
        return self.jacobian(y, exact=False, loads=loads)

    def like_tangent(self, y: Float[Array, " unknowns"]) -> Any:
        """Shapes of the blocks."""
        loads = jax.ShapeDtypeStruct((self.tableau.stages, len(self.system.structure.bodies), 3), y.dtype)
        return jax.eval_shape(self.tangent, y, (loads, loads))

    def factorised(self, matrix: Blocks) -> tuple[ByNode, Float[Array, " unknowns"]]:
        """Factors along the tree, and the inertias of the unknowns (0 for multipliers)."""
        blocks, factor = self._by_node(matrix)
        factors, diagonal = factor(blocks)
        inertias = self.layout.flat(jnp.abs(diagonal)).at[self.balances :].set(0.0)
        return ByNode(self.layout, factors), inertias

    def differentiable(self, matrix: Blocks) -> ByNode:
        """The same, refined and differentiable."""
        blocks, factor = self._by_node(matrix)
        return ByNode(self.layout, RefinedSolver(blocks, factor(blocks)[0]))

    def _by_node(self, matrix: Blocks) -> tuple[Any, Any]:
        """A matrix in blocks, by what couples its nodes, and its factorisation."""
        following = self.system.tree.neighbour
        if self._alone:
            own, above, below = matrix
            return neighbours.NeighbourBlocks(own, above, below, following), neighbours.factor
        own, spread, gather, rest = matrix
        blocks = tree_solver.TreeBlocks(own, spread, gather, rest, following, self.layout.rates)
        return blocks, tree_solver.factor

    def _between_neighbours(
        self, at: StageKinematics, multipliers: list[Array], joints: tuple, exact: bool
    ) -> Blocks:
        """Blocks of bodies whose parent is the ground, without multipliers, by the rates of neighbours."""
        own, coupled, _ = self._of_bodies(at, multipliers, exact)
        neighbour = self.system.tree.neighbour
        empty = jnp.zeros_like(own)
        upward, downward = (-sum(blocks, empty) for blocks in zip(*coupled)) if coupled else (empty, empty)
        moved, pulled, bent = joints
        moved_p, pulled_p = (jnp.concatenate([x, jnp.zeros_like(x[:1])])[neighbour] for x in (moved, pulled))
        left = jnp.stack([pulled, pulled, pulled_p])
        right = jnp.stack([moved, moved_p, moved])
        own, above, below = products(products(left, jnp.stack([own, upward, downward])), right)
        return own + bent, above, below

    def _with_effects(
        self, at: StageKinematics, multipliers: list[Array], joints: tuple, exact: bool
    ) -> Blocks:
        """Blocks with those of bodies and effects, and with the multipliers of each node."""
        own, coupled, bordered = self._of_bodies(at, multipliers, exact)
        if coupled:
            upward, downward = (-jnp.sum(jnp.stack(blocks), axis=0) for blocks in zip(*coupled))
            joints = with_coupling(joints, upward, downward)
        if bordered:
            joints = with_multipliers(joints, self.layout, bordered)
        return own, *joints

    def _of_bodies(
        self, at: StageKinematics, multipliers: list[Array], exact: bool
    ) -> tuple[Array, list[tuple[Array, Array]], list]:
        """Derivatives by twists: of each body's own balance, of couplings both ways, of multipliers."""
        twists = jnp.concatenate([at.rates[:, :, 0], at.spin], axis=-1)
        own, every = self._own(twists[:, :-1]), jnp.moveaxis(twists, 0, 1)
        coupled, bordered = [], []
        for group, where, lam, seats in zip(
            self.groups, self.situations, multipliers, self.elimination.seats
        ):
            if group.source == "mass":
                continue
            (by_twist, by_lam), (g_by_twist, g_by_lam) = jacobians(
                group, where, self.tableau, at.start[group.bodies], every[group.bodies], lam, exact=exact
            )
            places = seated(group.bodies, own.shape[0])
            both, upward, downward, above = by_place(by_twist, places)
            own = own - seats.nodes.collect(both) - seats.parents.collect(above)
            coupled.append((seats.nodes.collect(upward), seats.nodes.collect(downward)))
            if group.multipliers:
                bordered.append((*borders(by_lam, g_by_twist, places), jnp.moveaxis(g_by_lam, 1, 2)))
        return own, coupled, bordered

    def _own(self, twists: Float[Array, "s bodies 6"]) -> Float[Array, "bodies n n"]:
        """Derivatives of the balances of single bodies under fields, by their own twists."""
        s, bodies, _ = twists.shape
        fields = [pair for pair in zip(self.groups, self.situations) if pair[0].source == "mass"]
        groups, situations = [g for g, _ in fields], [where for _, where in fields]
        multipliers = [no_multipliers(g, self.tableau, twists.dtype) for g in groups]

        def balance(twists: Array) -> Array:
            velocity, spin = jnp.split(twists, 2, axis=-1)
            directors = rotate_stages(self.h * spin[:, :, None], self.start[None, :, 1:], self.tableau)
            at = self.stations(TreeMotion(spin, velocity, directors))
            given = self.system, groups, situations, at, self.velocity
            found = momentum_balance(*given, multipliers, self.h, self.tableau)
            return jnp.concatenate([found.force, found.torque], axis=-1)

        def along(unit: Array) -> Array:
            return jax.jvp(balance, (twists,), (jnp.broadcast_to(unit[:, None], twists.shape),))[1]

        columns = jax.vmap(along)(jnp.eye(6 * s).reshape(-1, s, 6))
        return jnp.transpose(columns, (2, 1, 3, 0)).reshape(bodies, 6 * s, 6 * s)
