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


def remainder(equations: Any, residual: Float[Array, " unknowns"]) -> Float[Array, " rates"]:
    """Impulse that is missing in the balances of a step, sum_i b_i r_i, by rate.

    Args:
        equations: of the step.
        residual: of them where its iteration has ended.
    """
    balances = equations.by_stage(residual)
    if equations.tableau.stages == 1:
        return balances[0]
    return jnp.asarray(equations.tableau.b) @ balances


def with_remainder(
    equations: Any, residual: Float[Array, " unknowns"], left: Float[Array, " rates"]
) -> Float[Array, " unknowns"]:
    """Residual of equations in which an impulse acts that another step has left, the same at all stages."""
    return residual + equations.repeated(left)
