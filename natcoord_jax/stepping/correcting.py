"""Transposed systems, solved by corrections with factors that need not be their own."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.stepping.newton import SLOWEST_UNSEEN, Factors

CLOSE = 1e-12
"""Error of the solution of a transposed system relative to its size."""

ROUND_OFF = 1e-15
"""The same relative to what the solution would be if nothing cancelled. The gradient of a quantity that is
kept is zero but for rounding, and no solution can be right to its own size then."""

STALL_ROUND_OFF = 1e-12
"""The same for corrections that stop shrinking."""

SURPRISE = 10.0
"""Times the error allowed by which the correction may be larger that was expected to be within it."""

STALL = 1e-10
"""Corrections that stop shrinking below this have reached the floor of round-off."""

CORRECTIONS = 30
"""Corrections with one factorisation."""

ROUNDS = 4
"""Factorisations for one transposed system."""


class Correcting(eqx.Module):
    """Where the solution of a transposed system stands.

    Attributes:
        correction: size of the last correction (energy norm).
        count: corrections with these factors.
        rounds: factorisations for this system.
        done: whether it is solved.
        wanting: whether it cannot go on without new factors.
        moving: whether the last correction is to be made.
        last: whether the next correction is expected to be within the error allowed.
    """

    correction: Float[Array, ""]
    count: Int[Array, ""]
    rounds: Int[Array, ""]
    done: Bool[Array, ""]
    wanting: Bool[Array, ""]
    moving: Bool[Array, ""]
    last: Bool[Array, ""]

    @classmethod
    def first(cls, accepted: Bool[Array, ""], dtype: Any) -> "Correcting":
        """Before the first correction; there is nothing to do for an attempt that failed."""
        nought, no = jnp.array(0), jnp.array(False)
        return cls(jnp.zeros((), dtype), nought, nought, ~accepted, no, no, no)

    @property
    def open(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return ~self.done & ((self.rounds < ROUNDS) | ~self.wanting)

    @property
    def going(self) -> Bool[Array, ""]:
        """Whether to go on with the factors at hand."""
        return ~self.done & ~self.wanting

    def refreshed(self) -> "Correcting":
        """With new factors."""
        nought = jnp.zeros_like(self.count)
        return eqx.tree_at(
            lambda c: (c.count, c.rounds, c.wanting, c.last),
            self,
            (nought, self.rounds + 1, jnp.zeros_like(self.wanting), jnp.zeros_like(self.last)),
        )

    def judged(
        self, factors: Factors, lam: Array, change: Array, patience: int, whole: Array
    ) -> "Correcting":
        """After a correction has been found: done, or moving on by it, or in want of new factors.

        Args:
            factors: at hand.
            lam: solution as it is.
            change: correction of it.
            patience: corrections that are cheaper than new factors.
            whole: size of the solution if nothing cancelled.
        """
        size, correction = (_size(x, factors.inertias) for x in (lam, change))
        allowed = jnp.maximum(CLOSE * size, ROUND_OFF * whole)
        ratio = correction / jnp.where(self.correction > 0, self.correction, 1.0)
        first = self.count == 0
        finite = jnp.isfinite(correction) & jnp.isfinite(size)
        floor = jnp.maximum(STALL * size, STALL_ROUND_OFF * whole)
        stalled = ~first & (ratio > 0.5) & (correction <= floor)
        within = correction <= jnp.where(self.last, SURPRISE, 1.0) * allowed
        done = (within | stalled) & finite & factors.usable
        trusted = jnp.maximum(ratio, SLOWEST_UNSEEN)
        following = correction * trusted / jnp.maximum(1.0 - trusted, 1e-3)
        last = ~first & (following <= allowed)
        late = correction * ratio**patience > allowed
        slow = (~first & ((ratio > 0.5) | late)) | (self.count >= CORRECTIONS) | ~finite | ~factors.usable
        slow = slow & ~done
        found = Correcting(correction, self.count + 1, self.rounds, done, slow, ~done & ~slow, last)
        stay = eqx.tree_at(lambda c: c.moving, self, jnp.zeros_like(self.moving))
        return jax.tree.map(partial(jnp.where, ~self.going), stay, found)


def _size(lam: Float[Array, " unknowns"], inertias: Float[Array, " unknowns"]) -> Float[Array, ""]:
    """Size of a solution in the energy norm, where constraints count, too.

    Where drives prescribe every motion, nothing else is left; they carry impulses that stop a mean inertia.
    """
    moving = inertias > 0
    mean = jnp.sum(inertias) / jnp.maximum(jnp.sum(moving), 1)
    weights = jnp.where(moving, inertias, 1.0 / jnp.where(mean > 0, mean, 1.0))
    return jnp.sqrt(jnp.sum(weights * lam**2))
