"""Sparse matrices with a few dense products of a column and a row, by Woodbury's formula."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import pivoted_inverse


class Products(eqx.Module):
    """A sum of products of columns and rows.

    Attributes:
        columns: (m, n).
        rows: (m, n).
    """

    columns: Float[Array, "m n"]
    rows: Float[Array, "m n"]

    def to_dense(self) -> Float[Array, "n n"]:
        """The matrix."""
        return self.columns.T @ self.rows

    def times(self, factor: float) -> "Products":
        """Multiplied by a number."""
        return Products(factor * self.columns, self.rows)

    def around(self, factors: Any) -> "WithProducts":
        """Factors of the sum of a matrix and these, from those of the matrix."""
        return WithProducts.of(factors, self)


class WithProducts(eqx.Module):
    """Factors of A, made into those of A + U V^T, to be applied in an iteration.

    Attributes:
        factors: of A.
        solved: A^-1 U, as rows.
        rows: V, as rows.
        small: inverse of 1 + V^T A^-1 U.
        transposed: whether it solves the transposed equations.

    Source: M. A. Woodbury, Inverting modified matrices, Princeton 1950.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> from natcoord_jax.linsolve.dense import Inverse
        >>> ones = Products(jnp.ones((1, 3)), jnp.ones((1, 3)))
        >>> WithProducts.of(Inverse(jnp.eye(3)), ones).solve(jnp.array([4.0, 0, 0])).tolist()
        [3.0, -1.0, -1.0]
    """

    factors: Any
    solved: Float[Array, "m n"]
    rows: Float[Array, "m n"]
    small: Float[Array, "m m"]
    transposed: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(cls, factors: Any, products: Products) -> "WithProducts":
        """Of factors without the products."""
        solved = jnp.stack([factors.solve(column) for column in products.columns])
        small = pivoted_inverse(jnp.eye(len(solved), dtype=solved.dtype) + products.rows @ solved.T)
        return cls(factors, solved, products.rows, small)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side, unrefined."""
        if self.transposed:
            return self.factors.solve(right - (self.solved @ right) @ self.small @ self.rows)
        found = self.factors.solve(right)
        return found - (self.small @ (self.rows @ found)) @ self.solved

    def transpose(self) -> "WithProducts":
        """Factors of the transposed matrix."""
        return WithProducts(self.factors.transpose(), self.solved, self.rows, self.small, not self.transposed)
