"""Coefficients of collocation: exact ones, and how they are rounded so that what a step keeps is kept."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

Rows = tuple[tuple[float, ...], ...]
"""A matrix."""

Polynomial = list[Fraction]
"""Coefficients, the constant one first."""

FEW = 2.0**28
"""Values that the digits of the first part of a coefficient can have; in a sum with it the rest is never too
small to count."""

DIGITS = 10**45
"""Denominator of the exact nodes: their errors are far below those of rounding the coefficients."""


def _at(p: Polynomial, x: Fraction) -> Fraction:
    value = Fraction(0)
    for coefficient in reversed(p):
        value = value * x + coefficient
    return value


def _derivative(p: Polynomial) -> Polynomial:
    return [k * coefficient for k, coefficient in enumerate(p)][1:]


def _integral(p: Polynomial) -> Polynomial:
    return [Fraction(0), *(coefficient / (k + 1) for k, coefficient in enumerate(p))]


def _exact_nodes(near: Sequence[float]) -> list[Fraction]:
    """Zeros of Legendre's polynomial on [0, 1], by Newton's iteration from where they are nearly."""
    count = len(near)
    legendre = [
        Fraction((-1) ** (count + k) * math.comb(count, k) * math.comb(count + k, k))
        for k in range(count + 1)
    ]
    nodes = []
    for start in near:
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


def _near(x: float) -> tuple[float, float, float]:
    """A number and its neighbours, itself first. More of them would spoil the sums of coefficients."""
    return x, math.nextafter(x, -math.inf), math.nextafter(x, math.inf)


def _partner(x: float, product: Fraction, own: Fraction, other: Fraction) -> float:
    """What makes own * x + other * partner the product, rounded."""
    return float((product - own * Fraction(x)) / other)


def _missing(x: float, product: Fraction, own: Fraction, other: Fraction) -> Fraction:
    """By how much a number and its partner fail to make the product."""
    return abs(product - own * Fraction(x) - other * Fraction(_partner(x, product, own, other)))


def rounded_pairs(exact: list[list[Fraction]], b: Sequence[float]) -> Rows:
    """The matrix A rounded so that b_i a_ij + b_j a_ji = b_i b_j holds as well as it can."""
    weights = [Fraction(x) for x in b]
    rows = [[float(x) for x in row] for row in exact]
    for i in range(len(b)):
        rows[i][i] = float(weights[i] / 2)
        for j in range(i):
            pair = dict(product=weights[i] * weights[j], own=weights[i], other=weights[j])
            rows[i][j] = min(_near(rows[i][j]), key=partial(_missing, **pair))
            rows[j][i] = _partner(rows[i][j], **pair)
    return tuple(map(tuple, rows))


@dataclass(frozen=True)
class Collocation:
    """Exact coefficients of collocation, but for the last of many digits; see `Tableau`."""

    nodes: list[Fraction]
    b: list[Fraction]
    beta: list[Fraction]
    a: list[list[Fraction]]
    a_inverse: list[list[Fraction]]


def collocation(near: Sequence[float]) -> Collocation:
    """Coefficients of collocation at Gauss points, which are given as they are nearly."""
    nodes = _exact_nodes(near)
    others = [[x for x in nodes if x != node] for node in nodes]
    integrals = [_integral(_through(node, rest)) for node, rest in zip(nodes, others)]
    # What begins at zero: A^-1 is its differentiation, beta its value at the end.
    growing = [_through(node, [Fraction(0), *rest]) for node, rest in zip(nodes, others)]
    return Collocation(
        nodes,
        [_at(p, Fraction(1)) for p in integrals],
        [_at(p, Fraction(1)) for p in growing],
        [[_at(p, x) for p in integrals] for x in nodes],
        [[_at(_derivative(p), x) for p in growing] for x in nodes],
    )


def rounded(matrix: Sequence[Sequence[Fraction | float]]) -> Rows:
    """A matrix in double precision, as tuples."""
    return tuple(tuple(map(float, row)) for row in matrix)


def in_parts(matrix: list[list[Fraction]]) -> tuple[Rows, Rows]:
    """A matrix as a sum of one with few digits and the rest."""

    def few(x: Fraction) -> float:
        mantissa, exponent = math.frexp(float(x))
        return math.ldexp(round(mantissa * FEW) / FEW, exponent)

    first = rounded([[few(x) for x in row] for row in matrix])
    rest = [[x - Fraction(y) for x, y in zip(*pair)] for pair in zip(matrix, first)]
    return first, rounded(rest)
