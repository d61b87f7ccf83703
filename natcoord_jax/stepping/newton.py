"""Newton's iteration to the round-off floor, one evaluation of the equations at a time.

One factorisation serves, over many steps, as long as the corrections shrink quickly; rates along body axes
make the Jacobian change little. Otherwise it is formed anew: from formulas where these are local, else by
differences, one evaluation a column. Differences are exact to a few parts in 10^6, which is all that an
iteration needs that is carried to the floor anyway; and a second, larger program for the exact Jacobian would
take longer to compile than everything else. (Derivatives of trajectories use the exact one.)

Lanes that a vmap works through together are judged together: they form Jacobians when one needs to, and end a
step when all can. (On a CPU they are not, see `one_kernel.lane_by_lane`.)
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from natcoord_jax.core.results import Result
from natcoord_jax.linsolve.learning import SPEED, learns, learnt
from natcoord_jax.maths.vectors import safe_divide
from natcoord_jax.stepping.factors import Factors, factors_of, no_factors

TOLERANCE = 2e-16
"""Predicted error after the last correction, relative to the terms of the equations (energy norm).

What is left after the last correction has the same sign in every step. The next step makes up for it, see
`remainder`, but for its change from one to the other: at 2e-15 that shows in 10^6 steps of a free body, as
5e-19 of its energy a step; here it does not.
"""

ROUND_OFF = 1e-15
"""Round-off of one evaluation of the equations, relative to their terms."""

STALL = 1e4
"""Corrections that stop shrinking below STALL * round-off have reached the floor.

Where new factors change nothing, ten times more each time: rounding is worse than assumed, as it is about the
axis of a thin rod, whose balance is rounded like that of the other axes.
"""

STALLS = 3
"""Times that the floor is raised."""

RAISED = [STALL * 10.0**k for k in range(STALLS + 1)]
"""The floor by factorisations that have brought the solution no nearer."""

ABOVE_NOISE = 4.0
"""Corrections up to this multiple of the noise end a step that is expected to be solved."""

STALL_OLD = 20.0
"""The same with factors of an earlier step, where a stall may be the factors' fault."""

STALL_ALIKE = 2.0
"""The same with factors for which stages are alike: about an axis with next to no inertia these may halve the
error only, which would be taken for noise in the steps that follow, too."""

RESTING = STALL_OLD * ROUND_OFF
"""Corrections up to this part of the terms that cancel are what stiff parts at rest are rounded by."""

CHORD_ITERATIONS = 14
"""Corrections with one factorisation."""

NEWTON_ROUNDS = 25
"""Factorisations in one step."""

FEW_ROUNDS = 4
"""The same where a shorter substep is an answer: at the right length, one or two do."""

LEARNING = 1e-12
"""Size of a correction relative to the terms of the equations from which on the next tells how good the
factors are: below, rounding has a part in it."""

NEAR = 1e-3
"""The same up to which it does: far off, equations are not linear, and what failed attempts teach is noise,
by which the next ones would be accepted or not."""


@jax.custom_batching.custom_vmap
def any_lane(x: Shaped[Array, ""]) -> Shaped[Array, ""]:
    """Whether it holds in any lane of a vmap, or the largest number: the same for all lanes.

    A loop whose condition differs between lanes would copy all that it carries, in every trip.
    """
    return x


@any_lane.def_vmap
def _any_lane_rule(axis_size: int, in_batched: list[bool], x: Array) -> tuple[Array, bool]:
    return any_lane(jnp.max(x, axis=0)), False


