"""Linear systems, solved by corrections with factors that need not be their own."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.linsolve.learning import MEMORY, SPEED, across, learns, learnt
from natcoord_jax.stepping.factors import Factors

CLOSE = 1e-12
"""Error of the solution of a transposed system relative to its size."""

CLOSE_FORWARD = 1e-13
"""The same of a system that is not transposed: errors of tangents add up from slot to slot."""

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
"""Factorisations for one system."""


class Correcting(eqx.Module):
    """Where the solution of a transposed system stands.

    It is solved where an evaluation at the solution says so, never before: factors of another system, and what
    corrections have left there, are a guess of how many corrections it takes.

    Attributes:
        change: last correction with these factors.
        news: the part of it that is across those before it, of which the factors have learnt. What they make
            of the others is known: equations are linear here. Only of this part an error remains.
        known: the same of corrections of which the factors have learnt, if they are of that kind; the last
            one first.
        correction: size of the news (energy norm).
        count: corrections with these factors.
        rounds: factorisations for this system.
        done: whether it is solved.
        wanting: whether it cannot go on without new factors.
        moving: whether the last correction is to be made.
        last: whether the next evaluation is expected to be at the solution.
    """

    change: Float[Array, " unknowns"]
    news: Float[Array, " unknowns"]
    known: Float[Array, "corrections unknowns"]
    correction: Float[Array, ""]
    count: Int[Array, ""]
    rounds: Int[Array, ""]
    done: Bool[Array, ""]
    wanting: Bool[Array, ""]
    moving: Bool[Array, ""]
    last: Bool[Array, ""]

    @classmethod
    def first(cls, lam: Float[Array, " unknowns"], factors: Factors) -> "Correcting":
        """Before the first correction."""
        memory = min(MEMORY, lam.size) if learns(factors.solver) else 0
        nought, no = jnp.array(0), jnp.array(False)
        nothing = jnp.zeros_like(lam)
        known = jnp.zeros((memory, *lam.shape), lam.dtype)
        size = jnp.zeros((), lam.dtype)
        return cls(nothing, nothing, known, size, nought, nought, no, no, no, no)

    @property
    def open(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return ~self.done & ((self.rounds < ROUNDS) | ~self.wanting)

    @property
    def going(self) -> Bool[Array, ""]:
        """Whether to go on with the factors at hand."""
        return ~self.done & ~self.wanting

    def unless(self, failed: Bool[Array, ""]) -> "Correcting":
        """Done, if it is that of an attempt that failed: there is nothing to solve."""
        return eqx.tree_at(lambda c: c.done, self, self.done | failed)

    def refreshed(self) -> "Correcting":
        """With new factors."""
        nought, no = jnp.zeros_like(self.count), jnp.zeros_like(self.last)
        return eqx.tree_at(
            lambda c: (c.known, c.count, c.rounds, c.wanting, c.last),
            self,
            (jnp.zeros_like(self.known), nought, self.rounds + 1, no, no),
        )

    def judged(
        self,
        factors: Factors,
        lam: Array,
        residual: Array,
        patience: int,
        whole: Array,
        transposed: bool = True,
    ) -> tuple["Correcting", Factors]:
        """After an evaluation: done, or moving on by a correction, or in want of new factors.

        Args:
            factors: at hand.
            lam: solution as it is.
            residual: of the equations.
            patience: corrections that are cheaper than new factors.
            whole: size of the solution if nothing cancelled.
            transposed: whether the system is that of the transposed Jacobian.

        Returns:
            Where it stands, and the factors, which have learnt from it if they are of that kind.
        """
        solver = factors.solver.transpose() if transposed else factors.solver
        weights = _weights(factors.inertias)
        change = solver.solve(residual)
        size = _size(lam, weights)
        allowed = jnp.maximum((CLOSE if transposed else CLOSE_FORWARD) * size, ROUND_OFF * whole)
        known, news = self.known, change
        if learns(solver):  # Others would only be transposed twice.
            telling = self.going & (self.count > 0) & (self.correction > allowed)
            solver, change, telling = learnt(solver, self.change, change, weights, telling, self.news)
            given_back = solver.transpose() if transposed else solver
            factors = eqx.tree_at(lambda f: f.solver, factors, given_back)
            known = jnp.where(telling, jnp.concatenate([self.news[None], known[:-1]]), known)
            news = across(known, change, weights)
        correction, entire = _size(news, weights), _size(change, weights)
        ratio = correction / jnp.where(self.correction > 0, self.correction, 1.0)
        first = self.count == 0
        finite = jnp.isfinite(correction) & jnp.isfinite(size)
        floor = jnp.maximum(STALL * size, STALL_ROUND_OFF * whole)
        # With factors of another system, corrections that stop shrinking may be these factors' fault.
        stalled = ~first & (ratio > 0.5) & (entire <= floor) & (self.rounds > 0)
        within = entire <= jnp.where(self.last, SURPRISE, 1.0) * allowed
        done = (within | stalled) & finite & factors.usable
        following = correction * factors.left_by(ratio, first)
        compares = self.going & ~first & (self.correction > allowed) & finite
        factors = factors.having_left(ratio, compares)
        last = following <= allowed
        late = correction * ratio ** (patience * (SPEED if learns(solver) else 1)) > allowed
        slow = (~first & ((ratio > 0.5) | late)) | (self.count >= CORRECTIONS) | ~finite | ~factors.usable
        slow = slow & ~done
        moving = ~slow & ~done
        count = self.count + 1
        found = Correcting(change, news, known, correction, count, self.rounds, done, slow, moving, last)
        stay = eqx.tree_at(lambda c: c.moving, self, jnp.zeros_like(self.moving))
        return jax.tree.map(partial(jnp.where, ~self.going), stay, found), factors


def _size(lam: Float[Array, " unknowns"], weights: Float[Array, " unknowns"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(weights * lam**2))


def _weights(inertias: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
    """Weights of the energy norm, where constraints count, too.

    Where drives prescribe every motion, nothing else is left; they carry impulses that stop a mean inertia.
    """
    moving = inertias > 0
    mean = jnp.sum(inertias) / jnp.maximum(jnp.sum(moving), 1)
    return jnp.where(moving, inertias, 1.0 / jnp.where(mean > 0, mean, 1.0))
