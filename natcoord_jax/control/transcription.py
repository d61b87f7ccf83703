"""The discrete motion as equations between unknowns, in the manner of discrete mechanics and optimal control.

Unknowns are the coefficients of the inputs, the free parameters, and for every step the unknowns of its own
equations: mean rates of the free motions and multipliers. States follow from them explicitly, by increments,
so that joints and directors hold whatever the unknowns are; the residuals of the steps (57) are the equality
constraints. Where the residuals vanish, the motion is that of `nc.simulate`.
"""

from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.collocation import collocated
from natcoord_jax.control.inputs import Shaping
from natcoord_jax.control.memory import Ending, Instant, Step
from natcoord_jax.control.mesh import Mesh, mesh_of, spans
from natcoord_jax.control.phases import (
    Systems,
    at_hand,
    entered,
    filled,
    kinds,
    like,
    most_counted,
    places,
)
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.reading.transfer import transfer
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.step import advance
from natcoord_jax.system import System


class Unknowns(eqx.Module):
    """What is solved for.

    Attributes:
        coefficients: of the inputs (coefficients, inputs) [N, N m].
        free: changes of final time and parameters, in units of their scale.
        y: unknowns of the equations of every step.
    """

    coefficients: Float[Array, "*batch c m"]
    free: Float[Array, "*batch p"]
    y: Float[Array, "*batch steps n"]


class Node(eqx.Module):
    """What one step hands to the next: the state, what is free, the register of the inputs, a memory.

    Attributes:
        x: state as one vector: q, v, joint coordinates, rotor rates.
        free: as in `Unknowns`.
        last: inputs of the step before, zero at the start; none where nobody asks for them.
        memory: what goal, cost and bounds ask to be carried along, see `memory`.
        register: of the spline (d, inputs).
    """

    x: Float[Array, "*k x"]
    free: Float[Array, "*k p"]
    last: Float[Array, "*k u"]
    memory: Float[Array, "*k memory"]
    register: Float[Array, "*k d m"]


class Stage(eqx.Module):
    """What one step gives.

    Attributes:
        residual: of its equations.
        cost: of the step.
        excess: over the bounds at its end.
        after: node at its end.
    """

    residual: Float[Array, "*k n"]
    cost: Float[Array, "*k"]
    excess: Float[Array, "*k h"]
    after: Node


class End(eqx.Module):
    """What the final state gives.

    Attributes:
        cost: terminal cost.
        missing: residual of the goal.
        excess: over the bounds of what is free, and over the limits of the goal.
    """

    cost: Float[Array, "*batch"]
    missing: Float[Array, " c"]
    excess: Float[Array, " e"]


class Path(eqx.Module):
    """A motion: nodes before every step and at the end, and what the steps give."""

    nodes: Node
    stages: Stage
    end: End

    @property
    def cost(self) -> Float[Array, "*batch"]:
        """Whole cost."""
        return jnp.sum(self.stages.cost, axis=-1) + self.end.cost


class InPhase(NamedTuple):
    """Which system a step has.

    Attributes:
        phase: number of its phase.
        kind: number of the structure of its system.
        enters: number of the phase that it enters by a transfer; 0 if none.
    """

    phase: Int[Array, "*k"]
    kind: Int[Array, "*k"]
    enters: Int[Array, "*k"]


class Slice(NamedTuple):
    """What is known of one step: its number, the spline's machine, its place in the mesh, and its system.

    The place of equal steps of one phase is not needed, nor is what system it has where there is one only.
    """

    number: Int[Array, "*k"]
    shift: Float[Array, "*k d d"]
    load: Float[Array, "*k d"]
    read: Float[Array, "*k s d"]
    direct: Float[Array, "*k s"]
    place: Mesh | None = None
    system: InPhase | None = None


