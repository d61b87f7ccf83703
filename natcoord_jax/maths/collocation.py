"""Gauss collocation: tableau of the s-stage method and quadrature of the collocated invariants.

A step over h has stage velocities V_i at the Gauss points. Positions at the stages are
Q_i = q_0 + h sum_j a_ij V_j; one stage is the implicit mid-point rule.
"""

from dataclasses import dataclass
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.coefficients import Rows, collocation, in_parts, rounded, rounded_pairs
from natcoord_jax.maths.lagrange import gauss_legendre
from natcoord_jax.maths.vectors import applied, cross, dot, product, skew


@dataclass(frozen=True)
class Tableau:
    """Coefficients of Gauss collocation with `stages` stages, as nested tuples (hashable, hence static)."""

    stages: int
    a: Rows
    b: tuple[float, ...]
    c: tuple[float, ...]
    a_inverse: Rows
    beta: tuple[float, ...]
    """b^T A^-1: the end velocity is v_0 + sum beta_i (V_i - v_0)."""
    a_inverse_parts: tuple[Rows, Rows] | None = None
    """A^-1 as a sum of few digits and the rest, see `differentiated`; None: it is exact as it is."""
    beta_parts: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """The same of beta."""
    kick: bool = False
    """Whether velocities are kept tangent to the constraints by isometric kicks along their normals."""
    variational: bool = False
    """Whether forces take hold at both ends of the step instead of at its mid-point."""
    spectral_radius: float = 1.0
    """What is left of an infinitely fast oscillation after a step; below 1, fast oscillations are damped."""
    max_events: int = 0
    """Impacts that a step is split at, at most."""

    @property
    def tangent(self) -> bool:
        """Whether velocities at the end of a step obey the constraints."""
        return self.kick or self.variational

    @property
    def separable(self) -> bool:
        """Whether the equations of a step couple a body with its neighbours only.

        The time of an impact, which ends a part of a step, is that of all of them.
        """
        return not self.variational and not self.dissipative and not self.max_events

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

    def differentiated(self, x: Float[Array, "stages *n"]) -> Float[Array, "stages *n"]:
        """sum_j (A^-1)_ij x_j, with no error of the coefficients that would show.

        Energy is kept because sum_i b_i (A^-1)_ij = beta_j and b_i (A^-1)_ij + b_j (A^-1)_ji = beta_i beta_j.
        Rounded coefficients violate this by up to 1e-15, always to the same side. Here the products are
        rounded, each time anew, and the coefficients are not.
        """
        return _summed(self.a_inverse_parts or (self.a_inverse,), x)

    def gained(self, x: Float[Array, "stages *n"]) -> Float[Array, "*n"]:
        """sum_i beta_i x_i, likewise."""
        return _summed(self.beta_parts or (self.beta,), x)


def _summed(parts: tuple, x: Array) -> Array:
    """Sum of products with the parts of a coefficient matrix."""
    first, *rest = (jnp.tensordot(jnp.asarray(part, x.dtype), x, 1) for part in parts)
    return sum(rest, first)


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
    """Tableau of Gauss collocation; one stage without kick gives the energy-momentum step (57).

    Quadratic invariants are kept because b_i a_ij + b_j a_ji = b_i b_j. Coefficients that are merely rounded
    violate this, always to the same side, and over 10^6 steps the error grows steadily. Therefore they are
    computed exactly, and rounded in pairs; for what keeps the energy see `Tableau.differentiated`.
    """
    exact = collocation(gauss_legendre(stages)[0].tolist())
    nodes, b = tuple(map(float, exact.nodes)), rounded([exact.b])[0]
    a, a_inverse, beta = rounded_pairs(exact.a, b), rounded(exact.a_inverse), rounded([exact.beta])[0]
    if stages == 1:  # All of them are whole numbers, or halves.
        return Tableau(stages, a, b, nodes, a_inverse, beta, kick=kick)
    first, rest = in_parts([exact.beta])
    beta_parts = first[0], rest[0]
    return Tableau(stages, a, b, nodes, a_inverse, beta, in_parts(exact.a_inverse), beta_parts, kick)


@lru_cache
def invariant_quadrature(stages: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices that average a gradient along the collocated path of the invariants.

    Returns:
        Integrals (points, stages): Pi(tau_p) = pi_0 + h sum_j integrals[p, j] Pi'_j, and averages
        (stages, points): S_i = sum_p averages[i, p] grad V(Pi(tau_p)), that is
        1/b_i times the integral of l_i(tau) grad V(Pi(tau)).
    """
    c, b = gauss_legendre(stages)
    tau, weights = gauss_legendre(points)
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
            factors = product(column[:, 0], pivots[-1][None])
            blocks = blocks - product(factors[:, None], row[None])
            x = rest[0] - applied(factors, right[..., None, :])
    found: list[Array] = []
    for pivot, row, right in zip(reversed(pivots), reversed(rows), reversed(rights)):
        for block, known in zip(row, found):
            right = right - applied(block, known[..., None, :])
        found.insert(0, applied(pivot, right[..., None, :]))
    return jnp.stack(found)
