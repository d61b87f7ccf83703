"""Gauss collocation: tableau of the s-stage method and quadrature of the collocated invariants.

A step over h has stage velocities V_i at the Gauss points. Positions at the stages are
Q_i = q_0 + h sum_j a_ij V_j; one stage is the implicit mid-point rule.
"""

from dataclasses import dataclass
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.vectors import cross, dot, skew


@dataclass(frozen=True)
class Tableau:
    """Coefficients of Gauss collocation with `stages` stages, as nested tuples (hashable, hence static)."""

    stages: int
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    a_inverse: tuple[tuple[float, ...], ...]
    beta: tuple[float, ...]
    """b^T A^-1: the end velocity is v_0 + sum beta_i (V_i - v_0)."""


def _gauss_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    points, weights = np.polynomial.legendre.leggauss(count)
    return (points + 1) / 2, weights / 2


def _integrals(nodes: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Integrals from 0 to `upper` of the Lagrange polynomials on `nodes`: shape (upper, nodes)."""
    rows = []
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        polynomial = np.poly1d([1.0])
        for other in others:
            polynomial = polynomial * np.poly1d([1.0, -other]) / (node - other)
        rows.append(polynomial.integ()(upper))
    return np.array(rows).T


@lru_cache
def gauss(stages: int) -> Tableau:
    """Tableau of Gauss collocation; one stage gives the energy-momentum step (57)."""
    c, b = _gauss_points(stages)
    a = _integrals(c, c)
    a_inverse = np.linalg.inv(a)

    def rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(float(x) for x in row) for row in matrix)

    beta = b @ a_inverse
    b, c, beta = (tuple(float(x) for x in vector) for vector in (b, c, beta))
    return Tableau(stages, rows(a), b, c, rows(a_inverse), beta)


@lru_cache
def invariant_quadrature(stages: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices that average a gradient along the collocated path of the invariants.

    Returns:
        Integrals (points, stages): Pi(tau_p) = pi_0 + h sum_j integrals[p, j] Pi'_j, and averages
        (stages, points): S_i = sum_p averages[i, p] grad V(Pi(tau_p)), that is
        1/b_i times the integral of l_i(tau) grad V(Pi(tau)).
    """
    c, b = _gauss_points(stages)
    tau, weights = _gauss_points(points)
    integrals = _integrals(c, tau)
    lagrange = np.ones((stages, points))
    for i in range(stages):
        for j in range(stages):
            if i != j:
                lagrange[i] *= (tau - c[j]) / (c[i] - c[j])
    return integrals, lagrange * weights / b[:, None]


def rotate_stages(
    turn: Float[Array, "#stages *#batch 3"], start: Float[Array, "#stages *#batch 3"], tableau: Tableau
) -> Float[Array, "stages *out 3"]:
    """Stage values X_i of vectors that turn with the stages: X_i - sum_j a_ij turn_j x X_j = start_i.

    For one stage this is the mid-point vector of Cayley's rotation with half turn a = turn/2,
    [x + a x x + a (a . x)] / (1 + |a|^2), whose increment is turn x X.

    Args:
        turn: h times the stage angular velocities [rad].
        start: right-hand sides, for directors their values at the start of the step.
        tableau: the collocation method.
    """
    if tableau.stages == 1:
        a = 0.5 * turn
        scale = 1.0 / (1.0 + dot(a, a))
        return (start + cross(a, start) + a * dot(a, start)[..., None]) * scale[..., None]
    s = tableau.stages
    turn, start = jnp.broadcast_arrays(turn, start)
    blocks = jnp.asarray(tableau.a)
    matrix = jnp.eye(3 * s) - jnp.einsum("ij,j...kl->...ikjl", blocks, skew(turn)).reshape(
        *turn.shape[1:-1], 3 * s, 3 * s
    )
    right = jnp.moveaxis(start, 0, -2).reshape(*start.shape[1:-1], 3 * s, 1)
    solution = jnp.linalg.solve(matrix, right)[..., 0].reshape(*start.shape[1:-1], s, 3)
    return jnp.moveaxis(solution, -2, 0)
