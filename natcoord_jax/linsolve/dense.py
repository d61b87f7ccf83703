"""Inverses of small dense matrices, made once and applied often."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.linsolve.refinement import refined_solve
from natcoord_jax.maths.elimination import definite_inverse, pivoted_inverse

ROUNDING = 1e-14
"""Part of the largest inertia that is the rounding of none."""


def bordered_inverse(matrix: Float[Array, "n n"], visible: int) -> Float[Array, "n n"]:
    """Inverse of [[A, -B^T], [C, E]] with a positive definite A, or one that the constraints make definite.

    Constraint rows, scaled, are first added to the balances: A + s C^T C is definite even for a body without
    inertia about an axis along which C holds it. E is zero, or one on the diagonal of unused rows.
    """
    size = matrix.shape[-1]
    if size == visible:
        return definite_inverse(matrix)
    inertia, rows = matrix[:visible, :visible], matrix[visible:, :visible]
    most = jnp.sum(rows**2)
    scale = jnp.trace(inertia) / jnp.where(most > 0, most, 1.0)
    mix = scale * rows.T
    added = jnp.sum(mix[:, :, None] * matrix[None, visible:, :], axis=1)
    inverse = definite_inverse(jnp.concatenate([matrix[:visible] + added, matrix[visible:]]))
    spread = jnp.sum(inverse[:, :visible, None] * mix[None, :, :], axis=1)
    return jnp.concatenate([inverse[:, :visible], inverse[:, visible:] + spread], axis=1)


def saddle_inverse(
    matrix: Float[Array, "n n"], inertias: Float[Array, " balances"], *, dependent: bool = True
) -> Float[Array, "n n"]:
    """Inverse of a saddle-point matrix [[A, -B^T], [C, 0]], regularised so that redundant rows do no harm.

    The constraint rows get a small positive diagonal in units of the matrix itself. Used as the
    approximate inverse of an iteration, the regularisation costs no accuracy: multipliers stay in the
    range of the constraints, that is, of minimum norm, and singular positions are passed.

    Args:
        matrix: the matrix; its first rows are the balance equations.
        inertias: of their unknowns, which give the diagonal its size.
        dependent: whether rows of constraints may depend on each other. If not, each row has a diagonal of
            its own size: what is little beside a light body would swamp the constraints of heavy ones.
    """
    size, definite = matrix.shape[-1], inertias.shape[0]
    if size == definite:
        return definite_inverse(matrix)
    shift = constraint_shifts(matrix, inertias, dependent=dependent)
    diagonal = jnp.concatenate([jnp.zeros(definite, matrix.dtype), shift])
    return pivoted_inverse(matrix + jnp.diag(diagonal))


def constraint_shifts(
    matrix: Float[Array, "n n"], inertias: Float[Array, " balances"], *, dependent: bool
) -> Float[Array, " multipliers"]:
    """Small positive numbers for the diagonal of the constraint rows, see `saddle_inverse`."""
    definite, most = inertias.shape[0], jnp.max(inertias)
    coupling = jnp.abs(matrix[definite:, :definite])
    # (What an ideal rod has about its axis is the rounding of what it has about others.)
    scale = jnp.max(coupling**2 / jnp.where(inertias > ROUNDING * most, inertias, most), axis=1)
    least = (1.0 if dependent else 1e-16) * jnp.max(scale)
    return 1e-10 * jnp.maximum(jnp.maximum(scale, least), jnp.finfo(matrix.dtype).tiny)


def apply(inverse: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Product with a vector, as broadcast and sum: cheaper than a call for small sizes."""
    if right.shape[-1] > 32:
        return inverse @ right
    return jnp.sum(inverse * right[None, :], axis=1)


class Inverse(eqx.Module):
    """An approximate inverse, to be applied in an iteration."""

    inverse: Float[Array, "n n"]

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Product with the inverse."""
        return apply(self.inverse, right)

    def updated(self, u: Float[Array, " n"], weights: Float[Array, " n"]) -> "Inverse":
        """With u (weights^T X) added, of rank one."""
        return Inverse(self.inverse + u[:, None] * jnp.sum(weights[:, None] * self.inverse, axis=0)[None, :])

    def transpose(self) -> "Inverse":
        """Inverse of the transposed matrix."""
        return Inverse(self.inverse.T)


class DenseSolver(eqx.Module):
    """A matrix with its (possibly regularised) inverse; solves are refined and differentiable in every mode.

    Attributes:
        matrix: the exact matrix.
        inverse: its approximate inverse, not differentiated.
        definite: number of balance rows; below them refinement is needed.
    """

    matrix: Float[Array, "n n"]
    inverse: Float[Array, "n n"]
    definite: int = eqx.field(static=True)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution x of matrix x = right."""
        rounds = 0 if self.definite == right.shape[-1] else 2
        return refined_solve(
            lambda x: apply(self.matrix, x),
            right,
            self.inverse,
            apply,
            lambda inverse, b: apply(inverse.T, b),
            rounds,
        )