def packed(state: State, counted: int | None = None) -> Float[Array, " x"]:
    """State as one vector, with room for so many coordinates of joints."""
    coordinates = state.coordinates if counted is None else filled(state.coordinates, counted)
    return jnp.concatenate([state.q.reshape(-1), state.v.reshape(-1), coordinates, state.rates])


def unpacked(like: State, x: Float[Array, " x"], t: Float[Array, ""]) -> State:
    """State from a vector, with time and work account given."""
    size = like.q.size
    a, b = 2 * size, 2 * size + like.coordinates.size
    fields = {"q": x[:size].reshape(-1, 3), "v": x[size:a].reshape(-1, 3)}
    return replace_fields(like, t=t, coordinates=x[a:b], rates=x[x.size - like.rates.size :], **fields)


def moving_places(problem: OptimalControl) -> np.ndarray:
    """Places of velocities and rates of rotors in a node as a vector."""
    size, stored, counted = problem.state.q.size, problem.state.rates.size, most_counted(problem.systems)
    return np.r_[size : 2 * size, 2 * size + counted : 2 * size + counted + stored]


def slices(problem: OptimalControl) -> Slice:
    """The constant part of all steps."""
    shaping: Shaping = problem.inputs.shaping(problem.steps, problem.scheme.tableau.c)
    shift, load, read, direct = (jnp.asarray(x) for x in shaping[:4])
    place = None if problem.uniform else mesh_of(problem.phases, problem.dt)
    system = None
    if problem.later:
        system = InPhase(*(jnp.asarray(x) for x in places(problem.systems, problem.phases)))
    return Slice(jnp.arange(problem.steps), shift, load, read, direct, place, system)


def each_step(problem: OptimalControl, function: Callable, *given: Any) -> Any:
    """A function of all steps: at once, but where their systems differ one after the other."""
    if problem.later:
        return jax.lax.map(lambda one: function(*one), given)
    return jax.vmap(function)(*given)


def entering(problem: OptimalControl, coefficients: Float[Array, "c m"]) -> Float[Array, "steps m"]:
    """The coefficient that enters the register in each step; zero where none does."""
    starts = slice(0, problem.steps, problem.inputs.every)
    found = jnp.zeros((problem.steps, coefficients.shape[1]), coefficients.dtype)
    return found.at[starts].set(coefficients[problem.inputs.degree :])


def enters_in(problem: OptimalControl) -> Bool[np.ndarray, "steps 1"]:
    """Whether a coefficient enters in a step."""
    return (np.arange(problem.steps) % problem.inputs.every == 0)[:, None]


def first_node(problem: OptimalControl, free: Float[Array, " p"], leading: Float[Array, "degree m"]) -> Node:
    """Node before the first step, from what is free and the first coefficients of the spline."""
    start = jnp.asarray(problem.inputs.shaping(1).start)
    last, memory = jnp.zeros(problem.looked_back), jnp.zeros(sum(problem.memory_sizes))
    x = packed(problem.start(free), most_counted(problem.systems))
    return Node(x, free, last, memory, start @ leading)


def times_of(problem: OptimalControl, free: Float[Array, " p"], at: Slice) -> tuple[Array, Array, Array]:
    """When a step begins, how long it lasts, and the time from the middle of the step before it [s]."""
    if at.place is None:
        dt = problem.applied(free)[1]
        return problem.state.t + at.number * dt, dt, dt
    durations = problem.durations(free)
    begin, dt, gap = (x @ durations for x in (at.place.begin, at.place.share, at.place.gap))
    return problem.state.t + begin, dt, gap


