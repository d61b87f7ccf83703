"""Factors of a Jacobian, which serve over many steps, and what is known of them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.linsolve.learning import learns

NOISE = (1e-14, 2e-12)
"""Sizes of last corrections that are known, from the steps before, to be noise: stiff parts feel how their
places are rounded. Smaller ones are not worth the risk, since what is left of an error may add up; larger
ones may be slow convergence."""

NEVER = 1000
"""More corrections than a step can need."""

SLOWEST_UNSEEN = 0.02
"""Part of a correction that is assumed to be left at least where less has not been seen in earlier steps: a
slow part of the error may hide behind fast ones in the first ratio."""

CAUTION = 2.0
"""Times what earlier corrections have left to the next that another may leave."""

AGEING = 1.2
"""Times what was seen in one system that is taken for seen in the next, where no one looks."""

FORGETTING = 0.7
"""Part of the most that corrections have left which still counts after one that leaves less."""


class Factors(eqx.Module):
    """Factors of a Jacobian.

    Attributes:
        solver: `solve(right)` applies them.
        inertias: inertias of the unknowns, 0 for multipliers.
        usable: whether there are any.
        fresh: whether they belong to the step that is being solved.
        least: fewest corrections that a step has needed with them.
        extra: corrections beyond these that later steps have needed.
        noise: last correction of a step, relative to the terms of the equations, averaged over steps.
        grain: size of the terms that cancel in the equations [sqrt(J)], by which they are rounded.
        leaving: most that a correction has left to the next one lately, in terms of its size; 1: nothing is
            known yet.
    """

    solver: Any
    inertias: Float[Array, " unknowns"]
    usable: Bool[Array, ""]
    fresh: Bool[Array, ""]
    least: Int[Array, ""]
    extra: Int[Array, ""]
    noise: Float[Array, ""]
    grain: Float[Array, ""]
    leaving: Float[Array, ""]

    def after_step(self, it: Any, usable: Bool[Array, ""], cost: int) -> "Factors":
        """Factors for the next step: given up once they have cost more corrections than new ones would.

        Args:
            it: where the iteration of the step has ended.
            usable: whether it was solved.
            cost: of new factors, in corrections.
        """
        corrections = it.total
        # What was needed with new factors is no guide in the step that made them: it began with old ones.
        least = jnp.where(self.fresh, self.least, jnp.minimum(self.least, corrections))
        extra = self.extra + jnp.where(self.fresh, 0, jnp.maximum(corrections - least, 0))
        # Factors of a step that was hard to solve are of no use to others.
        keep = usable & self.usable & (extra <= cost) & (corrections <= 2 * cost)
        noise = jnp.where(usable & it.converged, 0.5 * (self.noise + it.error), self.noise)
        stale = jnp.zeros_like(self.fresh)
        return replace_fields(self, usable=keep, fresh=stale, least=least, extra=extra, noise=noise)

    def having_left(self, ratio: Array, telling: Array) -> "Factors":
        """What is known of them after a correction that was this part of the one before it, if that tells."""
        before = jnp.where(self.leaving < 1.0, FORGETTING * self.leaving, 0.0)
        leaving = jnp.where(telling, jnp.clip(ratio, before, 1.0), self.leaving)
        return eqx.tree_at(lambda f: f.leaving, self, leaving)

    @property
    def changing(self) -> tuple[Array, Any]:
        """What of them changes as they correct."""
        return self.leaving, self.solver if learns(self.solver) else None

    def with_changes(self, changes: tuple[Array, Any]) -> "Factors":
        """These, changed."""
        leaving, learnt = changes
        return replace_fields(self, leaving=leaving, solver=self.solver if learnt is None else learnt)

    def left_by(self, ratio: Array, first: Array) -> Float[Array, ""]:
        """Error that is expected after a correction, in terms of its size.

        Args:
            ratio: of its size to that of the one before it.
            first: whether it is the first one, to which nothing compares.
        """
        seen = jnp.minimum(CAUTION * self.leaving, 1.0)
        part = jnp.where(first, seen, jnp.maximum(ratio, jnp.minimum(seen, SLOWEST_UNSEEN)))
        return jnp.minimum(part / jnp.maximum(1.0 - part, 1e-3), jnp.where(first, 1.0, jnp.inf))

    def noise_of(self, size: Float[Array, ""]) -> Float[Array, ""]:
        """Size of corrections that are nothing but rounding [sqrt(J)]; 0 where it is not known or small.

        Args:
            size: of the terms of the equations, but for those that cancel.
        """
        (least, most), found = NOISE, self.noise * (size + self.grain)
        return jnp.where(found > least * size, jnp.minimum(found, most * size), 0.0)


def no_factors(equations: Any) -> Factors:
    """The shapes of factors, and none usable."""
    y = equations.guess()
    shapes = jax.eval_shape(equations.factorised, equations.like_tangent(y))
    solver, inertias = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    no, noise = jnp.array(False), jnp.zeros((), y.dtype)
    return Factors(solver, inertias, no, no, jnp.array(NEVER), jnp.array(0), noise, noise, noise + 1.0)


def factors_of(made: tuple[Any, Array], noise: Array | float = 0.0, grain: Array | float = 0.0) -> Factors:
    """Factors that have just been made, with the inertias of the unknowns."""
    solver, inertias = made
    yes, noise = jnp.array(True), jnp.asarray(noise, inertias.dtype)
    grain, unknown = jnp.asarray(grain, inertias.dtype), jnp.ones_like(noise)
    never = jnp.array(NEVER), jnp.array(0)
    return Factors(solver, inertias, yes, yes, *never, noise, grain, unknown)
