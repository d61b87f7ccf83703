"""Gauss collocation: tableau of the s-stage method and quadrature of the collocated invariants.

A step over h has stage velocities V_i at the Gauss points. Positions at the stages are
Q_i = q_0 + h sum_j a_ij V_j; one stage is the implicit mid-point rule.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial

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
    variational: bool = False
    """Whether forces take hold at both ends of the step instead of at its mid-point."""
    spectral_radius: float = 1.0
    """What is left of an infinitely fast oscillation after a step; below 1, fast oscillations are damped."""

    @property
    def tangent(self) -> bool:
        """Whether velocities at the end of a step obey the constraints."""
        return self.kick or self.variational

    @property
    def separable(self) -> bool:
        """Whether the equations of a step couple a body with its neighbours only."""
        return not self.variational and not self.dissipative

    @property
    def dissipative(self) -> bool:
        """Whether fast oscillations are damped numerically."""
        return self.spectral_radius < 1.0

    @property
    def order(self) -> int:
        """Order of the method."""
        return 2 * self.stages

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


Polynomial = list[Fraction]
"""Coefficients, the constant one first."""

DIGITS = 10**45
"""Denominator of the exact nodes: their errors are far below those of rounding the coefficients."""

NEIGHBOURS = 1
"""Steps of the last place within which rounded coefficients are chosen. More would spoil their sums."""


def _at(p: Polynomial, x: Fraction) -> Fraction:
    value = Fraction(0)
    for coefficient in reversed(p):
        value = value * x + coefficient
    return value


def _derivative(p: Polynomial) -> Polynomial:
    return [k * coefficient for k, coefficient in enumerate(p)][1:]


def _integral(p: Polynomial) -> Polynomial:
    return [Fraction(0), *(coefficient / (k + 1) for k, coefficient in enumerate(p))]


def _exact_nodes(count: int) -> list[Fraction]:
    """Zeros of Legendre's polynomial on [0, 1], by Newton's iteration."""
    legendre = [
        Fraction((-1) ** (count + k) * math.comb(count, k) * math.comb(count + k, k))
        for k in range(count + 1)
    ]
    nodes = []
    for start in _gauss_points(count)[0]:
        x = Fraction(float(start))
        for _ in range(3):
            x = (x - _at(legendre, x) / _at(_derivative(legendre), x)).limit_denominator(DIGITS)
        nodes.append(x)
    return nodes


def _through(node: Fraction, zeros: list[Fraction]) -> Polynomial:
    """The polynomial that is one at a node and zero at others."""
    p = [Fraction(1)]
    for zero in zeros:
        raised, scaled = [Fraction(0), *p], [*p, Fraction(0)]
        p = [(up - zero * down) / (node - zero) for up, down in zip(raised, scaled)]
    return p


def _near(x: float) -> Iterator[float]:
    """A number and its neighbours, itself first."""
    yield x
    for direction in (-math.inf, math.inf):
        neighbour = x
        for _ in range(NEIGHBOURS):
            neighbour = math.nextafter(neighbour, direction)
            yield neighbour


def _partner(x: float, product: Fraction, own: Fraction, other: Fraction) -> float:
    """What makes own * x + other * partner the product, rounded."""
    return float((product - own * Fraction(x)) / other)


def _missing(x: float, product: Fraction, own: Fraction, other: Fraction) -> Fraction:
    """By how much a number and its partner fail to make the product."""
    return abs(product - own * Fraction(x) - other * Fraction(_partner(x, product, own, other)))


def _unequal(x: float, weight: Fraction) -> Fraction:
    """By how much the square of a number differs from twice a rounded number times the weight."""
    square = Fraction(x) ** 2
    return abs(square - 2 * weight * Fraction(float(square / (2 * weight))))


def _rounded_pairs(exact: list[list[Fraction]], b: list[float], products: list[float]) -> list[list[float]]:
    """A matrix X rounded so that b_i X_ij + b_j X_ji = p_i p_j holds as well as it can."""
    weights, p = [Fraction(x) for x in b], [Fraction(x) for x in products]
    rounded = [[float(x) for x in row] for row in exact]
    for i in range(len(b)):
        rounded[i][i] = float(p[i] ** 2 / (2 * weights[i]))
        for j in range(i):
            pair = dict(product=p[i] * p[j], own=weights[i], other=weights[j])
            rounded[i][j] = min(_near(rounded[i][j]), key=partial(_missing, **pair))
            rounded[j][i] = _partner(rounded[i][j], **pair)
    return rounded


@lru_cache
def gauss(stages: int, kick: bool = False) -> Tableau:
    """Tableau of Gauss collocation; one stage without kick gives the energy-momentum step (57).

    Quadratic invariants are kept because b_i a_ij + b_j a_ji = b_i b_j, and energy because the same holds
    for A^-1 with beta. Coefficients that are merely rounded violate this by up to 1e-13, always to the same
    side: over 10^6 steps the error of the energy then grows steadily, to 1e-10. Therefore they are computed
    exactly, and rounded in pairs.
    """
    nodes = _exact_nodes(stages)
    others = [[x for x in nodes if x != node] for node in nodes]
    lagrange = [_through(node, rest) for node, rest in zip(nodes, others)]
    # What begins at zero: A^-1 is its differentiation, beta its value at the end.
    growing = [_through(node, [Fraction(0), *rest]) for node, rest in zip(nodes, others)]
    integrals = [_integral(p) for p in lagrange]
    b = [float(_at(p, Fraction(1))) for p in integrals]
    ends = [float(_at(p, Fraction(1))) for p in growing]
    beta = [min(_near(end), key=partial(_unequal, weight=Fraction(x))) for end, x in zip(ends, b)]
    a = _rounded_pairs([[_at(p, x) for p in integrals] for x in nodes], b, b)
    a_inverse = _rounded_pairs([[_at(_derivative(p), x) for p in growing] for x in nodes], b, beta)

    def rows(matrix: list[list[float]]) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(row) for row in matrix)

    return Tableau(stages, rows(a), tuple(b), tuple(map(float, nodes)), rows(a_inverse), tuple(beta), kick)


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
    first, second, third = jnp.unstack(a, axis=-2)
    cofactors = [cross(second, third), cross(third, first), cross(first, second)]
    return jnp.stack(cofactors, axis=-1) / dot(first, cofactors[0])[..., None, None]


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
        (first, *below), (right, *rest) = jnp.split(blocks, [1]), jnp.split(x, [1])
        pivot, row = jnp.split(first[0], [1])
        pivots.append(_inverse(pivot[0]))
        rows.append(jnp.unstack(row))
        rights.append(right[0])
        if k + 1 < s:
            column, blocks = jnp.split(below[0], [1], axis=1)
            factors = _times(column[:, 0], pivots[-1][None])
            blocks = blocks - _times(factors[:, None], row[None])
            x = rest[0] - _on(factors, right)
    found: list[Array] = []
    for pivot, row, right in zip(reversed(pivots), reversed(rows), reversed(rights)):
        for block, known in zip(row, found):
            right = right - _on(block, known)
        found.insert(0, _on(pivot, right))
    return jnp.stack(found)
