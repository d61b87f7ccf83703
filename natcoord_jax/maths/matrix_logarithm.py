"""Logarithms and exponentials of symmetric matrices 3 x 3, by components, smooth where eigenvalues coincide.

Nothing is done but products and inverses of matrices that commute, so that derivatives of all orders are
those of the function; formulas with eigenvalues have none where two of these are equal, as in any pose
without stress. Components are as in `symmetric`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.symmetric import cofactor, contracted, unit_like

ROOTS = 3
"""Square roots that are taken before the logarithm is a quadrature."""
TURNS = 9
"""Of the iteration for a square root; with it a logarithm is exact for eigenvalues from 1e-2 to 1e2."""
POINTS, WEIGHTS = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(10), (1.0, 0.0)))
HALVINGS = 6
"""Of an exponent, before its exponential is a series."""
TERMS = 11


def _inverse(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    other = cofactor(a)
    return other * (3.0 / contracted(other, a))


def _product(a: Float[Array, "6 *n"], b: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """Of two matrices that commute."""
    return jnp.stack(
        [
            a[0] * b[0] + a[3] * b[3] + a[5] * b[5],
            a[3] * b[3] + a[1] * b[1] + a[4] * b[4],
            a[5] * b[5] + a[4] * b[4] + a[2] * b[2],
            a[0] * b[3] + a[3] * b[1] + a[5] * b[4],
            a[3] * b[5] + a[1] * b[4] + a[4] * b[2],
            a[0] * b[5] + a[3] * b[4] + a[5] * b[2],
        ]
    )


def _root(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """Square root, by the iteration of Denman and Beavers (Appl. Math. Comput. 2 (1976) 63-94)."""

    def turn(pair: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        root, other = pair
        return (0.5 * (root + _inverse(other)), 0.5 * (other + _inverse(root))), None

    return jax.lax.scan(turn, (a, unit_like(a)), None, length=TURNS)[0][0]


def logarithm(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """Of a positive definite matrix: 8 times the integral of (x - 1) / (1 + t (x - 1)), x = a^(1/8)."""
    a = jax.lax.scan(lambda x, _: (_root(x), None), a, None, length=ROOTS)[0]
    away = a - unit_like(a)

    def point(total: Array, at: tuple[Array, Array]) -> tuple[Array, None]:
        return total + at[1] * _inverse(unit_like(a) + at[0] * away), None

    total = jax.lax.scan(point, jnp.zeros_like(a), (jnp.asarray(POINTS), jnp.asarray(WEIGHTS)))[0]
    return 2.0**ROOTS * _product(away, total)


def exponential_less_one(a: Float[Array, "6 *n"]) -> Float[Array, "6 *n"]:
    """exp(a) - 1, to the digits of a small a."""
    small = a / 2.0**HALVINGS

    # Loops, since compilers work out unrolled products anew for each component of the next.
    def term(total: Array, k: Array) -> tuple[Array, None]:
        return (small + _product(small, total)) / k, None

    def squared(total: Array, _: None) -> tuple[Array, None]:
        return 2.0 * total + _product(total, total), None

    total = jax.lax.scan(term, jnp.zeros_like(a), jnp.arange(TERMS, 0, -1, dtype=a.dtype))[0]
    return jax.lax.scan(squared, total, None, length=HALVINGS)[0]
