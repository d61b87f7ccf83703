"""Equations of a step: what they are in every null space, and what a null space adds.

Unknowns y: mean rates of the free motions, then the multipliers (times the step) of each group of
constraints. Residual: the momentum balance of the step (57) projected on the free motions,
P^T [M sum_j (A^-1)_ij (V_j - v_0) - h F_i - G_i^T lambda_i], then the rates of the constraints. Working with
rates and multipliers times h keeps the equations of one size as h goes to zero.
"""

from abc import abstractmethod
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.state import State
from natcoord_jax.linsolve.dense import DenseSolver, Inverse, saddle_inverse
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.block_tangent_space import Tangents, with_system
from natcoord_jax.mechanics.dissipation import Damped, Damping
from natcoord_jax.mechanics.grain import cancelling_size
from natcoord_jax.mechanics.kick import kicked
from natcoord_jax.mechanics.momentum import momentum_balance
from natcoord_jax.mechanics.redundancy import at_every_stage, project_multipliers, project_rows
from natcoord_jax.mechanics.response import Evaluation, GroupData, StageKinematics, situation
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model


class Form(eqx.Module):
    """Base of the equations of a step, and of projections; with one dense matrix, unless a form overrides it.

    A form has `balances`, `inertias(matrix)`, `guess()`, `residual(y)`, `jacobian(y)`, `tangent(y, loads)`;
    the equations of a step have `least_inertias()`, too.

    Class attributes:
        by_differences: whether Newton's iteration forms the Jacobian by differences: there are no formulas.
        by_formulas: whether `jacobian` is exact by formulas, at any order without kicks.
        renewal: cost of new factors in corrections of Newton's iteration, where there are formulas.
    """

    by_differences: ClassVar[bool] = False
    by_formulas: ClassVar[bool] = False
    renewal: ClassVar[int] = 6

    @property
    def exact_by_formulas(self) -> bool:
        """Whether `jacobian` is, for this system."""
        return self.by_formulas

    @property
    def dependent(self) -> bool:
        """Whether constraints may depend on each other."""
        return True

    def like_tangent(self, y: Float[Array, " unknowns"]) -> Any:
        """Something of the shape of `tangent(y)`, to know the shape of its factors without tracing it."""
        return jax.ShapeDtypeStruct((y.shape[0], y.shape[0]), y.dtype)

    @property
    def grain(self) -> Float[Array, ""]:
        """Size of the terms that cancel in the equations [sqrt(J)], see `natcoord_jax.mechanics.grain`."""
        return jnp.zeros(())

    def factorised(self, matrix: Any) -> tuple[Any, Float[Array, " unknowns"]]:
        """Factors of a Jacobian, with `solve` and `transpose`, and the inertias of the unknowns.

        Inertias are 0 for multipliers.
        """
        equations: Any = self
        inertias = equations.inertias(matrix)
        every = jnp.zeros(matrix.shape[0], matrix.dtype).at[: inertias.shape[0]].set(inertias)
        return Inverse(saddle_inverse(matrix, inertias, dependent=equations.dependent)), every

    def differentiable(self, matrix: Any) -> Any:
        """A solver whose solutions are differentiable in every mode."""
        return dense_solver(self, matrix)


def dense_solver(equations: Any, matrix: Float[Array, "unknowns unknowns"]) -> DenseSolver:
    """The solver with one dense matrix, whatever the form is."""
    inverse = saddle_inverse(matrix, equations.inertias(matrix), dependent=equations.dependent)
    return DenseSolver(matrix, inverse, equations.balances)


SomeStep = TypeVar("SomeStep", bound="StepEquations")


