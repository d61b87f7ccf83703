"""Choice of substeps by their error: every substep is made whole and in two halves, and the halves are kept.

The two differ by 2^p - 1 times the error of the halves, p being the order of the scheme. Any scheme can be
controlled so, and what it conserves is conserved, for what is kept are ordinary steps of it; estimates from
within a step of s stages would be of order s only. It takes half as much work again as the halves alone.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau

SAFETY = 0.9
"""Of the length that would make just the error that is tolerated, the part that is tried."""

SLOWEST, FASTEST = 0.2, 2.0
"""Bounds of the change of length from one attempt to the next."""

SMALLEST = 1e-9
"""Fraction of a step below which a run is given up."""

WHOLE, FIRST, SECOND = 0, 1, 2
"""The attempts at a substep: whole, its first half, its second half."""


class Tolerance(eqx.Module):
    """What error a substep may have: relative, and absolute [m; 1 for directors; the same per second]."""

    relative: Float[Array, ""]
    absolute: Float[Array, ""]

    @classmethod
    def of(cls, rtol: Any, atol: Any) -> "Tolerance | None":
        """From what `simulate` is given; None without `rtol`.

        Raises:
            ValueError: for a negative tolerance, two that are zero, or `atol` alone.
        """
        if rtol is None:
            if atol is not None:
                raise ValueError("atol is given without rtol; pass rtol, 0 for an absolute tolerance alone")
            return None
        relative = jnp.asarray(rtol, float)
        absolute = relative if atol is None else jnp.asarray(atol, float)
        for name, value in (("rtol", relative), ("atol [m]", absolute)):
            if value.shape != () or (is_concrete(value) and not 0 <= float(value) < np.inf):
                raise ValueError(f"{name} is {value}; pass a number that is not negative")
        if is_concrete(relative) and is_concrete(absolute) and float(relative) == float(absolute) == 0:
            raise ValueError("rtol and atol are both zero, and no step is without error; pass a positive one")
        return cls(relative, absolute)

    def excess(self, start: State, one: State, other: State, tableau: Tableau) -> Float[Array, ""]:
        """Largest error of any row of `one`, and of its velocity, in units of what is tolerated.

        Without kicks velocities have a part along the normals of the constraints that changes its sign from
        step to step and falls more slowly than the error of positions; they are left out then.

        Args:
            start: state before both.
            one: reached in two halves.
            other: reached at once.
            tableau: of the scheme.
        """
        largest = jnp.zeros(())
        compared = [(start.q, one.q, other.q)] + [(start.v, one.v, other.v)] * tableau.tangent
        for x0, x, y in compared:
            error = jnp.sqrt(jnp.sum((x - y) ** 2, axis=-1)) / (2.0**tableau.order - 1.0)
            size = jnp.sqrt(jnp.maximum(jnp.sum(x0**2, axis=-1), jnp.sum(x**2, axis=-1)))
            tolerated = self.absolute + self.relative * size
            # Where nothing is tolerated, only nothing is within it.
            allowed = jnp.where(tolerated > 0, tolerated, jnp.finfo(x.dtype).tiny)
            largest = jnp.maximum(largest, jnp.max(error / allowed, initial=0.0))
        return largest


class Trial(eqx.Module):
    """Where a substep with error control stands.

    Attributes:
        phase: which attempt comes next, see `WHOLE`.
        wish: fraction of the step that a substep should have by the last error.
        length: fraction of the step that the substep at hand has.
        origin: state that it starts from.
        done: part of the step before it.
        whole: state that it reached at once.
        undone: whether the slot before this one has just been taken back.
        repeated: whether the substep at hand is one that failed before.
        left: impulse that was left before it, see `remainder`.
    """

    phase: Int[Array, ""]
    wish: Float[Array, ""]
    length: Float[Array, ""]
    origin: State
    done: Float[Array, ""]
    whole: State
    undone: Bool[Array, ""]
    repeated: Bool[Array, ""]
    left: Float[Array, " rates"]

    @classmethod
    def first(cls, state: State, left: Float[Array, " rates"]) -> "Trial":
        """Before the first attempt: the whole step."""
        nought, one = jnp.array(0), jnp.ones(())
        no = jnp.array(False)
        return cls(nought, one, one, state, 0.0 * one, state, no, no, left)

    def wish_after(
        self, excess: Float[Array, ""], solved: Bool[Array, ""], failed: Bool[Array, ""], order: int
    ) -> Float[Array, ""]:
        """Fraction of the step for the next substep.

        Args:
            excess: error of the one at hand in units of what is tolerated.
            solved: whether the last attempt reached an end.
            failed: whether the one at hand has to be repeated.
            order: of the scheme.
        """
        measured = SAFETY * jnp.where(excess > 0, excess, 1.0) ** (-1.0 / (order + 1))
        factor = jnp.clip(jnp.where(excess > 0, measured, FASTEST), SLOWEST, FASTEST)
        shorter = self.length * jnp.where(solved, jnp.minimum(factor, SAFETY), 0.5)
        # What has just failed would fail again.
        longer = self.length * jnp.where(self.repeated, jnp.minimum(factor, 1.0), factor)
        # A substep shortened to meet the end of the step says nothing against longer ones.
        longer = jnp.where(self.length < 0.99 * self.wish, jnp.maximum(self.wish, longer), longer)
        return jnp.where(failed, shorter, jnp.minimum(longer, 1.0))

    def beginning(self, done: Float[Array, ""], anew: Bool[Array, ""]) -> "Trial":
        """The trial with a substep that begins after a part `done` of the step, if one does.

        What is left of the step is shared out in equal parts, no longer than wished for.
        """
        rest = 1.0 - done
        length = rest / jnp.maximum(jnp.ceil(rest / self.wish - 1e-3), 1.0)
        return eqx.tree_at(
            lambda t: (t.done, t.length),
            self,
            (jnp.where(anew, done, self.done), jnp.where(anew, length, self.length)),
        )


class StepDecision(eqx.Module):
    """What follows from an attempt.

    Attributes:
        trial: where a substep with error control stands now.
        state: to go on from.
        done: part of the step before it.
        fraction: of the next attempt, if the step is not complete.
        change: of the number of accepted substeps, -1, 0 or 1.
        accepted: whether what was attempted is, as a whole.
        failed: whether it is repeated in parts.
        hopeless: whether there is no point in going on.
    """

    trial: Trial | None
    state: State
    done: Float[Array, ""]
    fraction: Float[Array, ""]
    change: Int[Array, ""]
    accepted: Bool[Array, ""]
    failed: Bool[Array, ""]
    hopeless: Bool[Array, ""]


def follow(
    tolerance: Tolerance,
    trial: Trial,
    before: State,
    after: State,
    solved: Bool[Array, ""],
    over: Bool[Array, ""],
    tableau: Tableau,
) -> StepDecision:
    """What follows from an attempt.

    Args:
        tolerance: of the error.
        trial: where the substep stood.
        before: state that the attempt started from.
        after: state that it reached.
        solved: whether it reached any.
        over: whether the run has ended before; then nothing changes.
        tableau: of the scheme.
    """
    first, second = trial.phase == FIRST, trial.phase == SECOND
    excess = tolerance.excess(trial.origin, after, trial.whole, tableau)
    good = solved & second & (excess <= 1.0)
    accepted, failed = good & ~over, (~solved | (second & ~good)) & ~over
    kept, undone = solved & (first | good) & ~over, failed & second
    wish = jnp.where(accepted | failed, trial.wish_after(excess, solved, failed, tableau.order), trial.wish)

    def chosen(reached: Array, origin: Array, unchanged: Array) -> Array:
        return jnp.where(kept, reached, jnp.where(undone, origin, unchanged))

    state = jax.tree.map(chosen, after, trial.origin, before)
    done = jnp.where(accepted, trial.done + trial.length, trial.done)
    anew = accepted | failed
    phase = jnp.where(over, trial.phase, jnp.where(anew, WHOLE, trial.phase + 1))
    following = Trial(
        phase,
        wish,
        trial.length,
        jax.tree.map(lambda x, y: jnp.where(anew, x, y), state, trial.origin),
        trial.done,
        jax.tree.map(lambda x, y: jnp.where(trial.phase == WHOLE, x, y), after, trial.whole),
        undone,
        jnp.where(anew, failed, trial.repeated),
        trial.left,
    ).beginning(done, anew)
    return StepDecision(
        trial=following,
        state=state,
        done=jnp.where(phase == SECOND, done + 0.5 * following.length, done),
        fraction=jnp.where(phase == WHOLE, 1.0, 0.5) * following.length,
        change=jnp.where(kept, 1, 0) - jnp.where(undone, 1, 0),
        accepted=accepted,
        failed=failed,
        hopeless=failed & (wish < SMALLEST),
    )
