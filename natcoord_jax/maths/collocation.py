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
    kick: bool = False
    """Whether velocities are kept tangent to the constraints by isometric kicks along their normals."""

    @property
    def reflection(self) -> float:
        """-R(infinity), the sign with which a kick is taken back at the end of the step."""
        return 1.0 if self.stages % 2 else -1.0


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
def gauss(stages: int, kick: bool = False) -> Tableau:
    """Tableau of Gauss collocation; one stage without kick gives the energy-momentum step (57)."""
    c, b = _gauss_points(stages)
    a = _integrals(c, c)
    a_inverse = np.linalg.inv(a)

    def rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(float(x) for x in row) for row in matrix)

    beta = b @ a_inverse
    b, c, beta = (tuple(float(x) for x in vector) for vector in (b, c, beta))
    return Tableau(stages, rows(a), b, c, rows(a_inverse), beta, kick)


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
    return _block_solve(turn, start, tableau)


def _times(a: Float[Array, "*batch 3 3"], b: Float[Array, "*other 3 3"]) -> Float[Array, "*out 3 3"]:
    """Products of 3 x 3 matrices as sums, which fuse with their neighbours."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def _on(a: Float[Array, "*batch 3 3"], x: Float[Array, "*other 3"]) -> Float[Array, "*out 3"]:
    return jnp.sum(a * x[..., None, :], axis=-1)


def _inverse(a: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Inverses of 3 x 3 matrices by cofactors."""
    first, second, third = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    cofactors = jnp.stack([cross(second, third), cross(third, first), cross(first, second)], axis=-1)
    return cofactors / dot(first, cofactors[..., 0])[..., None, None]


def _block_solve(
    turn: Float[Array, "stages *#batch 3"], start: Float[Array, "#stages *#batch 3"], tableau: Tableau
) -> Float[Array, "stages *out 3"]:
    """Elimination stage by stage; the pivots, 1 less a skew matrix in the main, are regular."""
    s = tableau.stages
    x = jnp.broadcast_to(start, jnp.broadcast_shapes(turn.shape, start.shape))
    spin = skew(turn).reshape(s, *(1,) * (x.ndim - turn.ndim), *turn.shape[1:], 3)
    by_stages = (s, s, *(1,) * x.ndim)
    a, unit = jnp.asarray(tableau.a, turn.dtype), jnp.eye(s, dtype=turn.dtype)
    blocks = unit.reshape(by_stages) * jnp.eye(3, dtype=turn.dtype) - a.reshape(by_stages) * spin[None]
    pivots, rows, rights = [], [], []
    for k in range(s):
        # What is left of the matrix and of the right-hand sides, from stage k on.
        pivots.append(_inverse(blocks[0, 0]))
        rows.append(blocks[0, 1:])
        rights.append(x[0])
        if k + 1 < s:
            factors = _times(blocks[1:, 0], pivots[-1][None])
            blocks = blocks[1:, 1:] - _times(factors[:, None], blocks[0, 1:][None])
            x = x[1:] - _on(factors, x[0])
    found: list[Array] = []
    for pivot, row, right in zip(reversed(pivots), reversed(rows), reversed(rights)):
        for block, known in zip(row, found):
            right = right - _on(block, known)
        found.insert(0, _on(pivot, right))
    return jnp.stack(found)