class StepEquations(Form):
    """One step: all that does not depend on the unknowns, and the equations.

    Attributes:
        system: compiled system.
        state: at the start.
        start: rows of the bodies there; a form may have those of the ground behind them.
        velocity: of the rows there.
        situations: of the groups, in the order of their multipliers.
        h: step [s].
        start_cache: what is known of the start.
        tableau: the collocation method.
    """

    system: Model
    state: State
    start: Float[Array, "bodies 4 3"]
    velocity: Float[Array, "bodies 4 3"]
    situations: tuple[GroupData, ...]
    h: Float[Array, ""]
    start_cache: StartCache
    tableau: Tableau = eqx.field(static=True)

    @classmethod
    def prepare(
        cls: type["SomeStep"],
        system: Model,
        state: State,
        u: Array,
        h: Array,
        tableau: Tableau,
        start_cache: StartCache | None = None,
    ) -> "SomeStep":
        """Gather what the step needs, once.

        Args:
            system: compiled system.
            state: at the start.
            u: inputs.
            h: step [s].
            tableau: the collocation method.
            start_cache: what is known of the start, see `starting`; None: found here.
        """
        return cls(
            system=system,
            state=state,
            velocity=state.row_rates,
            situations=tuple(situation(system, g, state, u, h) for g in cls.groups_of(system)),
            h=h,
            start_cache=cls.starting(system, state, tableau) if start_cache is None else start_cache,
            tableau=tableau,
            **cls.geometry_of(system, state),
        )

    @classmethod
    @abstractmethod
    def groups_of(cls, system: Model) -> tuple[Group, ...]:
        """Groups with a part in the equations, in the order of their multipliers."""

    @classmethod
    @abstractmethod
    def geometry_of(cls, system: Model, state: State) -> dict[str, Array]:
        """`start`, and fields that a form has besides."""

    @classmethod
    @abstractmethod
    def held_range(cls, system: Model, state: State, rank: int, tangents: Tangents | None) -> Array:
        """Projector on the range of the constraints of one stage, which depend on each other."""

    @classmethod
    def starting(
        cls,
        system: Model,
        state: State,
        tableau: Tableau,
        tangents: Tangents | None = None,
        later: bool = False,
    ) -> StartCache:
        """What a step needs of its start, see `StartCache.of`."""
        projector, rank = None, system.structure.rank
        if rank is not None:
            projector = cls.held_range(system, state, rank, tangents)
            projector = at_every_stage(projector, cls.groups_of(system), tableau.stages)
        return StartCache.of(system, state, tableau, projector, tangents, later)

    @property
    @abstractmethod
    def balances(self) -> int:
        """Number of balance equations; the rest are constraints."""

    @abstractmethod
    def rates(self, y: Float[Array, " balances"]) -> Array:
        """Rates of the free motions as the form arranges them."""

    @abstractmethod
    def moved(self, w: Array) -> tuple[StageKinematics, Any]:
        """Motion at given rates as the effects see it, and the geometry that `generalised` asks for."""

    @abstractmethod
    def generalised(
        self, geometry: Any, force: Float[Array, "s bodies 3"], torque: Float[Array, "s bodies 3"]
    ) -> Array:
        """Generalised forces of the free motions from forces and torques at the reference points.

        In the order of the balances.
        """

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups with a part in the equations, in the order of their multipliers."""
        return self.groups_of(self.system)

    @property
    def dependent(self) -> bool:
        """Whether constraints depend on each other."""
        return bool(self.system.structure.redundant)

    @property
    def grain(self) -> Float[Array, ""]:
        """Size of the terms that cancel in the forces [sqrt(J)]."""
        return cancelling_size(self)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.balances + self.tableau.stages * sum(g.count * g.multipliers for g in self.groups)

    def split(self, y: Float[Array, " unknowns"]) -> tuple[Array, list[Array]]:
        """Rates, see `rates`, and multipliers of each group (n, s, m)."""
        position, multipliers = self.balances, []
        for group in self.groups:
            shape = group.count, self.tableau.stages, group.multipliers
            size = group.count * self.tableau.stages * group.multipliers
            multipliers.append(y[position : position + size].reshape(shape))
            position += size
        return self.rates(y[: self.balances]), multipliers

    def with_multipliers(self, rates: Float[Array, " balances"]) -> Float[Array, " unknowns"]:
        """Unknowns of given rates, with multipliers of zero."""
        return jnp.concatenate([rates, jnp.zeros(self.unknowns - self.balances, rates.dtype)])

    def residual(self, y: Float[Array, " unknowns"]) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
        """Residual [N s, N m s; m/s, 1/s for constraints] and the size of its terms [sqrt(J)]."""
        found = self.evaluate(y)
        return found.residual, found.size

    def evaluate(self, y: Float[Array, " unknowns"]) -> Evaluation:
        """Residual, and what the end of the step needs."""
        cache, tableau = self.start_cache, self.tableau
        w, multipliers = self.split(project_multipliers(y, self.balances, cache.projector))
        at, geometry = self.moved(w)
        velocity, situations, kick = kicked(self, at)
        asked: Any = multipliers if self.system.structure.inequalities else None
        if tableau.dissipative:
            asked = self.damped(at)
            velocity, situations = asked.started(self.groups, situations)
        elif tableau.variational:
            asked = situations, multipliers
        given = self.system, self.groups, situations, at, velocity
        found = momentum_balance(*given, multipliers, self.h, tableau)
        balances = self.generalised(geometry, found.force, found.torque).reshape(-1)
        rows = project_rows(found.rows, y, self.balances, cache.projector)
        residual = jnp.concatenate([balances, rows])
        return Evaluation(residual, found.size, at, found.power, (found.force, found.torque), kick, asked)

    def damped(self, at: StageKinematics) -> Damped:
        """What numerical dissipation does in the step."""
        damping = self.start_cache.damping
        damping = (
            Damping.at(self.system, self.state) if damping is None else with_system(damping, self.system)
        )
        return damping.over(self.state, self.groups, at, self.h, self.tableau)
