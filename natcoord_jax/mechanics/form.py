"""What a form of the equations declares of its Jacobian: how it comes about, how one solves with it."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.linsolve.dense import DenseSolver, Inverse, saddle_inverse


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
