"""The second-order method: sequential quadratic programming with an interior point for the bounds.

Every iteration solves a quadratic model with the exact gradients and the curvature of the Lagrangian by a
Riccati recursion. `lifted`: residuals of the steps are constraints like the others and vanish at the end
only, so that a guess need not be a motion. `shooting`: every iterate is simulated.

A solver is three pure functions: `init`, `step` and `done`.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.iterate import Derivatives, Errors, Filter, Iterate, Options, Slacks, largest
from natcoord_jax.control.line_search import (
    Found,
    at_barrier,
    first_filter,
    missed,
    moved,
    remembered,
    room,
    search,
)
from natcoord_jax.control.linearisation import cost_unit, linearised
from natcoord_jax.control.phases import rates_of
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.proposal import LEAST_BARRIER, Proposal, propose
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.transcription import Path, Unknowns, roll, simulated
from natcoord_jax.core.compiled import compiled

ROOM = 0.01
"""Least room left to a bound at the start."""
AT_REST = 1e-7
"""Relative size of a step that moves nothing any more."""
STILL = 1e-4
"""The same in a feasibility restoration."""
MISSED = 300.0
"""What it costs to miss a soft goal by its scale, in units of the cost."""
NEAR = 0.01
"""The same, where it is near enough."""
GROWN = 1e12
"""Multipliers, in units of the cost, that lead nowhere."""
NEARLY = 1e-6
"""Residual of the steps, relative, of a motion that nearly obeys its equations."""
SWAY = 0.1
"""Part of what is added to the curvature that changes of the motion get, by their size, beside inputs."""


@compiled
def _begun(
    problem: OptimalControl, options: Options, unknowns: Unknowns, known: Multipliers | None
) -> tuple[tuple, tuple]:
    unknowns, whole, newton = simulated(problem, unknowns, options.lifted)
    path = roll(problem, unknowns)
    slacks = Slacks(jnp.maximum(-path.stages.excess, ROOM), jnp.maximum(-path.end.excess, ROOM))
    unit = cost_unit(problem, unknowns, path)
    barrier = options.barrier * unit
    goal = jnp.zeros_like(path.end.missing)
    motion = jnp.zeros_like(unknowns.y) if options.lifted else None
    if known is not None:
        room = Slacks(-path.stages.excess, -path.end.excess)
        pressing = largest(room.path * known.path, room.end * known.end)
        barrier = jnp.clip(pressing, LEAST_BARRIER * unit, barrier)
        goal, motion = known.goal, known.motion if options.lifted else None
        slacks = Slacks(_spare(room.path, known.path, barrier), _spare(room.end, known.end, barrier))
    along, last = barrier / slacks.path, barrier / slacks.end
    if known is not None:
        along, last = jnp.where(known.path > 0, known.path, along), jnp.where(known.end > 0, known.end, last)
    multipliers = Multipliers(goal, along, last, motion)
    return (unknowns, multipliers, slacks, path, unit), (barrier, whole, newton)


def _spare(room: Array, pressing: Array, barrier: Array) -> Array:
    """Room to bounds; where there is none, what multipliers and the barrier parameter say."""
    return jnp.where(room > 0, room, barrier / jnp.where(room > 0, 1.0, jnp.maximum(pressing, barrier)))


def init(
    problem: OptimalControl,
    options: Options,
    unknowns: Unknowns,
    scale: Array | None = None,
    known: Multipliers | None = None,
) -> Iterate:
    """First iterate from a guess.

    Args:
        problem: the problem.
        options: settings.
        unknowns: coefficients and what is free; `y` is replaced by a simulation unless the method is lifted.
        scale: of the goal, which is then soft: the method ends near it, and time and parameters stay; None:
            the goal is to be reached.
        known: multipliers to begin with; None: none, and bounds that are kept away from.
    """
    begin = Options(options.lifted, barrier=options.barrier)
    begun, rest = _begun(problem, begin, unknowns, known)
    unknowns, multipliers, slacks, path, unit = begun
    derivatives = linearised(problem, unknowns, multipliers, slacks, path, unit)
    soft = jnp.zeros_like(path.end.missing) if scale is None else scale**2 / (2.0 * MISSED * unit)
    iterate = _first(problem, begin, begun, derivatives, soft, *rest)
    return iterate if known is None else _accepted(options, iterate)


@compiled
def _accepted(options: Options, iterate: Iterate) -> Iterate:
    """An iterate that another method has found, at its end if it fulfils the conditions as it is."""
    optimal = _fulfilled(options, iterate.errors)
    return eqx.tree_at(lambda i: i.code, iterate, jnp.where(optimal, int(Outcome.OPTIMAL), iterate.code))


@compiled
def _first(
    problem: OptimalControl,
    options: Options,
    begun: tuple,
    derivatives: Derivatives,
    softness: Array,
    barrier: Array,
    whole: Array,
    newton: Array,
) -> Iterate:
    """The first iterate; compiled, so that its constants are numbers also where derivatives are traced."""
    unknowns, multipliers, slacks, path, unit = begun
    nothing, infinite = jnp.zeros(()), jnp.full((), jnp.inf, float)
    goal = multipliers.goal
    finite = jnp.isfinite(path.cost) & jnp.isfinite(derivatives.errors.stationarity)
    code = jnp.where(finite, int(Outcome.RUNNING), _undefined(path, derivatives))
    code = jnp.where(whole, code, int(Outcome.SIMULATION_FAILED))
    return Iterate(
        unknowns,
        multipliers,
        slacks,
        path,
        derivatives,
        barrier,
        unit,
        nothing,
        _sway(problem, unknowns),
        goal,
        softness,
        first_filter(problem, unknowns, softness, path, slacks, derivatives.jacobians.inverses),
        nothing,
        infinite,
        goal,
        jnp.array(False),
        jnp.array(-1),
        newton,
        jnp.array(0),
        code,
    )


def _sway(problem: OptimalControl, unknowns: Unknowns) -> Array:
    """Curvature in the steps' unknowns per curvature in coefficients, of changes as large as both are.

    Curvature that is added in the inputs alone has to be as large as that of the motion far along it, which
    a small one of the motion itself holds as well, and leaves the inputs free.
    """
    rates = rates_of(problem.systems, problem.phases, problem.stages)
    pushed, moving = jnp.sum(unknowns.coefficients**2), jnp.sum(jnp.where(rates, unknowns.y, 0.0) ** 2)
    ratio = pushed * np.sum(rates) / (jnp.where(moving > 0, moving, 1.0) * max(1, unknowns.coefficients.size))
    return jnp.where(moving > 0, SWAY * ratio, 0.0)


def _at_rest(iterate: Iterate) -> Iterate:
    """The iterate as it serves to estimate multipliers: no constraint bends, and none is violated."""

    def parts(i: Iterate) -> tuple:
        bending, path = i.derivatives.bending, i.path
        return bending, path.end.missing, path.stages.residual, i.multipliers.goal

    estimating = iterate.iteration < 0
    still = jax.tree.map(lambda x: jnp.where(estimating, jnp.zeros_like(x), x), parts(iterate))
    return eqx.tree_at(parts, iterate, still)


@compiled
def tried(
    problem: OptimalControl, options: Options, iterate: Iterate, proposal: Proposal
) -> tuple[Found, Multipliers, Filter]:
    """The step as far as the filter takes it, the multipliers there, and the filter after it."""
    iterate = at_barrier(iterate, proposal.barrier)
    found = search(
        problem, options, iterate, proposal.direction, proposal.slope, proposal.model, proposal.factors
    )
    estimating = iterate.iteration < 0
    fine = (found.fine | estimating) & proposal.convex
    reached = (found.unknowns, found.slacks, found.path)
    stayed = (iterate.unknowns, iterate.slacks, iterate.path)
    reached = jax.tree.map(lambda x, x0: jnp.where(fine & ~estimating, x, x0), reached, stayed)
    unknowns, slacks, path = reached
    found = dataclasses.replace(found, unknowns=unknowns, slacks=slacks, path=path, fine=fine)
    m, dm = iterate.multipliers, proposal.direction.multipliers
    dual = jnp.where(estimating, 0.0, room([(m.path, dm.path), (m.end, dm.end)]))
    # Multipliers of equations go as far as the step does, and less where what has been added to the curvature
    # has made them large: those of a model that a short step shows to be a poor one would bend the next one
    # more, and grow without end.
    length = jnp.where(estimating, 1.0, found.length)
    length = jnp.where(length < 1.0, length / (1.0 + proposal.shift), length)
    there = Multipliers(
        # Those of a soft goal are what it costs to miss it; without any, its curvature is that of its square.
        jnp.where(iterate.softness > 0, m.goal, moved(m.goal, dm.goal, length)),
        moved(m.path, dm.path, dual),
        moved(m.end, dm.end, dual),
        moved(m.motion, dm.motion, length),
    )
    there, after = jax.tree.map(lambda x, x0: jnp.where(fine, x, x0), there, m), remembered(iterate, found)
    return found, there, jax.tree.map(lambda x, x0: jnp.where(estimating, x0, x), after, iterate.filter)


@compiled
def concluded(
    options: Options,
    iterate: Iterate,
    proposal: Proposal,
    found: Found,
    multipliers: Multipliers,
    known: Filter,
    derivatives: Derivatives,
) -> Iterate:
    """The next iterate: the step, or the old one with a sign of failure."""
    d = proposal.direction.unknowns
    size = largest(found.unknowns.coefficients, found.unknowns.free)
    change = found.length * largest(d.coefficients, d.free) / jnp.where(size > 0, size, 1.0)
    change = jnp.where(iterate.iteration < 0, jnp.inf, change)
    accepted = Iterate(
        found.unknowns,
        multipliers,
        found.slacks,
        found.path,
        derivatives,
        proposal.barrier,
        iterate.unit,
        proposal.shift,
        iterate.sway,
        proposal.penalty,
        iterate.softness,
        known,
        found.length,
        change,
        proposal.unreachable,
        proposal.saddle,
        iterate.iteration,
        iterate.newton,
        jnp.zeros_like(iterate.failures),
        iterate.code,
    )
    kept = eqx.tree_at(
        lambda i: (i.failures, i.shift, i.step, i.unreachable, i.saddle, i.multipliers, i.derivatives),
        iterate,
        (
            iterate.failures + 1,
            proposal.shift,
            jnp.zeros_like(found.length),
            proposal.unreachable,
            proposal.saddle,
            multipliers,
            derivatives,
        ),
    )
    after = jax.tree.map(lambda x, x0: jnp.where(found.fine, x, x0), accepted, kept)
    counts = (iterate.iteration + 1, iterate.newton + found.newton)
    after = eqx.tree_at(lambda i: (i.iteration, i.newton), after, counts)
    return eqx.tree_at(lambda i: i.code, after, _judged(options, after))


def step(problem: OptimalControl, options: Options, iterate: Iterate) -> Iterate:
    """One iteration; four programs, or parts of one under `jax.jit`.

    The first one only estimates the multipliers of the goal and of the motion: without them the model bends
    as little at a saddle as at a minimum, and its step may lead anywhere.
    """
    # The large programs know nothing of tolerances, which may change without compiling them anew.
    form = Options(options.lifted)
    proposal = propose(problem, form, _at_rest(iterate))
    found, multipliers, known = tried(problem, form, iterate, proposal)
    derivatives = linearised(problem, found.unknowns, multipliers, found.slacks, found.path, iterate.unit)
    return concluded(options, iterate, proposal, found, multipliers, known, derivatives)


def _undefined(path: Path, derivatives: Derivatives) -> Int[Array, ""]:
    """Outcome where a number is none: of the motion, or only of its derivative."""
    solved = jnp.all(jnp.isfinite(derivatives.jacobians.inverses))
    singular = ~solved & jnp.all(jnp.isfinite(path.stages.residual))
    return jnp.where(singular, int(Outcome.SINGULAR), int(Outcome.NONFINITE))


def _fulfilled(options: Options, e: Errors) -> Bool[Array, ""]:
    """Whether the conditions of optimality are, of first order."""
    kept = (e.goal <= options.goal_tol) & (e.bounds <= options.goal_tol) & (e.motion <= options.goal_tol)
    return kept & (e.stationarity <= options.tol) & (e.complementarity <= options.tol)


def _judged(options: Options, it: Iterate) -> Int[Array, ""]:
    """Outcome of an iteration."""
    e = it.errors
    optimal = _fulfilled(options, e)
    # What is stationary where curvature is negative is a saddle, and left. That of the first step knows no
    # multipliers, and tells none from a minimum.
    optimal = optimal & ~it.saddle & (it.iteration > 1)
    finite = jnp.isfinite(e.stationarity) & jnp.isfinite(e.goal)
    grown = largest(it.multipliers.goal, *jax.tree.leaves(it.multipliers.motion)) > GROWN * it.unit
    soft = jnp.any(it.softness > 0)
    resting = (it.moved < jnp.where(soft, STILL, AT_REST)) | (it.failures >= 3)
    # What is out of reach is known only where the motion obeys its equations.
    known = (e.motion < NEARLY) & (largest(it.unreachable) > 0.5 * e.goal)
    unreachable = resting & (soft | ((e.goal > options.goal_tol) & known))
    missing = it.path.end.missing
    near = soft & (0.5 * missed(it.softness, missing) @ missing < NEAR * it.unit)
    code = jnp.where(
        it.iteration >= options.max_iterations, int(Outcome.MAX_ITERATIONS), int(Outcome.RUNNING)
    )
    code = jnp.where(it.failures >= 5, int(Outcome.STALLED), code)
    code = jnp.where(grown, int(Outcome.DIVERGED), code)
    code = jnp.where(unreachable, int(Outcome.UNREACHABLE), code)
    code = jnp.where(finite, code, _undefined(it.path, it.derivatives))
    return jnp.where(optimal | near, int(Outcome.OPTIMAL), code)


def solved(
    problem: OptimalControl, options: Options, unknowns: Unknowns, scale: Array | None = None
) -> Iterate:
    """The last iterate, all in one program; arguments as of `init`."""
    first = init(problem, options, unknowns, scale)
    return jax.lax.while_loop(lambda it: it.running, lambda it: step(problem, options, it), first)


def done(iterate: Iterate) -> Bool[Array, ""]:
    """Whether the method has ended."""
    return ~iterate.running
