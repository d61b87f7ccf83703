"""Where an optimisation starts: from inputs, rates, an earlier solution, or from nothing."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.collocation import stage_unknowns, unknowns_each
from natcoord_jax.control.mesh import member, spans
from natcoord_jax.control.phases import filled, most_unknowns
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.resampling import free_of_swings
from natcoord_jax.control.tangent import steady_rates
from natcoord_jax.control.transcription import (
    Node,
    Slice,
    Unknowns,
    each_step,
    end,
    roll,
    simulated,
    slices,
    stage,
    standing_excess,
)
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Numbers, Vector

GIVEN = Numbers((None, None)) | Numbers((None, None, None))
"""Inputs of all steps, or of all of their stages."""
ROUNDS = 12
"""Gauss-Newton corrections of the constant rates that lead to the goal."""
LEAST_SCALE = 0.1
"""Least scale of a condition of the goal, relative to the largest."""
SAME = 1e-9
"""Inputs whose effects differ by less than this part count as one."""
INSIDE = 0.5
"""Room to the bounds of idle inputs that is looked for, in units of half their range."""
LONGEST = 2.0
"""Largest turn of a body in one step of a guess [rad]."""


class Guess(Part):
    """A first guess.

    What is not given is made. Rates are such that joints and attitudes go to the goal the short way round
    (either way at half a turn): constant ones, or, where the goal asks for rest, such as start and end
    there. Inputs are those that come nearest to make this motion within their limits (inverse dynamics),
    or, for "shooting", zero. Time and parameters are as in the problem.

    The order of rates is that of `problem.rates`, their names: for every body in the order of
    `system.structure.bodies` the rotations, then the translations that its joint leaves free. Where phases
    have systems of their own, each step has the rates of its system, and zeros for what others have more.

    Attributes:
        inputs: of all steps (steps, inputs), or of their stages (steps, stages, inputs) [N, N m]; None: made.
        rates: mean rates of the free motions in all steps (steps, n), rates at all of their stages (steps,
            stages, n), or constant ones (n,) [rad/s, m/s] that are taken up from the initial ones, for the
            lifted method, which needs no motion to start from; None: made.
        free: final time [s] and parameters in the order of `problem.free`; None: those of the problem.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> from natcoord_jax.gallery import manoeuvres
        >>> manoeuvres.cart_pole(10).rates
        ("'cart' along axis 3 of its joint [m/s]", "'pole' about axis 3 of its joint [rad/s]")
        >>> guess = nc.Guess(rates=(0.5, 1.57))
    """

    inputs: Any = eqx.field(default=None, metadata=is_a(GIVEN))
    rates: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Vector(None) | GIVEN))
    free: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Vector(None)))


GUESS = GIVEN | of("nc.Guess(...)", Guess)
"""What an argument may be."""


def unknowns_of(problem: OptimalControl, guess: Any, lifted: bool) -> Unknowns:
    """Unknowns to start from.

    Args:
        problem: the problem.
        guess: None, inputs (steps, inputs), or a `Guess`.
        lifted: whether rates are wanted as well.

    Raises:
        ValueError: for a wrong shape.
    """
    guess = guess if isinstance(guess, Guess) else Guess(inputs=guess)
    reference, scale = problem.references()
    free = jnp.zeros_like(reference)
    if guess.free is not None:
        free = (_shaped(guess.free, reference.shape, "free") - reference) / scale
    structure = problem.system.structure
    _refuse_rates(problem, guess)
    shape = (problem.steps, len(structure.inputs))
    if problem.stages > 1 and np.ndim(guess.inputs) == 3:
        shape = (problem.steps, problem.stages, shape[1])
    inputs = jnp.zeros(shape) if guess.inputs is None else _shaped(guess.inputs, shape, "inputs")
    y = jnp.zeros((problem.steps, unknowns_each(problem)))
    unknowns = _moving(problem, guess, Unknowns(fitted(problem, inputs), free, y), lifted)
    unknown = any(not number.given for number in problem.cost.parameters())
    return with_peaks(problem, unknowns, lifted) if unknown and guess.free is None else unknowns


def fitted(problem: OptimalControl, inputs: Any) -> Float[Array, "c m"]:
    """Coefficients nearest to inputs of all steps, or of their stages."""
    decided = problem.inputs.decided(jnp.asarray(inputs), problem.channels)
    return problem.inputs.fitted(decided, problem.scheme.tableau.c)


def _refuse_rates(problem: OptimalControl, guess: Guess) -> None:
    """Refuse rates of a wrong shape, also where the method does not need them."""
    count = most_unknowns(problem.systems)[1]
    allowed = [(count,), (problem.steps, count)]
    if problem.stages > 1:
        allowed.append((problem.steps, problem.stages, count))
    if guess.rates is not None and np.shape(guess.rates) not in allowed:
        raise ValueError(
            f"guess: rates [rad/s, m/s] have shape {np.shape(guess.rates)}; this problem needs {allowed[0]} "
            f"for constant ones or {allowed[1]} for those of all steps, in the order of `problem.rates`"
        )


def _moving(problem: OptimalControl, guess: Guess, unknowns: Unknowns, lifted: bool) -> Unknowns:
    """Unknowns with rates, and with inputs if none are given, as far as the method wants them."""
    structure = problem.system.structure
    if not structure.inputs:
        # There is nothing to make another motion with than the one that follows from the start.
        found, whole, _ = _simulated(problem, unknowns)
        return jax.tree.map(lambda x, y: jnp.where(whole, x, y), found, unknowns)
    if not lifted or any(system.structure.solver != "reduced" for system in problem.systems):
        return unknowns
    if guess.rates is None:
        unknowns = _towards_goal(problem, unknowns)
        return unknowns if guess.inputs is not None else with_balancing_inputs(problem, unknowns)
    given, count = jnp.asarray(guess.rates, float), most_unknowns(problem.systems)[1]
    if given.shape == (count,):
        steady = jnp.broadcast_to(given, (problem.steps, count))
        return with_rates(problem, unknowns, taken_up(problem, unknowns.free, steady))
    return with_rates(problem, unknowns, given)


@compiled
def _simulated(problem: OptimalControl, unknowns: Unknowns) -> tuple[Unknowns, Array, Array]:
    return simulated(problem, unknowns, False)


@compiled
def with_peaks(problem: OptimalControl, unknowns: Unknowns, lifted: bool) -> Unknowns:
    """The unknowns with free numbers that the cost adds and that were not given as their motion has them."""
    first = len(problem.free) - len(problem.cost.parameters())
    path = roll(problem, simulated(problem, unknowns, lifted)[0])
    # Excesses grow by one over its unit as such a number gets smaller.
    labels, names = problem.path_labels, problem.cost.labels()
    each = path.stages.excess.reshape(problem.steps * problem.stages, len(labels) // problem.stages)
    found = each[:, each.shape[1] - len(names) :]
    free = unknowns.free
    for k, number in enumerate(problem.cost.parameters()):
        free = free.at[first + k].add(0.0 if number.given else jnp.max(found[:, k]))
    return eqx.tree_at(lambda u: u.free, unknowns, free)


def taken_up(
    problem: OptimalControl, free: Float[Array, " p"], rates: Float[Array, "steps n"]
) -> Float[Array, "steps n"]:
    """Mean rates of steps near given ones that the initial rates lead to without a jerk.

    The rates at the end of a step are twice the mean less those at its start: a mean that jumps makes them
    swing about the mean from step to step, for ever.
    """
    first = filled(steady_rates(problem.applied(free)[0], problem.start(free)), rates.shape[1])
    if not problem.later:
        return free_of_swings(jnp, first[None], rates)
    # Those of another phase are rates of other motions.
    pieces = [rates[a:b] for a, b in spans(problem.phases)]
    firsts = [first, *(piece[0] for piece in pieces[1:])]
    return jnp.concatenate([free_of_swings(jnp, x[None], piece) for x, piece in zip(firsts, pieces)])


def with_rates(problem: OptimalControl, unknowns: Unknowns, rates: Float[Array, "steps n"]) -> Unknowns:
    """Unknowns with given mean rates and multipliers zero."""
    return eqx.tree_at(lambda u: u.y, unknowns, stage_unknowns(problem, rates))


def _shaped(value: Any, shape: tuple[int, ...], what: str) -> Array:
    array = jnp.asarray(value, float)
    if array.shape != shape:
        raise ValueError(f"guess: {what} has shape {array.shape}; this problem needs {shape}")
    return array


@compiled
def _leading_to_goal(problem: OptimalControl, unknowns: Unknowns) -> Float[Array, "steps n"]:
    """Rates, constant in phases, that lead the configuration to the goal, as near as they can; no forces."""
    count = most_unknowns(problem.systems)[1]
    belongs = jnp.asarray(member(problem.phases) if problem.later else np.ones((problem.steps, 1)))
    _, dt = problem.applied(unknowns.free)
    size = problem.state.q.size

    def missing(w: Array) -> Array:
        moving = with_rates(problem, unknowns, belongs @ w.reshape(-1, count))
        last = jax.tree.map(lambda x: x[-1], roll(problem, moving).nodes)
        # Only the configuration counts: rates at the end are left to the method.
        still = last.x.at[size : 2 * size].set(0.0)
        return end(problem, eqx.tree_at(lambda n: n.x, last, still)).missing

    def body(_: Any, w: Array) -> Array:
        jacobian, residual = jax.jacfwd(missing)(w), missing(w)
        change = -jnp.linalg.pinv(jacobian, rtol=1e-6) @ residual if residual.size else jnp.zeros_like(w)
        change = jnp.nan_to_num(change)
        longest = jnp.max(jnp.abs(change)) * problem.steps * dt
        return w + change * jnp.minimum(1.0, LONGEST / jnp.where(longest > 0, longest, 1.0))

    w = jax.lax.fori_loop(0, ROUNDS, body, jnp.zeros(belongs.shape[1] * count))
    return belongs @ w.reshape(-1, count)


def scattered_rates(problem: OptimalControl, unknowns: Unknowns) -> int:
    """How many unknowns of a step are rates that can be guessed; multipliers of loops follow from them."""
    structures = [system.structure for system in problem.systems]
    reduced = all(structure.solver == "reduced" for structure in structures)
    return min(structure.unknowns for structure in structures) if reduced else unknowns.y.shape[1]


def _towards_goal(problem: OptimalControl, unknowns: Unknowns) -> Unknowns:
    """Rates that lead to the goal: constant ones, or such as start and end at rest where it asks for that."""
    constant = _leading_to_goal(problem, unknowns)
    phases = problem.phases if problem.later else (problem.steps,)
    part = jnp.concatenate([(jnp.arange(count) + 0.5)[:, None] / count for count in phases])
    rates = constant, 6.0 * part * (1.0 - part) * constant
    ways = [with_rates(problem, unknowns, taken_up(problem, unknowns.free, w)) for w in rates]
    missed = jnp.stack([_missed(problem, way) for way in ways])
    better = jnp.nan_to_num(missed[1], nan=jnp.inf) < missed[0]
    return jax.tree.map(lambda x, y: jnp.where(better, y, x), *ways)


@compiled
def _missed(problem: OptimalControl, unknowns: Unknowns) -> Float[Array, ""]:
    """Square of what is missing to the goal."""
    return jnp.sum(roll(problem, unknowns).end.missing ** 2)


@compiled
def with_balancing_inputs(problem: OptimalControl, unknowns: Unknowns) -> Unknowns:
    """The unknowns with inputs that come nearest to make their motion, within limits: inverse dynamics.

    Of each step the inputs minimise what is left of its equations in the metric of its inverse Jacobian, so
    that motions without an input count by what they would have to give (the principle of Gauss); then they
    are cut in one ratio to what their bounds leave. Inputs that have to be positive do not begin at zero: a
    method that keeps away from bounds would not get away from there.
    """
    nodes, at = jax.tree.map(lambda x: x[:-1], roll(problem, unknowns).nodes), slices(problem)
    # Inputs of each step for themselves, whatever they are made of.
    at = at._replace(read=jnp.zeros_like(at.read), direct=jnp.ones_like(at.direct))

    def one(at: Slice, node: Node, y: Array) -> Array:
        def left(u: Array, y: Array) -> tuple[Array, Array]:
            found = stage(problem, at, node, u, y)
            return found.residual, found.excess

        idle = _inside(lambda u: left(u, y)[1], jnp.zeros(problem.channels))
        rest, excess = left(idle, y)
        (by_u, steep), by_y = jax.jacfwd(left)(idle, y), jax.jacfwd(left, argnums=1)(idle, y)[0]
        inverse = jnp.linalg.pinv(by_y)
        metric = 0.5 * (inverse + inverse.T)
        u = -jnp.linalg.pinv(by_u.T @ metric @ by_u, rtol=SAME) @ (by_u.T @ metric @ rest)
        grown, spare = steep @ u, jnp.maximum(-excess, 0.0)
        reach = jnp.where(grown > 0, spare / jnp.where(grown > 0, grown, 1.0), 1.0)
        return jnp.nan_to_num(idle + u * jnp.minimum(1.0, jnp.min(reach, initial=1.0)))

    inputs = each_step(problem, one, at, nodes, unknowns.y)
    coefficients = problem.inputs.fitted(inputs, problem.scheme.tableau.c)
    return eqx.tree_at(lambda u: u.coefficients, unknowns, coefficients)


def _inside(excess: Callable[[Array], Array], u: Float[Array, " m"]) -> Float[Array, " m"]:
    """Inputs near given ones that leave room to their bounds, as far as these leave room at once."""

    def body(_: Any, u: Array) -> Array:
        steep = jax.jacfwd(excess)(u)
        felt = jnp.any(steep != 0, axis=1)
        over = jnp.where(felt, jnp.maximum(excess(u) + INSIDE, 0.0), 0.0)
        active = jnp.where((over > 0)[:, None], steep, 0.0)
        return u - jnp.linalg.pinv(active, rtol=SAME) @ over

    return jax.lax.fori_loop(0, ROUNDS, body, u)


def scattered(problem: OptimalControl, unknowns: Unknowns, key: Array, spread: Any, rates: Any) -> Unknowns:
    """A guess with random smooth changes of inputs and of rates, for starts from many places.

    Args:
        problem: the problem.
        unknowns: in the middle.
        key: random key.
        spread: standard deviation of the inputs [N, N m], one or for each.
        rates: standard deviation of the rates [rad/s, m/s], one or for each.
    """
    first, second, third = jax.random.split(key, 3)
    steps, modes = problem.steps, jnp.arange(1, 4)
    waves = jnp.sin(jnp.pi * (jnp.arange(steps)[:, None] + 0.5) / steps * modes) / modes
    count = scattered_rates(problem, unknowns)
    inputs = spread * (waves @ jax.random.normal(first, (3, problem.channels)))
    changes = rates * (jax.random.normal(second, (1, count)) + waves @ jax.random.normal(third, (3, count)))
    changes = free_of_swings(jnp, jnp.zeros((1, count)), changes)
    coefficients = unknowns.coefficients + problem.inputs.fitted(inputs, problem.scheme.tableau.c)
    if problem.stages > 1:
        changes = stage_unknowns(problem, changes)
    y = unknowns.y.at[:, : changes.shape[1]].add(changes)
    return Unknowns(coefficients, unknowns.free, y)


@compiled
def goal_scale(problem: OptimalControl, unknowns: Unknowns) -> Float[Array, " c"]:
    """What the goal's residual amounts to along a motion, for each of its conditions.

    Those that hold all along, as that another body rests, get a part of the largest.
    """
    nodes = roll(problem, unknowns).nodes
    missing = jax.vmap(lambda node: end(problem, node).missing)(nodes)
    sizes = jnp.max(jnp.abs(missing), axis=0)
    sizes = jnp.where(jnp.isfinite(sizes), sizes, 0.0)
    largest = jnp.max(sizes, initial=0.0)
    return jnp.maximum(sizes, LEAST_SCALE * jnp.where(largest > 0, largest, 1.0))


def input_ranges(problem: OptimalControl, unknowns: Unknowns) -> Float[Array, " m"]:
    """Half the ranges of the inputs; for those without limits, the largest input of the guess, or 1."""
    state, idle = problem.start(unknowns.free), jnp.zeros(problem.channels)
    channels = len(problem.system.structure.inputs)

    def excess(decided: Array) -> Array:
        u = problem.inputs.driven(decided, channels)
        return standing_excess(problem, state, u, unknowns.free)

    steep = jax.jacfwd(excess)(idle)
    steepest = jnp.max(jnp.abs(steep), axis=0, initial=0.0)
    largest = jnp.max(jnp.abs(unknowns.coefficients))
    usual = jnp.where(largest > 0, largest, 1.0)
    return jnp.where(steepest > 0, 1.0 / jnp.where(steepest > 0, steepest, 1.0), usual)


def stretched(problem: OptimalControl, unknowns: Unknowns, factor: float) -> Unknowns:
    """The same with a longer final time, within its limits, where that is free."""
    if not problem.free_time:
        return unknowns
    reference, scale = problem.references()
    count = problem.times
    longer = factor * problem.values(unknowns.free)[:count]
    longer = jnp.clip(longer, *(x[:count] for x in problem.limits()))
    changed = (longer - reference[:count]) / scale[:count]
    return eqx.tree_at(lambda u: u.free, unknowns, unknowns.free.at[:count].set(changed))
