"""Approximate inverses that learn from what their corrections bring about."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.linsolve.dense import Inverse

FORESEEN = 0.5
"""Part of the last correction that the next may undo or repeat; beyond, the inverse is of no use."""

SPEED = 2
"""Corrections by inverses that learn shrink ever faster: as those by others would that many times on."""


MEMORY = 6
"""Corrections whose consequences are kept while more are learnt. More of them help loops, a little."""


def learns(solver: Any) -> bool:
    """Whether a solver does: the inverse of a small matrix, where it costs little."""
    return isinstance(solver, Inverse)


def learnt(
    solver: Any,
    last: Float[Array, " n"],
    change: Float[Array, " n"],
    weights: Float[Array, " n"],
    telling: Bool[Array, ""],
    news: Float[Array, " n"] | None = None,
) -> tuple[Any, Float[Array, " n"], Bool[Array, ""]]:
    """A solver that knows what the last correction has brought about, and the next correction by it.

    Broyden's first update, in a norm of one's choice: the inverse of rank one nearest to that at hand that
    would have found the solution, were the equations linear and the last correction all that was wrong.
    It costs two products with the matrix. The new correction is the old one in another length.

    Source: C. G. Broyden, A class of methods for solving nonlinear simultaneous equations,
    Math. Comp. 19 (1965) 577-593, with Sherman and Morrison's formula. With news: D. M. Gay and
    R. B. Schnabel, Solving systems of nonlinear equations by Broyden's method with projected updates, in
    Nonlinear Programming 3 (1978) 245-281. Linear equations are then solved by one correction more than
    there are unknowns, instead of twice as many.

    Args:
        solver: X, approximately the inverse of the Jacobian.
        last: correction that was made, X r before it.
        change: the next one, X r after it.
        weights: of the norm.
        telling: whether they compare, and are more than rounding.
        news: the part of the last correction that is across those before it (`across`), of which the inverse
            has learnt: what it knows of these stays as it is. Without, nothing is known.

    Returns:
        The solver, the next correction (X r with the new X), and whether it has learnt. If not, both are as
        they were.
    """
    if not learns(solver):
        return solver, change, jnp.zeros_like(telling)
    weighted = weights * (last if news is None else news)
    square, along = jnp.sum(weighted * last), jnp.sum(weighted * change)
    telling = telling & (square > 0) & (jnp.abs(along) <= FORESEEN * square)
    rest = jnp.where(telling, square - along, 1.0)
    solver = solver.updated(jnp.where(telling, change / rest, 0.0), weighted)
    return solver, jnp.where(telling, square / rest, 1.0) * change, telling


def across(
    known: Float[Array, "corrections n"], change: Float[Array, " n"], weights: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The part of a correction that is orthogonal to others.

    Args:
        known: others, orthogonal to each other; 0 where there is none.
        change: correction.
        weights: of the norm.

    Returns:
        What is left.
    """
    squares = jnp.sum(weights * known**2, axis=1)
    along = jnp.sum(known * (weights * change), axis=1) / jnp.where(squares > 0, squares, 1.0)
    return change - jnp.sum(along[:, None] * known, axis=0)