def seen(
    problem: OptimalControl,
    system: System,
    number: Any,
    times: tuple[Any, Any],
    states: tuple[State, State],
    u: Array,
    node: Node,
    stages: tuple[Instant, ...] = (),
) -> tuple[Array, Array, Array, Array]:
    """What a step costs, its excesses, and what is carried on from it.

    Args:
        problem: the problem.
        system: of the step.
        number: of the step.
        times: its duration, and the time from the middle of the step before it [s].
        states: at its start and its end.
        u: its inputs, at its last stage.
        node: before it.
        stages: if it has several.

    Returns:
        Its cost, the excess over bounds at its end, its inputs where somebody asks for them, and the memory.
    """
    dt, gap = times
    if stages:
        # From the last stage of the step before, whose duration is twice the gap less this one.
        gap = (2.0 * gap - dt) * (1.0 - stages[-1].part) + dt * stages[-1].part
    step = Step(number, dt, *states, u, node.last, gap, problem.named(node.free), stages)
    cost = problem.cost.of_step(system, problem.memories(node.memory)[1], step)
    excess = problem.path_excess(system, node.memory, step)
    last = u if node.last.size else node.last
    return cost, excess, last, problem.carried(system, node.memory, step)


def standing_excess(
    problem: OptimalControl,
    state: State,
    u: Float[Array, " inputs"],
    free: Float[Array, " p"],
    last: Float[Array, " inputs"] | None = None,
) -> Float[Array, " n"]:
    """Excess over the bounds in a state that stays, with given inputs, and others before or the same."""
    system, dt = problem.applied(free)
    last = u if last is None else last
    last, memory = (last if problem.looked_back else u[:0]), jnp.zeros(sum(problem.memory_sizes))
    step = Step(jnp.array(1), dt, state, state, u, last, dt, problem.named(free))
    return jnp.tile(problem.path_excess(system, memory, step), problem.stages)


def stage(
    problem: OptimalControl,
    at: Slice,
    node: Node,
    w: Float[Array, " m"],
    y: Float[Array, " n"],
    stretch: Any = 1.0,
    reached: Float[Array, " x"] | None = None,
    moving: Float[Array, " v"] | None = None,
) -> Stage:
    """One step from its unknowns: explicit, and smooth in everything.

    Args:
        problem: the problem.
        at: the constant part of the step.
        node: before it.
        w: coefficients that enter.
        y: unknowns of its equations.
        stretch: makes this step longer.
        reached: the state at its end that cost and bounds see, where that is an unknown of its own.
        moving: velocities and rates of rotors at its start, where they are not those of the node: derivatives
            in them alone are few then.
    """
    systems = problem.applied_systems(node.free)
    if at.system is None:
        return _stage(problem, systems, (0,), at, node, w, y, stretch, reached, moving)
    if moving is not None:
        node = eqx.tree_at(lambda n: n.x, node, node.x.at[moving_places(problem)].set(moving))
    ways = [lambda x: x, *(partial(_transferred, problem, systems, p) for p in range(1, len(systems)))]
    node = eqx.tree_at(lambda n: n.x, node, jax.lax.switch(at.system.enters, ways, node.x))
    steps = [partial(_stage, problem, systems, kind) for kind in kinds(systems)]
    if len(steps) == 1:
        return steps[0](at, node, w, y, stretch, reached)
    return jax.lax.switch(at.system.kind, steps, at, node, w, y, stretch, reached)


def _transferred(problem: OptimalControl, systems: Systems, phase: int, x: Float[Array, " x"]) -> Array:
    """The state by which a phase is entered, from that at the end of the one before."""
    state = unpacked(like(problem.systems, problem.state, phase - 1), x, problem.state.t)
    return packed(entered(systems, phase, state)[1], most_counted(systems))


