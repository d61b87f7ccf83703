"""What is wrong with stacked effects, where their numbers are known."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Bool

from natcoord_jax.core.arguments import Part
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect


def first_flaw(effect: Effect) -> tuple[int, str] | None:
    """The first of stacked instances with which something is wrong, and what, see `Part.flaws`.

    Args:
        effect: instances, leading axis of all numbers.
    """
    for said, wrong in _flaws(effect).items():
        if is_concrete(wrong) and np.any(np.asarray(wrong)):
            return int(np.flatnonzero(np.asarray(wrong))[0]), said
    return None


def traced_flaws(effect: Effect) -> list[Bool[Array, " n"]]:
    """With which of stacked instances something is wrong, as far as that is traced.

    Args:
        effect: instances, leading axis of all numbers.
    """
    return [wrong for wrong in _flaws(effect).values() if not is_concrete(wrong)]


def _flaws(effect: Effect) -> dict[str, Array]:
    """Those of all instances and of what is in their fields, as their material."""
    return _of_lanes(effect) if any(type(part).flaws is not Part.flaws for part in parts(effect)) else {}


@eager_numpy
def _of_lanes(effect: Effect) -> dict[str, Array]:
    return jax.vmap(lambda e: {said: wrong for part in parts(e) for said, wrong in part.flaws().items()})(
        effect
    )


def parts(part: Part) -> list[Part]:
    """A part, and those in its fields."""
    values = (getattr(part, field.name) for field in dataclasses.fields(part))
    return [part, *(inner for value in values if isinstance(value, Part) for inner in parts(value))]
