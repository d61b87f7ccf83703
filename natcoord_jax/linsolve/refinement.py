"""Solutions by an approximate inverse and iterative refinement, differentiable in every mode."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Inverse = TypeVar("Inverse")

MOST = 60
"""Rounds of refinement that goes on until it converges."""

UNSOLVED = 1e-12
"""Work of the residual along its correction, in terms of that of the right-hand side along the solution,
that no solution leaves: the square of its relative error. Rounding of structures whose stiffnesses are 1e10
apart leaves as much."""


def refined_solve(
    multiply: Callable[[Array], Array],
    right: Float[Array, "*n"],
    inverse: Inverse,
    solve: Callable[[Inverse, Array], Array],
    transposed: Callable[[Inverse, Array], Array],
    rounds: int | None,
) -> Float[Array, "*n"]:
    """Solution x of multiply(x) = right.

    Args:
        multiply: product with the matrix.
        right: right-hand side.
        inverse: factors, or whatever else solves nearly.
        solve: (inverse, right) -> nearly x.
        transposed: the same for the transposed matrix.
        rounds: of refinement; None: as many as it takes. What does not converge is NaN then.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> from jax import numpy as jnp
        >>> from natcoord_jax.linsolve.refinement import refined_solve
        >>> def x(a):
        ...     product = lambda inverse, b: inverse * b
        ...     return refined_solve(lambda x: a * x, jnp.ones(()), 0.26, product, product, rounds=5)
        >>> print(f"{x(4.0):.4f} {jax.grad(x)(4.0):.4f}")
        0.2500 -0.0625
    """
    # Derivatives are those of the equation: none go through what only helps to solve it.
    fixed = jax.lax.stop_gradient(inverse)

    def refined(near: Callable[[Inverse, Array], Array], multiply: Callable, right: Array) -> Array:
        x = near(fixed, right)
        if rounds is None:
            return _converged(partial(near, fixed), multiply, right, x)
        for _ in range(rounds):
            x = x + near(fixed, right - multiply(x))
        return x

    ways = partial(refined, solve), partial(refined, transposed)
    return jax.lax.custom_linear_solve(multiply, right, solve=ways[0], transpose_solve=ways[1])


def _converged(
    near: Callable[[Array], Array], multiply: Callable[[Array], Array], right: Array, x: Array
) -> Array:
    """The solution, refined as long as residuals do less and less work along their corrections."""
    size = jnp.sum(jnp.abs(right * x))

    def trip(carry: tuple) -> tuple:
        x, work, _, count = carry
        missing = right - multiply(x)
        change = near(missing)
        return x + change, jnp.sum(jnp.abs(missing * change)), work, count + 1

    start = x, size, jnp.full_like(size, jnp.inf), jnp.array(0)
    x, work, before, _ = jax.lax.while_loop(
        lambda carry: (carry[1] < 0.25 * carry[2]) & (carry[3] < MOST), trip, start
    )
    return jnp.where(jnp.minimum(work, before) <= UNSOLVED * size, x, jnp.nan)


class RefinedSolver(eqx.Module):
    """A matrix with factors of it or of one near it: solutions are refined, differentiable in every mode.

    Derivatives by the numbers of the matrix go through its product with the solution; the factors are not
    differentiated.

    Attributes:
        matrix: the exact matrix.
        factors: of the matrix or of one near it.
        rounds: of refinement.
    """

    matrix: Any
    factors: Any
    rounds: int = eqx.field(static=True, default=1)

    def solve(self, right: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Solution x of matrix x = right."""
        return refined_solve(
            self.matrix.multiply,
            right,
            self.factors,
            lambda factors, b: factors.solve(b),
            lambda factors, b: factors.transpose().solve(b),
            self.rounds,
        )
