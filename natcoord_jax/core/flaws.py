"""What is wrong with stacked effects, where their numbers are known."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Bool

from natcoord_jax.core.arguments import Part
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect


def flaws_of(effect: Effect) -> tuple[tuple[int, str] | None, list[Bool[Array, " n"]]]:
    """What is wrong with stacked instances and with what is in their fields, as their material.

    Args:
        effect: instances, leading axis of all numbers.

    Returns:
        Number of the first with which something is wrong, and what, see `Part.flaws`; None: nothing is known
        to be. And with which something is, as far as that is traced.
    """
    flaws = _of_lanes(effect) if any(type(part).flaws is not Part.flaws for part in parts(effect)) else {}
    known = {said: np.flatnonzero(wrong) for said, wrong in flaws.items() if is_concrete(wrong)}
    first = next(((int(numbers[0]), said) for said, numbers in known.items() if numbers.size), None)
    return first, [wrong for said, wrong in flaws.items() if said not in known]


@eager_numpy
def _of_lanes(effect: Effect) -> dict[str, Array]:
    return jax.vmap(lambda e: {said: wrong for part in parts(e) for said, wrong in part.flaws().items()})(
        effect
    )


def parts(part: Part) -> list[Part]:
    """A part, and those in its fields."""
    values = (getattr(part, field.name) for field in dataclasses.fields(part))
    return [part, *(inner for value in values if isinstance(value, Part) for inner in parts(value))]
