"""The discrete motion as equations between unknowns, in the manner of discrete mechanics and optimal control.

Unknowns are the coefficients of the inputs, the free parameters, and for every step the unknowns of its own
equations: mean rates of the free motions and multipliers. States follow from them explicitly, by increments,
so that joints and directors hold whatever the unknowns are; the residuals of the steps (57) are the equality
constraints. Where the residuals vanish, the motion is that of `nc.simulate`.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.control.inputs import Shaping
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.step import advance


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
    """What one step hands to the next: the state, what is free, the register of the inputs.

    Attributes:
        x: state as one vector: q, v, joint coordinates, rotor rates.
        free: as in `Unknowns`.
        register: of the spline (d, inputs).
    """

    x: Float[Array, "*k x"]
    free: Float[Array, "*k p"]
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
        excess: over the bounds of what is free.
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


class Slice(NamedTuple):
    """What is known of one step: its number, and the spline's machine."""

    number: Int[Array, "*k"]
    shift: Float[Array, "*k d d"]
    load: Float[Array, "*k d"]
    read: Float[Array, "*k d"]
    direct: Float[Array, "*k"]


def packed(state: State) -> Float[Array, " x"]:
    """State as one vector."""
    return jnp.concatenate([state.q.reshape(-1), state.v.reshape(-1), state.coordinates, state.rates])


def unpacked(like: State, x: Float[Array, " x"], t: Float[Array, ""]) -> State:
    """State from a vector, with time and work account given."""
    size = like.q.size
    a, b = 2 * size, 2 * size + like.coordinates.size
    fields = {"q": x[:size].reshape(-1, 3), "v": x[size:a].reshape(-1, 3)}
    return replace_fields(like, t=t, coordinates=x[a:b], rates=x[b:], **fields)


def slices(problem: OptimalControl) -> Slice:
    """The constant part of all steps."""
    shaping: Shaping = problem.inputs.shaping(problem.steps)
    arrays = (jnp.asarray(x) for x in shaping[:4])
    return Slice(jnp.arange(problem.steps), *arrays)


def entering(problem: OptimalControl, coefficients: Float[Array, "c m"]) -> Float[Array, "steps m"]:
    """The coefficient that enters the register in each step; zero where none does."""
    starts = slice(0, problem.steps, problem.inputs.every)
    found = jnp.zeros((problem.steps, coefficients.shape[1]), coefficients.dtype)
    return found.at[starts].set(coefficients[problem.inputs.degree :])


def first_node(problem: OptimalControl, free: Float[Array, " p"], leading: Float[Array, "degree m"]) -> Node:
    """Node before the first step, from what is free and the first coefficients of the spline."""
    start = jnp.asarray(problem.inputs.shaping(1).start)
    return Node(packed(problem.start(free)), free, start @ leading)


def stage(
    problem: OptimalControl,
    at: Slice,
    node: Node,
    w: Float[Array, " m"],
    y: Float[Array, " n"],
    stretch: Any = 1.0,
) -> Stage:
    """One step from its unknowns: explicit, and smooth in everything; `stretch` makes this step longer."""
    system, dt = problem.applied(node.free)
    begin = problem.state.t + at.number * dt
    dt = stretch * dt
    u = at.read @ node.register + at.direct * w
    before = unpacked(problem.state, node.x, begin)
    residual, after, _ = advance(system, before, u, dt, y, gauss(1))
    # The account of work plays no part.
    after = replace_fields(after, work=before.work)
    rate = partial(problem.cost.running, system)
    cost = 0.5 * dt * (rate(before, u, begin) + rate(after, u, after.t))
    excess = problem.bounds.excess(system, after, u, after.t)
    register = at.shift @ node.register + at.load[:, None] * w
    return Stage(residual, cost, excess, Node(packed(after), node.free, register))


def end(problem: OptimalControl, node: Node) -> End:
    """What the final node gives."""
    system, dt = problem.applied(node.free)
    state = unpacked(problem.state, node.x, problem.state.t + problem.steps * dt)
    lower, upper = problem.limits()
    values, scale = problem.values(node.free), problem.references()[1]
    below, above = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    excess = [((lower - values) / scale)[below], ((values - upper) / scale)[above]]
    return End(
        problem.cost.terminal(system, state), problem.goal.residual(system, state), jnp.concatenate(excess)
    )


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


def held_inputs(problem: OptimalControl, coefficients: Float[Array, "c m"]) -> Float[Array, "steps m"]:
    """Inputs of all steps."""
    if problem.inputs.degree == 0 and problem.inputs.every == 1:
        return coefficients
    return jnp.asarray(problem.inputs.matrix(problem.steps)) @ coefficients


def simulated(problem: OptimalControl, unknowns: Unknowns, lifted: bool) -> tuple[Unknowns, Array, Array]:
    """Unknowns of the steps replaced by those of a simulation; the same where the method is lifted.

    Returns:
        Unknowns; whether every step was made whole; and the number of Newton iterations.
    """
    if lifted:
        return unknowns, jnp.array(True), jnp.array(0)
    system, dt = problem.applied(unknowns.free)
    inputs = held_inputs(problem, unknowns.coefficients)
    plan = Plan(problem.steps, 0, TOLERANCE, None)
    slots, ending = run_slots(plan, system, problem.start(unknowns.free), inputs, dt)
    whole = (ending.course.code == 0) & jnp.all(slots.accepted) & jnp.all(slots.fraction == 1.0)
    return replace_fields(unknowns, y=slots.y), whole, ending.course.iterations