def _stage(
    problem: OptimalControl,
    systems: Systems,
    kind: tuple[int, ...],
    at: Slice,
    node: Node,
    w: Array,
    y: Array,
    stretch: Any,
    reached: Array | None,
    moving: Array | None = None,
) -> Stage:
    """A step of a phase whose system is of one kind."""
    begin, dt, gap = times_of(problem, node.free, at)
    dt = stretch * dt
    tableau, stages = problem.scheme.tableau, ()
    decided = at.read @ node.register + at.direct[:, None] * w
    u = problem.inputs.driven(decided, len(problem.system.structure.inputs))
    before = unpacked(like(problem.systems, problem.state, kind[0]), node.x, begin)
    if moving is not None:
        v, rates = jnp.split(moving, [before.v.size])
        before = replace_fields(before, v=v.reshape(-1, 3), rates=rates)
    system = systems[0] if at.system is None else at_hand(systems, kind, at.system.phase, before)
    own = tableau.stages * (system.structure.unknowns + system.structure.multipliers)
    if tableau.stages == 1:
        residual, after, _ = advance(system, before, u[0], dt, y[:own], tableau)
    else:
        residual, after, stages = collocated(system, before, u, dt, y[:own], tableau)
    # The account of work plays no part.
    after = replace_fields(after, work=before.work)
    ending = after if reached is None else unpacked(after, reached, after.t)
    times, states = (dt, gap), (before, ending)
    cost, excess, last, memory = seen(problem, system, at.number, times, states, u[-1], node, stages)
    if not u.size:
        # What acts on nothing wants to be zero.
        cost = cost + 0.5 * dt * jnp.asarray(tableau.b) @ jnp.sum(decided**2, axis=1)
    register = at.shift @ node.register + at.load[:, None] * w
    x = packed(after, most_counted(systems))
    # What other phases have more unknowns for is zero.
    residual = jnp.concatenate([residual, y[own:]])
    return Stage(residual, cost, excess, Node(x, node.free, last, memory, register))


def end(problem: OptimalControl, node: Node) -> End:
    """What the final node gives."""
    systems, final = problem.applied_systems(node.free), len(problem.later)
    t = problem.state.t + jnp.sum(problem.durations(node.free))
    state = unpacked(like(problem.systems, problem.state, final), node.x, t)
    system = at_hand(systems, (final,), final, state) if final else systems[0]
    lower, upper = problem.limits()
    values, scale = problem.values(node.free), problem.references()[1]
    below, above = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    goal, cost, _ = problem.memories(node.memory)
    asked = any(carrier.looks_at_start() for carrier in problem.carriers)
    first = problem.start(node.free) if asked else problem.state
    ending = Ending(first, state, goal, problem.named(node.free))
    limits = problem.goal.excess(system, ending)
    excess = [((lower - values) / scale)[below], ((values - upper) / scale)[above], limits]
    return End(
        problem.cost.of_end(system, ending._replace(memory=cost)),
        problem.goal.missing(system, ending),
        jnp.concatenate(excess),
    )


def followed(
    problem: OptimalControl, free: Float[Array, " p"], states: State, inputs: Float[Array, "steps u"]
) -> tuple[Array, Array, End]:
    """What a motion of one system gives that is known by its states and inputs.

    Args:
        problem: the problem.
        free: as in `Unknowns`.
        states: at the start and at the ends of all steps.
        inputs: of all steps.

    Returns:
        Costs of the steps, excesses over the bounds at their ends, and what the end gives.
    """
    first = first_node(problem, free, jnp.zeros((problem.inputs.degree, problem.channels)))
    system, _ = problem.applied(free)
    before, after = (jax.tree.map(itemgetter(s), states) for s in (slice(None, -1), slice(1, None)))

    def body(node: Node, given: tuple) -> tuple[Node, tuple[Array, Array]]:
        at, before, after, u = given
        times = times_of(problem, free, at)[1:]
        cost, excess, last, memory = seen(problem, system, at.number, times, (before, after), u, node)
        return eqx.tree_at(lambda n: (n.last, n.memory), node, (last, memory)), (cost, excess)

    given = slices(problem), before, after, inputs
    node, (costs, excess) = jax.lax.scan(body, first, given)
    final = packed(jax.tree.map(lambda x: x[-1], states))
    return costs, excess, end(problem, eqx.tree_at(lambda n: n.x, node, final))


def roll(problem: OptimalControl, unknowns: Unknowns) -> Path:
    """The motion of given unknowns; its residuals need not vanish."""
    return corrected(problem, unknowns)[0]


