"""Transposed systems, solved by corrections with factors that need not be their own."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.stepping.newton import Factors

CLOSE = 1e-12
"""Last correction of a transposed system relative to its solution."""

STALL = 1e-10
"""Corrections that stop shrinking below this have reached the floor of round-off."""

CORRECTIONS = 30
"""Corrections with one factorisation."""

ROUNDS = 4
"""Factorisations for one transposed system."""


class Correcting(eqx.Module):
    """Where the solution of a transposed system stands."""

    correction: Float[Array, ""]
    count: Int[Array, ""]
    rounds: Int[Array, ""]
    done: Bool[Array, ""]
    wanting: Bool[Array, ""]
    moving: Bool[Array, ""]

    @classmethod
    def first(cls, accepted: Bool[Array, ""], dtype: Any) -> "Correcting":
        """Before the first correction; there is nothing to do for an attempt that failed."""
        nought, no = jnp.array(0), jnp.array(False)
        return cls(jnp.zeros((), dtype), nought, nought, ~accepted, no, no)

    @property
    def open(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return ~self.done & ((self.rounds < ROUNDS) | ~self.wanting)

    def refreshed(self) -> "Correcting":
        """With new factors."""
        nought = jnp.zeros_like(self.count)
        return eqx.tree_at(
            lambda c: (c.count, c.rounds, c.wanting),
            self,
            (nought, self.rounds + 1, jnp.zeros_like(self.wanting)),
        )

    def judged(self, factors: Factors, lam: Array, change: Array, patience: int) -> "Correcting":
        """After a correction has been found: done, or moving on by it, or in want of new factors."""
        size, correction = (jnp.sqrt(jnp.sum(factors.inertias * x**2)) for x in (lam, change))
        ratio = correction / jnp.where(self.correction > 0, self.correction, 1.0)
        first = self.count == 0
        finite = jnp.isfinite(correction) & jnp.isfinite(size)
        stalled = ~first & (ratio > 0.5) & (correction <= STALL * size)
        done = ((correction <= CLOSE * size) | stalled) & finite
        late = correction * ratio**patience > CLOSE * size
        slow = (~first & ((ratio > 0.5) | late)) | (self.count >= CORRECTIONS) | ~finite | ~factors.usable
        slow = slow & ~done
        found = Correcting(correction, self.count + 1, self.rounds, done, slow, ~done & ~slow)
        stay = eqx.tree_at(lambda c: c.moving, self, jnp.zeros_like(self.moving))
        return jax.tree.map(partial(jnp.where, self.done), stay, found)