class Iterate(eqx.Module):
    """Where the iteration of one step stands.

    Attributes:
        start: unknowns that it began with.
        y: unknowns to be evaluated next.
        change: last correction with these factors; 0 before the first.
        worst: unknown with the largest last correction.
        correction: size of the last correction (energy norm); 0 before the first with these factors.
        error: that size relative to the terms of the equations, those that cancel included.
        count: corrections with these factors.
        total: all corrections.
        before: size of the last correction with the factors before these.
        vain: factorisations that have brought it no nearer.
        rounds: factorisations in this step.
        most: factorisations that are allowed.
        last: whether the next evaluation is expected to be at the solution.
        converged: whether the step is solved.
        wanting: whether it cannot go on without new factors.
        finite: whether all numbers are.
    """

    start: Float[Array, " unknowns"]
    y: Float[Array, " unknowns"]
    change: Float[Array, " unknowns"]
    worst: Int[Array, ""]
    correction: Float[Array, ""]
    error: Float[Array, ""]
    count: Int[Array, ""]
    total: Int[Array, ""]
    before: Float[Array, ""]
    vain: Int[Array, ""]
    rounds: Int[Array, ""]
    most: Int[Array, ""]
    last: Bool[Array, ""]
    converged: Bool[Array, ""]
    wanting: Bool[Array, ""]
    finite: Bool[Array, ""]

    @property
    def unsolved(self) -> Bool[Array, ""]:
        """Whether to go on."""
        exhausted = self.wanting & (self.rounds >= self.most)
        return ~self.converged & self.finite & ~exhausted

    @property
    def code(self) -> Int[Array, ""]:
        """Result code: successful, max_iterations or nonfinite, never an exception."""
        failed = jnp.where(self.finite, int(Result.MAX_ITERATIONS), int(Result.NONFINITE))
        return jnp.where(self.converged, int(Result.SUCCESSFUL), failed)


def begin(y: Float[Array, " unknowns"], few: bool = False) -> Iterate:
    """The iteration before its first evaluation, with few factorisations if a shorter step is an answer."""
    most = jnp.array(FEW_ROUNDS if few else NEWTON_ROUNDS)
    zero, no, nought = jnp.zeros((), y.dtype), jnp.array(False), jnp.array(0)
    still, yes = jnp.zeros_like(y), jnp.array(True)
    return Iterate(
        y, y, still, nought, zero, zero, nought, nought, zero, nought, nought, most, no, no, no, yes
    )


def refreshed(it: Iterate) -> Iterate:
    """The iteration with new factors."""
    zero, nought, no = jnp.zeros_like(it.correction), jnp.zeros_like(it.count), jnp.zeros_like(it.last)
    correction = jnp.where(it.converged, it.correction, zero)
    vain = it.vain + (2.0 * it.correction > it.before) * (it.before > 0)
    return eqx.tree_at(
        lambda x: (x.change, x.correction, x.count, x.before, x.vain, x.rounds, x.last, x.wanting),
        it,
        (jnp.zeros_like(it.change), correction, nought, it.correction, vain, it.rounds + 1, no, no),
    )


