"""Inverses of matrices of several stages by the eigenvalues of the Runge-Kutta matrix.

Where the parts of the system change little within a step, a change of the rates at stage j acts on the
balances at stage i by inertia, by damping and by stiffness alone, each in a fixed proportion,

    J_ij = (A^-1)_ij N + delta_ij D + a_ij K,

and the eigenvectors of A, A = sum_m lambda_m t_m l_m^T, take the matrix of s n rows apart (Butcher 1976;
Hairer and Wanner, Solving ODEs II, IV.8):

    J^-1 = sum_m t_m l_m^T (x) (N / lambda_m + D + lambda_m K)^-1.

Eigenvalues come in conjugate pairs, of which one half is enough: (s + 1) / 2 inverses of n rows instead of
one of s n. The three parts follow from changes that are the same at all stages, sum_j J_ij: n of them, not
s n.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from natcoord_jax.linsolve.dense import constraint_shifts
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.elimination import LOOPED, pivoted_inverse


@lru_cache
def modes_of(tableau: Tableau) -> tuple[Complex[np.ndarray, " m"], Complex[np.ndarray, "m s s"]]:
    """Eigenvalues of A with an imaginary part of at least zero, and t_m l_m^T, twice for those of pairs."""
    values, right = np.linalg.eig(np.array(tableau.a))
    left = np.linalg.inv(right)
    half = np.imag(values) > -1e-12
    twice = np.where(np.imag(values) > 1e-12, 2.0, 1.0)
    couplings = twice[:, None, None] * right.T[:, :, None] * left[:, None, :]
    return values[half], couplings[half]


def fitted(
    alike: Float[Array, "s n n"], inertia: Float[Array, "n n"], balances: int, tableau: Tableau
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """D and K from what changes that are the same at all stages do at each.

    The best fit where the parts do change within the step. Multipliers act at their own stage only.

    Args:
        alike: sum_j J_ij.
        inertia: N.
        balances: number of rates among the unknowns; the rest are multipliers.
        tableau: the collocation method.
    """
    by_inertia, by_stiffness = np.sum(tableau.a_inverse, axis=1), np.sum(tableau.a, axis=1)
    rest = alike - jnp.asarray(by_inertia)[:, None, None] * inertia
    fit = np.linalg.pinv(np.stack([np.ones(tableau.stages), by_stiffness], axis=1))
    damping, stiffness = jnp.tensordot(jnp.asarray(fit), rest, 1)
    rates = jnp.arange(alike.shape[-1]) < balances
    return jnp.where(rates, damping, jnp.mean(rest, axis=0)), jnp.where(rates, stiffness, 0.0)


def complex_inverse(
    real: Float[Array, "n n"], imaginary: Float[Array, "n n"]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Inverse of a regular complex matrix, by elimination with row pivoting; real and imaginary parts.

    In real numbers, since complex ones are not among what compiles into one kernel.
    """
    size = real.shape[-1]
    if size > LOOPED:
        both = jnp.block([[real, -imaginary], [imaginary, real]])
        found = pivoted_inverse(both)
        return found[:size, :size], found[size:, :size]
    number = jnp.arange(size)

    def eliminate(k: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        x, y = both
        squares = jnp.where(number < k, -1.0, x[:, k] ** 2 + y[:, k] ** 2)
        best = jnp.argmax(squares)
        a, b = x[best, k] / squares[best], y[best, k] / squares[best]
        row = x[best] * a + y[best] * b, y[best] * a - x[best] * b
        swapped, here = (number == best)[:, None], number == k
        x, y = jnp.where(swapped, x[k], x), jnp.where(swapped, y[k], y)
        c, d = (jnp.where(here, 0.0, z[:, k])[:, None] for z in (x, y))
        x, y = x - (c * row[0] - d * row[1]), y - (c * row[1] + d * row[0])
        return jnp.where(here[:, None], row[0], x), jnp.where(here[:, None], row[1], y)

    unit = jnp.eye(size, dtype=real.dtype)
    start = jnp.concatenate([real, unit], axis=1), jnp.concatenate([imaginary, jnp.zeros_like(unit)], axis=1)
    x, y = jax.lax.fori_loop(0, size, eliminate, start)
    return x[:, size:], y[:, size:]


def stagewise_inverse(
    inertia: Float[Array, "n n"],
    damping: Float[Array, "n n"],
    stiffness: Float[Array, "n n"],
    inertias: Float[Array, " balances"],
    tableau: Tableau,
    *,
    dependent: bool = True,
) -> Float[Array, "s n s n"]:
    """Inverse of (A^-1)_ij N + delta_ij D + a_ij K, with redundant rows as in `saddle_inverse`.

    Args:
        inertia: N.
        damping: D.
        stiffness: K.
        inertias: of the rates, which give the diagonal of constraints its size.
        tableau: the collocation method.
        dependent: whether rows of constraints may depend on each other.
    """
    values, couplings = modes_of(tableau)
    size, definite = inertia.shape[-1], inertias.shape[0]
    shift = jnp.zeros(size, inertia.dtype)
    if size > definite:
        shift = shift.at[definite:].set(constraint_shifts(damping, inertias, dependent=dependent))
    whole = damping + jnp.diag(shift)
    up, down = values[:, None, None], 1.0 / values[:, None, None]
    real = jnp.asarray(np.real(down)) * inertia + whole + jnp.asarray(np.real(up)) * stiffness
    imaginary = jnp.asarray(np.imag(down)) * inertia + jnp.asarray(np.imag(up)) * stiffness
    inverses = jnp.concatenate(jax.vmap(complex_inverse)(real, imaginary))
    weights = jnp.asarray(np.concatenate([np.real(couplings), -np.imag(couplings)]))
    return jnp.sum(weights[:, :, None, :, None] * inverses[:, None, :, None, :], axis=0)
