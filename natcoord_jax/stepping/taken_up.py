"""A rollout that goes on where another one ended, as if they were one."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.stepping.attempt import LoopCarry

COUNTED = "step", "taken", "rejected", "iterations", "iterations_max", "residual"
"""What a rollout counts for itself."""


class TakenUp(eqx.Module):
    """The end of a rollout that the next goes on with.

    Besides the state there are factors, guesses and what Newton's iteration has learnt: with all of them
    the states are those of one run, to the bit.

    Attributes:
        anew: whether there is none, and the rollout begins with its state.
        carried: what the loop over the steps ended with, its record left out.
    """

    anew: Bool[Array, ""]
    carried: LoopCarry


def going_on(first: LoopCarry, taken_up: TakenUp | None) -> LoopCarry:
    """What the loop over the steps begins with."""
    if taken_up is None:
        return first
    carried = taken_up.carried
    course = replace_fields(carried.course, **{name: getattr(first.course, name) for name in COUNTED})
    carried = replace_fields(carried, course=course, count=first.count, first=first.first)
    return jax.tree.map(lambda new, old: jnp.where(taken_up.anew, new, old), first, carried)
