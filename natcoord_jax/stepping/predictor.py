"""Guesses of the next solution from those of the last steps."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

ORDER = 7
"""Largest order of the polynomials that guess the next solution. Orders above three save up to two of six
corrections a step where motion is smooth; elsewhere a lower one is chosen."""


class Predictor(eqx.Module):
    """Solutions of the last steps, as backward differences, from which the next is guessed.

    The sum of the differences up to an order extrapolates by a polynomial of that order; what it misses is
    the next difference.

    Attributes:
        differences: of order 0 (the last solution), 1, ...
        known: how many of them there are.
        order: of the polynomial that would have guessed the last solution best.
    """

    differences: tuple[Float[Array, " unknowns"], ...]
    known: Int[Array, ""]
    order: Int[Array, ""]

    @classmethod
    def of(cls, y: Float[Array, " unknowns"]) -> "Predictor":
        """One solution."""
        rest = (jnp.zeros_like(y),) * ORDER
        return cls((y, *rest), jnp.array(1), jnp.array(0))

    def beginning_with(self, y: Float[Array, " unknowns"], solved: Bool[Array, ""]) -> "Predictor":
        """With the solution of an attempt that was made for comparison, if there is one."""
        first, *rest = self.differences
        return Predictor((jnp.where(solved, y, first), *rest), self.known, self.order)

    @property
    def guess(self) -> Float[Array, " unknowns"]:
        """Extrapolated by the polynomial that was best last time."""
        terms = [jnp.where(k <= self.order, d, 0.0) for k, d in enumerate(self.differences)]
        return sum(terms[1:], terms[0])

    def followed_by(self, y: Float[Array, " unknowns"], inertias: Float[Array, " unknowns"]) -> "Predictor":
        """The past after a step with the solution `y`."""
        found = [y]
        for difference in self.differences:
            found.append(found[-1] - difference)
        errors = jnp.stack([jnp.sum(inertias * d**2) for d in found[1:]])
        errors = jnp.where(jnp.arange(ORDER + 1) < self.known, errors, jnp.inf)
        return Predictor(tuple(found[:-1]), jnp.minimum(self.known + 1, ORDER + 1), jnp.argmin(errors))
