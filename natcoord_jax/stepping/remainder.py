"""What rounding leaves of the balances of one step is made up for in the next.

Newton's iteration ends where its corrections are rounding. What is missing in the balances then is known, but
cannot be mended: the unknowns are as good as numbers of their length can be. It is of either sign, but not
quite as often of one as of the other where motions repeat themselves; of a million steps 1e-18 each of energy
and angular momentum would be left, with a direction. Taken for an impulse of the next step, it does not add
up: what is left in the end is that of the last step. Only its change of place and axes from step to step is
lost, a small part of it.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.maths.vectors import safe_divide
from natcoord_jax.mechanics.momentum import motion

ROUNDING = 1e-14
"""Impulse in terms of the momenta (energy norm) up to which it is handed on. What stiff forces leave is more,
and has their direction: turned with the body by one step, it would be an impulse in others, too."""


def remainder(
    equations: Any, residual: Float[Array, " unknowns"], inertias: Float[Array, " unknowns"]
) -> Float[Array, " rates"]:
    """Impulse that is missing in the balances of a step, sum_i b_i r_i, by rate; zero if it is no rounding.

    Args:
        equations: of the step.
        residual: of them where its iteration has ended.
        inertias: of the unknowns.
    """
    balances = equations.by_stage(residual)
    found = balances[0]
    if equations.tableau.stages > 1:
        found = jnp.asarray(equations.tableau.b) @ balances
    size = jnp.sum(safe_divide(found**2, equations.by_stage(inertias)[0]))
    moving = motion(equations.system.mass, equations.velocity)
    return jnp.where(size <= ROUNDING**2 * moving, found, 0.0)


def with_remainder(
    equations: Any, residual: Float[Array, " unknowns"], left: Float[Array, " rates"]
) -> Float[Array, " unknowns"]:
    """Residual of equations in which an impulse acts that another step has left, the same at all stages."""
    return residual + equations.repeated(left)
