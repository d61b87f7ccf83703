"""What is wrong with stacked effects, where their numbers are known."""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect


def first_flaw(effect: Effect) -> tuple[int, str] | None:
    """The first of stacked instances with which something is wrong, and what, see `Effect.flaws`.

    Args:
        effect: instances, leading axis of all numbers.
    """
    if type(effect).flaws is Effect.flaws:
        return None
    for said, wrong in _flaws(effect).items():
        if is_concrete(wrong) and np.any(np.asarray(wrong)):
            return int(np.flatnonzero(np.asarray(wrong))[0]), said
    return None


def traced_flaws(effect: Effect) -> Bool[Array, " n"] | None:
    """With which of stacked instances something is wrong, as far as that is traced; None: nothing is.

    Args:
        effect: instances, leading axis of all numbers.
    """
    if type(effect).flaws is Effect.flaws:
        return None
    traced = [wrong for wrong in _flaws(effect).values() if not is_concrete(wrong)]
    return reduce(jnp.logical_or, traced) if traced else None


@eager_numpy
def _flaws(effect: Any) -> dict[str, Array]:
    return jax.vmap(lambda e: e.flaws())(effect)