def judge(
    factors: Factors,
    tolerance: Any,
    it: Iterate,
    residual: Array,
    size: Array,
    *,
    balances: bool,
    patience: int,
    jumped: Bool[Array, ""] | bool = False,
    whole: Bool[Array, ""] | bool = True,
    alike: Bool[Array, ""] | bool = False,
    contacts: Float[Array, " unknowns"] | None = None,
) -> tuple[Iterate, Factors]:
    """What follows from one evaluation of the equations at `it.y`.

    Args:
        factors: at hand.
        tolerance: see `TOLERANCE`.
        it: where the iteration stands.
        residual: of the equations.
        size: of their terms, but for those that cancel in stiff parts, see `Factors.grain`.
        balances: whether the residual itself counts, too. An error of multipliers alone moves nothing, but
            shows in the balances, and in the work of drives; what is left of an impulse of contacts moves
            bodies in the next step.
        patience: corrections that are cheaper than a new Jacobian.
        jumped: whether the equations are not those of the last evaluation: corrections do not compare.
        whole: whether they are all that the end of a step asks for; if not, the next evaluation is the last.
        alike: whether the last factors that were made take stages for alike. Corrections by them may shrink
            slowly, which is no sign of rounding.
        contacts: weights of the rows of contacts, which count as well: what is left of the impulse of an open
            one moves bodies. (Of its correction, what contacts that depend on each other share is rounding.)

    Returns:
        Converged; or moved by one correction; or in want of new factors, when corrections shrink too slowly
        (then not moved). And the factors, which have learnt from it if they are of that kind.
    """
    done = it.converged | it.wanting | ~it.finite
    grain = factors.grain
    change = factors.solver.solve(residual)
    near = (it.correction > LEARNING * size) & (it.correction < NEAR * size)
    telling = ~done & (it.count > 0) & ~jnp.asarray(jumped) & near
    solver, change, _ = learnt(factors.solver, it.change, change, factors.inertias, telling)
    factors = eqx.tree_at(lambda f: f.solver, factors, solver)
    energies = factors.inertias * change**2
    if balances:
        real = factors.inertias > 0
        missing = jnp.where(real, residual**2 / jnp.where(real, factors.inertias, 1.0), 0.0)
        energies = jnp.maximum(energies, missing)
    if contacts is not None:
        energies = energies + contacts * residual**2
    correction = jnp.sqrt(jnp.sum(energies))
    first = (it.count == 0) | jumped
    ratio = correction / jnp.where(it.correction > 0, it.correction, 1.0)
    predicted = correction * factors.left_by(ratio, jnp.asarray(first))
    factors = factors.having_left(ratio, telling)
    raised = jnp.asarray(RAISED)[jnp.clip(it.vain, 0, STALLS)]
    trust = jnp.where(alike, STALL_ALIKE, jnp.where(factors.fresh, raised, STALL_OLD))
    # What stiff parts at rest are rounded by is known, and needs no room for more.
    resting = jnp.minimum(trust / STALL_OLD, raised / STALL) * RESTING * grain
    floor = trust * max(tolerance, ROUND_OFF) * size + resting
    noise = factors.noise_of(size)
    finite = jnp.isfinite(correction) & jnp.isfinite(size)
    stalled = ~first & (ratio > 0.5) & (correction <= floor)
    enough = jnp.maximum(STALL_OLD * tolerance * size, ABOVE_NOISE * noise)
    solved = (correction <= tolerance * size) | stalled | (it.last & ~first & (correction <= enough))
    # In constant powers: others are as slow as a solution.
    shrinking = ratio**patience
    if learns(factors.solver):
        shrinking = jnp.where(it.correction < NEAR * size, shrinking**SPEED, shrinking)
    # Within the noise corrections shrink little, and new factors would not change it.
    noisy = factors.fresh & (correction <= floor)
    slow = ~first & ((ratio > 0.5) | (~noisy & (correction * shrinking > tolerance * size)))
    slow = slow | (it.count >= max(CHORD_ITERATIONS, 2 * patience)) | ~factors.usable
    # Old factors may have led astray: new ones begin where the first did, if that is anywhere.
    lost = ~finite & ~factors.fresh & jnp.all(jnp.isfinite(it.start))
    ready, slow = solved & finite & factors.usable, (slow & finite) | lost
    solved, slow = ready & whole, slow & ~ready
    y = jnp.where(solved | slow | ~finite, it.y, it.y - change)
    following = Iterate(
        it.start,
        jnp.where(lost, it.start, y),
        change,
        jnp.argmax(energies) if energies.shape[0] else it.worst,
        correction,
        safe_divide(correction, size + grain),
        it.count + 1,
        it.total + ~solved,
        it.before,
        it.vain,
        it.rounds,
        it.most,
        ready | (predicted <= jnp.maximum(tolerance * size, noise)),
        solved,
        slow,
        finite | lost,
    )
    # Lanes that are done, or that wait for factors, stay as they are.
    return jax.tree.map(lambda old, new: jnp.where(done, old, new), it, following), factors


def newton(equations: Any, tolerance: float) -> tuple[Float[Array, " unknowns"], Int[Array, ""]]:
    """Solve equations from their own guess, with their Jacobian formed anew whenever it is needed.

    Args:
        equations: see `natcoord_jax.mechanics.step_equations`.
        tolerance: see `TOLERANCE`.

    Returns:
        The unknowns and the result code.
    """

    def renew(it: Iterate, factors: Factors) -> tuple[Iterate, Factors]:
        return refreshed(it), factors_of(equations.factorised(equations.tangent(it.y)), factors.noise)

    def trip(carry: tuple[Iterate, Factors]) -> tuple[Iterate, Factors]:
        it, factors = jax.lax.cond(any_lane(carry[0].wanting), renew, lambda *same: same, *carry)
        return judge(
            factors, tolerance, it, *equations.residual(it.y), balances=True, patience=equations.renewal
        )

    with jax.named_scope("newton"):
        start = begin(equations.guess())
        start = eqx.tree_at(lambda it: it.wanting, start, jnp.array(True))
        it, _ = jax.lax.while_loop(lambda c: any_lane(c[0].unsolved), trip, (start, no_factors(equations)))
    return it.y, it.code
