"""Lagrange functions on Gauss-Lobatto points: values, slopes, and rules of quadrature."""

import numpy as np
from jaxtyping import Float

LOBATTO = {
    1: ((-1.0, 1.0), (1.0, 1.0)),
    2: ((-1.0, 0.0, 1.0), (1 / 3, 4 / 3, 1 / 3)),
    3: ((-1.0, -(0.2**0.5), 0.2**0.5, 1.0), (1 / 6, 5 / 6, 5 / 6, 1 / 6)),
}
"""Gauss-Lobatto points on [-1, 1] and their weights, by order of the functions through them."""


def lobatto(order: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Points on [0, 1] and weights that sum to one."""
    points, weights = LOBATTO[order]
    return (np.array(points) + 1) / 2, np.array(weights) / 2


def lagrange(
    nodes: Float[np.ndarray, " n"], at: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
    """Values and slopes of the Lagrange functions through the nodes."""
    values, slopes = [], []
    for own, node in enumerate(nodes):
        polynomial = np.polynomial.Polynomial([1.0])
        for other, zero in enumerate(nodes):
            if other != own:
                polynomial = polynomial * np.polynomial.Polynomial([-zero, 1.0]) / (node - zero)
        values.append(polynomial(at))
        slopes.append(polynomial.deriv()(at))
    return np.stack(values, axis=1), np.stack(slopes, axis=1)


def gauss_legendre(count: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Points on [0, 1] and weights that sum to one."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return (points + 1) / 2, weights / 2
