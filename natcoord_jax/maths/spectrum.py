"""Eigenvalues and eigenvectors with derivatives of every order, and no number where there is no derivative.

With B = V^-1 A' V the eigenvalues change by the diagonal of B, the eigenvectors by V C, C_ij = B_ij /
(l_j - l_i). Eigenvectors of eigenvalues that coincide are arbitrary in their span: a change that splits these
has no derivative, only one to each side, and that is not linear. One that does not split them has, since
there B is a multiple of the unit matrix.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Num

from natcoord_jax.xla import linear_pair

MIXED = 1e3
"""Gap between eigenvalues, in terms of their rounding n eps |A|, below which rounding mixes the eigenvectors
by more than a thousandth."""

SAME = 1e-9
"""Gap between eigenvalues, in terms of these, that symmetry does not leave: equilibria are known to 1e-11."""

EVEN = 1e-6
"""Difference of rates or cotangents, in terms of these, up to which eigenvalues do not split."""


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def spectrum(matrix: Num[Array, "n n"], symmetric: bool) -> tuple[Num[Array, " n"], Num[Array, "n n"]]:
    """Eigenvalues, and eigenvectors in columns, differentiable to any order.

    Forward mode is exact where eigenvalues coincide and a change does not split them; where it does, their
    derivatives are NaN, and so are those of their eigenvectors within the span. Reverse mode does not know
    the change: it is exact for functions that have the same slope by all that coincide, else NaN.

    Args:
        matrix: A.
        symmetric: whether A is; if not, it needs the CPU, and both are complex.
    """
    values, vectors = jnp.linalg.eigh(matrix, symmetrize_input=False) if symmetric else jnp.linalg.eig(matrix)
    return values, vectors


@spectrum.defjvp
def _spectrum_jvp(symmetric: bool, primals: tuple, tangents: tuple) -> tuple:
    values, vectors = spectrum(*primals, symmetric)
    change = tangents[0].astype(vectors.dtype) @ vectors
    rates = vectors.T @ change if symmetric else jnp.linalg.solve(vectors, change)
    moved, mixed = linear_pair.apply(_Change(symmetric), values, rates, (values, rates))
    return (values, vectors), (moved, vectors @ mixed)


@dataclass(frozen=True)
class _Change(linear_pair.LinearWithTranspose):
    """Changes of the eigenvalues and C, linear in B, after the eigenvalues."""

    symmetric: bool

    def _near(self, values: Array) -> Bool[Array, "n n"]:
        """Pairs of eigenvalues that coincide; those that are not symmetric to the root of rounding."""
        rounding = values.shape[0] * jnp.finfo(values.dtype).eps
        rounding = MIXED * rounding if self.symmetric else rounding**0.5
        allowed = rounding * jnp.max(jnp.abs(values), initial=0.0) + SAME * _larger(values)
        return (jnp.abs(_differences(values)) <= allowed) & ~jnp.eye(values.shape[0], dtype=bool)

    def _over_gaps(self, values: Array, x: Array) -> Array:
        """Numbers of pairs over the gaps between their eigenvalues; zero where these coincide."""
        near = self._near(values) | jnp.eye(values.shape[0], dtype=bool)
        return jnp.where(near, 0.0, x / jnp.where(near, 1.0, _differences(values)))

    def forward(self, residuals: Array, arguments: Array) -> tuple[Array, Array]:
        """Changes of the eigenvalues, and C."""
        rates, near = jnp.diagonal(arguments), self._near(residuals)
        rounding = MIXED * rates.shape[0] * jnp.finfo(rates.dtype).eps
        allowed = rounding * jnp.max(jnp.abs(arguments), initial=0.0) + EVEN * _larger(rates)
        even = (jnp.abs(arguments) <= allowed) & (jnp.abs(_differences(rates)) <= allowed)
        split = near & ~even
        mixed = jnp.where(split, jnp.nan, self._over_gaps(residuals, arguments))
        return jnp.where(jnp.any(split, axis=1), jnp.nan, rates), mixed

    def backward(self, residuals: Array, cotangents: tuple[Array, Array]) -> Array:
        """Cotangents of B."""
        moved, mixed = cotangents
        turning = mixed - mixed.T if self.symmetric else mixed
        even = jnp.abs(_differences(moved)) <= EVEN * _larger(moved)
        even = even & (jnp.abs(turning) <= EVEN * jnp.max(jnp.abs(mixed), initial=0.0))
        found = jnp.diag(moved) + self._over_gaps(residuals, mixed)
        return jnp.where(self._near(residuals) & ~even, jnp.nan, found)

    def forward_changed(
        self, residuals: Array, changes: Any, arguments: Array, arguments_dot: Array
    ) -> tuple[Any, Any]:
        """The changes, and how they change."""
        value, (moved, mixed) = (
            linear_pair.apply(self, residuals, x, (residuals, arguments)) for x in (arguments, arguments_dot)
        )
        return value, (moved, mixed - value[1] * self._over_gaps(residuals, _differences(changes)))

    def backward_changed(
        self, residuals: Array, changes: Any, cotangents: Any, cotangents_dot: Any
    ) -> tuple[Any, Any]:
        """The cotangents, and how they change."""
        shape = cotangents[1]
        value, moved = (
            linear_pair.transposed(self, residuals, x, shape) for x in (cotangents, cotangents_dot)
        )
        closer = self._over_gaps(residuals, _differences(changes))
        return value, moved - self._over_gaps(residuals, shape) * closer


def _differences(x: Num[Array, " n"]) -> Num[Array, "n n"]:
    """x_j - x_i."""
    return x[None, :] - x[:, None]


def _larger(x: Num[Array, " n"]) -> Num[Array, "n n"]:
    return jnp.maximum(jnp.abs(x)[None, :], jnp.abs(x)[:, None])