def corrected(
    problem: OptimalControl, unknowns: Unknowns, inverses: Array | None = None
) -> tuple[Path, Unknowns]:
    """The motion of unknowns that are corrected by inverses of the Jacobians of the steps, and these."""
    w = entering(problem, unknowns.coefficients)
    first = first_node(problem, unknowns.free, unknowns.coefficients[: problem.inputs.degree])

    def body(node: Node, given: tuple) -> tuple[Node, tuple[Node, Stage, Array]]:
        at, w, y, inverse = given
        y = y if inverse is None else y - inverse @ stage(problem, at, node, w, y).residual
        found = stage(problem, at, node, w, y)
        return found.after, (node, found, y)

    given = slices(problem), w, unknowns.y, inverses
    last, (nodes, stages, y) = jax.lax.scan(body, first, given)
    nodes = jax.tree.map(lambda x, x1: jnp.concatenate([x, x1[None]]), nodes, last)
    return Path(nodes, stages, end(problem, last)), eqx.tree_at(lambda u: u.y, unknowns, y)


def held_inputs(
    problem: OptimalControl, coefficients: Float[Array, "c m"]
) -> Float[Array, "steps m"] | Float[Array, "steps s m"]:
    """Inputs of all steps; at their stages where they have several."""
    decided, stages = coefficients, problem.stages
    if problem.inputs.degree or problem.inputs.every > 1 or stages > 1:
        decided = jnp.asarray(problem.inputs.matrix(problem.steps, problem.scheme.tableau.c)) @ coefficients
    if stages > 1:
        decided = decided.reshape(problem.steps, stages, -1)
    return problem.inputs.driven(decided, len(problem.system.structure.inputs))


class Piece(NamedTuple):
    """Unknowns of simulated steps, whether every step was made whole, and the number of Newton iterations."""

    y: Float[Array, "*k n"]
    whole: Bool[Array, "*k"]
    newton: Int[Array, "*k"]


def simulated(problem: OptimalControl, unknowns: Unknowns, lifted: bool) -> tuple[Unknowns, Array, Array]:
    """Unknowns of the steps replaced by those of a simulation; the same where the method is lifted.

    Returns:
        Unknowns; whether every step was made whole; and the number of Newton iterations.
    """
    if lifted:
        return unknowns, jnp.array(True), jnp.array(0)
    systems, free = problem.applied_systems(unknowns.free), unknowns.free
    inputs, state = held_inputs(problem, unknowns.coefficients), problem.start(free)

    def piece(system: System, state: State, given: tuple[Array, Array]) -> tuple[State, Piece]:
        u, dt = given
        plan = Plan(u.shape[0], 0, TOLERANCE, None, tableau=problem.scheme.tableau)
        slots, ending = run_slots(plan, system, state, u, dt)
        whole = (ending.course.code == 0) & jnp.all(slots.accepted) & jnp.all(slots.fraction == 1.0)
        y = filled(slots.y, unknowns.y.shape[1])
        return ending.course.state, Piece(y, whole, ending.course.iterations)

    found, system, lengths = [], systems[0], problem.lengths(free)
    for phase, (first, last) in enumerate(spans(problem.phases)):
        if 0 < phase < len(systems):
            system, state = transfer(system, state, systems[phase])
        u, dt = inputs[first:last], lengths[first:last]
        if problem.even:
            state, reached = piece(system, state, (u, dt[0]))
        else:
            state, each = jax.lax.scan(partial(piece, system), state, (u[:, None], dt))
            reached = Piece(each.y[:, 0], jnp.all(each.whole), jnp.sum(each.newton))
        found.append(reached)
    y, whole, newton = zip(*found)
    whole, newton = (jnp.stack(x) for x in (whole, newton))
    return replace_fields(unknowns, y=jnp.concatenate(y)), jnp.all(whole), jnp.sum(newton)
