"""Inverses and factors of small dense matrices by elimination, in loops that compile into one kernel."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.xla.rows import part, with_part

LOOPED = 48
"""Largest size for elimination written as a loop of rank-one updates, which compiles into one kernel and runs
in lanes when batched; products of blocks do neither, but win for large matrices."""

BLOCK = 32
"""Columns that are eliminated together in a large matrix."""


@jax.custom_jvp
def definite_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a matrix whose symmetric part is positive definite, or of a quasi-definite one.

    Derivatives are those of the inverse, not of the elimination: its loop would have to be kept turn by turn.
    """
    size = matrix.shape[-1]
    if size > LOOPED:
        return jnp.linalg.inv(matrix)
    if not size:
        return matrix
    number = jnp.arange(size)

    def eliminate(k: Array, matrix: Array) -> Array:
        row, column = matrix[k], matrix[:, k]
        pivot = 1.0 / row[k]
        on = number == k
        scaled = jnp.where(on, pivot, row * pivot)
        kept = jnp.where(on[None, :], 0.0, matrix)
        return jnp.where(on[:, None], scaled[None, :], kept - column[:, None] * scaled[None, :])

    return jax.lax.fori_loop(0, size, eliminate, matrix)


@definite_inverse.defjvp
def _definite_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (change,) = primals, tangents
    inverse = definite_inverse(matrix)
    return inverse, -inverse @ change @ inverse


@jax.custom_jvp
def definite_solution(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of equations with such a matrix."""
    return definite_inverse(matrix) @ right


@definite_solution.defjvp
def _definite_solution_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    (matrix, right), (matrix_dot, right_dot) = primals, tangents
    inverse = definite_inverse(matrix)
    found = inverse @ right
    return found, inverse @ (right_dot - matrix_dot @ found)


@jax.custom_jvp
def inverse_cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower triangular X with X A X^T = 1, for a symmetric positive definite A.

    Derivatives, as above, are closed formulas: dX = -F X with the lower half F of X dA X^T, its diagonal
    halved (S. P. Smith, Differentiation of the Cholesky algorithm, J. Comput. Graph. Stat. 4 (1995) 134-147,
    after L = X^-1).
    """
    size = matrix.shape[-1]
    unit = jnp.eye(size, dtype=matrix.dtype)
    if size > LOOPED:
        return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(matrix), unit, lower=True)
    number = jnp.arange(size)

    def eliminate(k: Array, both: Array) -> Array:
        row = both[k] / jnp.sqrt(both[k, k])
        column = jnp.where(number > k, row[:size], 0.0)
        return jnp.where((number == k)[:, None], row[None, :], both - column[:, None] * row[None, :])

    return jax.lax.fori_loop(0, size, eliminate, jnp.concatenate([matrix, unit], axis=1))[:, size:]


@inverse_cholesky.defjvp
def _inverse_cholesky_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (change,) = primals, tangents
    factor = inverse_cholesky(matrix)
    number = jnp.arange(matrix.shape[-1])
    share = jnp.where(number[:, None] > number, 1.0, jnp.where(number[:, None] == number, 0.5, 0.0))
    return factor, -(share * (factor @ change @ factor.T)) @ factor


def pivoted_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of any regular matrix, by elimination with row pivoting.

    Without calls of LAPACK at any size: XLA's CPU backend makes one function of loops that it finds small
    (more of them where it has a single core), and then cannot compile such calls.
    """
    size = matrix.shape[-1]
    if size > LOOPED:
        return _inverse_by_blocks(matrix)
    number = jnp.arange(size)

    def eliminate(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        # In place, and rows stay where they are: each is the pivot of one column.
        left, row_of, column_of = carry
        column, on = left[:, k], number == k
        best = jnp.argmax(jnp.where(column_of < 0, jnp.abs(column), -1.0))
        row, at = left[best], number == best
        pivot = 1.0 / row[k]
        scaled = jnp.where(on, pivot, row * pivot)
        kept = jnp.where(on, 0.0, left)
        left = jnp.where(at[:, None], scaled, kept - column[:, None] * scaled)
        return left, jnp.where(on, best, row_of), jnp.where(at, k, column_of)

    none = jnp.full(size, -1)
    found, row_of, column_of = jax.lax.fori_loop(0, size, eliminate, (matrix, none, none))
    return found[row_of[:, None], column_of]


def _pivots(panel: Float[Array, "n b"], first: Array) -> Int[Array, " n"]:
    """Order of the rows that brings the pivots of some columns to the rows from `first` on."""
    number = jnp.arange(panel.shape[0])

    def eliminate(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        panel, order = carry
        k = first + j
        best = jnp.argmax(jnp.where(number < k, -1.0, jnp.abs(panel[:, j])))
        swapped = jnp.where(number == k, best, jnp.where(number == best, k, number))
        panel, order = panel[swapped], order[swapped]
        factors = jnp.where(number > k, panel[:, j] / panel[k, j], 0.0)
        return panel - factors[:, None] * panel[k][None, :], order

    return jax.lax.fori_loop(0, panel.shape[1], eliminate, (panel, number))[1]


def _inverse_by_blocks(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse in place by Gauss-Jordan elimination, a block of columns at a time."""
    size = matrix.shape[0]
    padded = -(-size // BLOCK) * BLOCK
    extra = padded - size
    matrix = jnp.pad(matrix, ((0, extra), (0, extra))) + jnp.diag(
        jnp.concatenate([jnp.zeros(size, matrix.dtype), jnp.ones(extra, matrix.dtype)])
    )
    number = jnp.arange(padded)

    def eliminate(block: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, order = carry
        first = block * BLOCK
        moved = _pivots(part(matrix, first, BLOCK, 1), first)
        matrix, order = matrix[moved], order[moved]
        columns = part(matrix, first, BLOCK, 1)
        rows = part(matrix, first, BLOCK, 0)
        inverse = pivoted_inverse(part(columns, first, BLOCK, 0))
        inside = (number >= first) & (number < first + BLOCK)
        rows = inverse @ jnp.where(inside[None, :], 0.0, rows)
        rows = with_part(rows, first, inverse, 1)
        others = jnp.where(inside[:, None], 0.0, columns)
        kept = jnp.where(inside[None, :], 0.0, matrix)
        matrix = with_part(kept - others @ rows, first, rows)
        return matrix, order

    found, order = jax.lax.fori_loop(0, padded // BLOCK, eliminate, (matrix, number))
    return jnp.zeros_like(found).at[:, order].set(found)[:size, :size]
