"""Solutions by an approximate inverse and iterative refinement, differentiable in every mode."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
from jaxtyping import Array, Float

Inverse = TypeVar("Inverse")


def refined_solve(
    multiply: Callable[[Array], Array],
    right: Float[Array, "*n"],
    inverse: Inverse,
    solve: Callable[[Inverse, Array], Array],
    transposed: Callable[[Inverse, Array], Array],
    rounds: int,
) -> Float[Array, "*n"]:
    """Solution x of multiply(x) = right.

    Args:
        multiply: product with the matrix.
        right: right-hand side.
        inverse: factors, or whatever else solves nearly.
        solve: (inverse, right) -> nearly x.
        transposed: the same for the transposed matrix.
        rounds: of refinement.

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
        for _ in range(rounds):
            x = x + near(fixed, right - multiply(x))
        return x

    ways = partial(refined, solve), partial(refined, transposed)
    return jax.lax.custom_linear_solve(multiply, right, solve=ways[0], transpose_solve=ways[1])
