"""Linear systems, solved by corrections with factors that need not be their own."""

from functools import partial
from typing import Any

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
"""Times the error allowed by which the correction may be larger that was expected to be within it, and the
error by masses alone: rounding leaves as much as is allowed."""

STALL = 1e-10
"""Corrections that stop shrinking below this have reached the floor of round-off."""

CORRECTIONS = 30
"""Corrections with one factorisation."""

ROUNDS = 3
"""Factorisations for one system."""


class LinearIteration(eqx.Module):
    """Where the solution of a transposed system stands.

    It is solved where an evaluation at the solution says so, never before: factors of another system, and
    what corrections have left there, are a guess of how many corrections it takes. Such factors may not even
    see an error, as those of a stiff stop do not where the stop is left. So the residual has to be small in
    terms of the masses alone, too: the error is no larger, whatever stiffness there is. Where rounding
    of stiff forces leaves more, factors of its own tell.

    Attributes:
        change: last correction with these factors.
        news: the part of it that is across those before it, of which the factors have learnt. What they make
            of the others is known: equations are linear here. Only of this part an error remains.
        known: the same of corrections of which the factors have learnt, if they are of that kind; the last
            one first.
        correction: size of the news (energy norm).
        count: corrections with these factors.
        rounds: factorisations for this system.
        rows: rows of its matrix that have been formed for the next.
        most: rows that are to be formed: none where factors are made of formulas.
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
    rows: Int[Array, ""]
    most: Int[Array, ""]
    done: Bool[Array, ""]
    wanting: Bool[Array, ""]
    moving: Bool[Array, ""]
    last: Bool[Array, ""]

    @classmethod
    def first(cls, lam: Float[Array, " unknowns"], factors: Factors, most: int) -> "LinearIteration":
        """Before the first correction, where so many rows of the matrix are to be formed for new factors."""
        memory, learning = min(MEMORY, lam.size), learns(factors.solver)
        nought, no = jnp.array(0), jnp.array(False)
        nothing = jnp.zeros_like(lam)
        known = jnp.zeros((memory * learning, *lam.shape), lam.dtype)
        size = jnp.zeros((), lam.dtype)
        counts = nought, nought, nought, nought + most
        return cls(nothing, nothing, known, size, *counts, no, no, no, no)

    @property
    def open(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return ~self.done & ((self.rounds < ROUNDS) | ~self.wanting)

    @property
    def forming(self) -> Bool[Array, ""]:
        """Whether another row of its matrix is to be formed, for new factors."""
        return self.wanting & self.open & (self.rows < self.most)

    @property
    def going(self) -> Bool[Array, ""]:
        """Whether to go on with the factors at hand."""
        return ~self.done & ~self.wanting

    def refreshed(self, most: int) -> "LinearIteration":
        """With new factors; for the next ones, so many rows of the matrix are to be formed."""
        nought, no = jnp.zeros_like(self.count), jnp.zeros_like(self.last)
        known = jnp.zeros_like(self.known)
        return eqx.tree_at(
            lambda c: (c.known, c.count, c.rounds, c.rows, c.most, c.wanting, c.last),
            self,
            (known, nought, self.rounds + 1, nought, nought + most, no, no),
        )

    def _proposed(
        self, solver: Any, residual: Array, weights: Array, allowed: Array
    ) -> tuple[Any, Array, tuple[Array, Array, Array]]:
        """The solver with what it has learnt, the next correction, and what is kept of it."""
        change = solver.solve(residual)
        if not learns(solver):
            return solver, change, (change, change, self.known)
        telling = self.going & (self.count > 0) & (self.correction > allowed)
        solver, change, telling = learnt(solver, self.change, change, weights, telling, self.news)
        known = jnp.where(telling, jnp.concatenate([self.news[None], self.known[:-1]]), self.known)
        news = across(known, change, weights)
        return solver, change, (change, news, known)

    def judged(
        self,
        factors: Factors,
        lam: Array,
        residual: Array,
        masses: Float[Array, " balances"],
        patience: int,
        whole: Array,
        transposed: bool = True,
    ) -> tuple["LinearIteration", Factors]:
        """After an evaluation: done, or moving on by a correction, or in want of new factors.

        Args:
            factors: at hand.
            lam: solution as it is.
            residual: of the equations.
            masses: inertias that the unknowns have at least, see `least_inertias`.
            patience: corrections that are cheaper than new factors.
            whole: size of the solution if nothing cancelled.
            transposed: whether the system is that of the transposed Jacobian.

        Returns:
            Where it stands, and the factors, which have learnt from it if they are of that kind.
        """
        solver = factors.solver.transpose() if transposed else factors.solver
        weights = _weights(factors.inertias)
        size = _size(lam, weights)
        allowed = jnp.maximum((CLOSE if transposed else CLOSE_FORWARD) * size, ROUND_OFF * whole)
        solver, change, made = self._proposed(solver, residual, weights, allowed)
        if learns(solver):  # Others have not changed, and would only be transposed twice.
            given_back = solver.transpose() if transposed else solver
            factors = eqx.tree_at(lambda f: f.solver, factors, given_back)
        correction, entire = _size(made[1], weights), _size(change, weights)
        ratio = correction / jnp.where(self.correction > 0, self.correction, 1.0)
        first = self.count == 0
        later = ~first
        finite = jnp.isfinite(correction) & jnp.isfinite(size)
        floor = jnp.maximum(STALL * size, STALL_ROUND_OFF * whole)
        # With factors of another system, corrections that stop shrinking may be these factors' fault.
        own = self.rounds > 0
        within = entire <= jnp.where(self.last, SURPRISE, 1.0) * allowed
        size_by_mass, missing = sizes_by_mass(lam, residual, masses)
        close_by_mass = (CLOSE if transposed else CLOSE_FORWARD) * size_by_mass
        sure = missing <= SURPRISE * jnp.maximum(close_by_mass, ROUND_OFF * whole)
        # Of contacts that share a load each bears what its compliance says, to fewer digits than the floor:
        # where the residual is that of rounding, nothing gets nearer.
        stalled = later & (ratio > 0.5) & own & (sure | (entire <= floor))
        done = (within | stalled) & (own | sure) & finite & factors.usable
        following = correction * factors.left_by(ratio, first)
        compares = self.going & later & (self.correction > allowed) & finite
        factors = factors.having_left(ratio, compares)
        last = following <= allowed
        late = correction * ratio ** (patience * (SPEED if learns(solver) else 1)) > allowed
        # Formulas leave out what is mostly small, and no others would take more of it in.
        slow = later & ((ratio > 0.5) | late) & ~(own & (not learns(solver)))
        slow = slow | (self.count >= CORRECTIONS) | ~finite | ~factors.usable
        slow = slow & ~done
        moving = ~slow & ~done
        count = self.count + 1
        rounds = self.rounds, self.rows, self.most
        found = LinearIteration(*made, correction, count, *rounds, done, slow, moving, last)
        stay = eqx.tree_at(lambda c: c.moving, self, jnp.zeros_like(self.moving))
        return jax.tree.map(partial(jnp.where, ~self.going), stay, found), factors


def _size(lam: Float[Array, " unknowns"], weights: Float[Array, " unknowns"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(weights * lam**2))


def sizes_by_mass(
    lam: Float[Array, " unknowns"], residual: Float[Array, " unknowns"], masses: Float[Array, " balances"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Size of a solution, and of its error by masses: without stiffness, a residual is mass times error."""
    mean = jnp.sum(masses) / max(masses.shape[0], 1)
    mean = jnp.where(mean > 0, mean, 1.0)
    real = jnp.where(masses > 0, masses, jnp.inf)
    rest = residual.shape[0] - masses.shape[0]
    own = jnp.concatenate([masses, jnp.full(rest, 1.0 / mean, residual.dtype)])
    dual = jnp.concatenate([1.0 / real, jnp.full(rest, mean, residual.dtype)])
    return _size(lam, own), _size(residual, dual)


def _weights(inertias: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
    """Weights of the energy norm, where constraints count, too.

    Where drives prescribe every motion, nothing else is left; they carry impulses that stop a mean inertia.
    """
    moving = inertias > 0
    mean = jnp.sum(inertias) / jnp.maximum(jnp.sum(moving), 1)
    return jnp.where(moving, inertias, 1.0 / jnp.where(mean > 0, mean, 1.0))
