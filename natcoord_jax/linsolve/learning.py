"""Approximate inverses that learn from what their corrections bring about."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.linsolve.dense import Inverse

FORESEEN = 0.5
"""Part of the last correction that the next may undo or repeat; beyond, the inverse is of no use."""

SPEED = 2
"""Corrections by inverses that learn shrink ever faster: as those by others would that many times on."""


def learns(solver: Any) -> bool:
    """Whether a solver does: the inverse of a small matrix, where it costs little."""
    return isinstance(solver, Inverse)


def learnt(
    solver: Any,
    last: Float[Array, " n"],
    change: Float[Array, " n"],
    weights: Float[Array, " n"],
    telling: Bool[Array, ""],
) -> tuple[Any, Float[Array, " n"]]:
    """A solver that knows what the last correction has brought about, and the next correction by it.

    Broyden's first update, in a norm of one's choice: the inverse of rank one nearest to that at hand that
    would have found the solution, were the equations linear and the last correction all that was wrong.
    It costs two products with the matrix. The new correction is the old one in another length.

    Source: C. G. Broyden, A class of methods for solving nonlinear simultaneous equations,
    Math. Comp. 19 (1965) 577-593, with Sherman and Morrison's formula.

    Args:
        solver: X, approximately the inverse of the Jacobian.
        last: correction that was made, X r before it.
        change: the next one, X r after it.
        weights: of the norm.
        telling: whether they compare, and are more than rounding.

    Returns:
        The solver, and the next correction: X r with the new X. Both as they were where nothing is told.
    """
    if not learns(solver):
        return solver, change
    weighted = weights * last
    square, along = jnp.sum(weighted * last), jnp.sum(weighted * change)
    telling = telling & (square > 0) & (jnp.abs(along) <= FORESEEN * square)
    rest = jnp.where(telling, square - along, 1.0)
    solver = solver.updated(jnp.where(telling, change / rest, 0.0), weighted)
    return solver, jnp.where(telling, square / rest, 1.0) * change
