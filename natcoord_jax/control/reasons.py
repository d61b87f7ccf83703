"""What was seen of an optimisation that did not end well: conditions by name, with numbers and units."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.control.bounds import Input
from natcoord_jax.control.cost import Cost
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.motion import motion
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.transcription import held_inputs, standing_excess
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.reading.diagnostics import explain

AT_BOUND = 1e-9
"""Excess, in half a range, that is rounding."""
AT_LIMIT = 0.01
"""Room to a bound, in half a range, of what counts as at its limit."""
ENDLESS = 5.0
"""Growth of a free time, relative to its first guess, that is worth telling."""
NAMED = 3
"""How many violated conditions a message names."""


def unique(names: tuple[str, ...]) -> list[str]:
    """Names with numbers where they occur more than once."""
    return [
        name if names.count(name) == 1 else f"{name} #{names[:k].count(name) + 1}"
        for k, name in enumerate(names)
    ]


def seen(problem: OptimalControl, iterate: Iterate, outcome: Outcome) -> str:
    """What an iterate shows of the reason why the method ended there; nothing where all is well."""
    if outcome.ok:
        return ""
    if outcome is Outcome.UNREACHABLE:
        return out_of_reach(problem, np.asarray(iterate.unreachable))
    if outcome is Outcome.SIMULATION_FAILED:
        return not_simulated(problem, iterate)
    if outcome in (Outcome.NONFINITE, Outcome.SINGULAR):
        return undefined(problem, iterate)
    violation, worst = worst_condition(problem, iterate)
    text = f"worst: {worst}, {violation:.1e}{at_limits(problem, iterate)}" if violation > 0 else ""
    if outcome is Outcome.STALLED:
        count = int(iterate.failures)
        text += f"; {count} steps in a row made nothing better, however short"
        if float(iterate.shift) > 0:
            text += f", with {float(iterate.shift):.0e} times the typical curvature added"
    if outcome is Outcome.DIVERGED:
        text += f"; {largest_multiplier(problem, iterate)}"
    return text.removeprefix("; ")


def _largest_of(names: list[str], values: np.ndarray, wording: str = "{name} {value:.2e}") -> str:
    """The largest of some numbers, by name."""
    sizes = np.abs(values)
    order = [k for k in np.argsort(-sizes)[:NAMED] if sizes[k] > 1e-3 * sizes.max()]
    return ", ".join(wording.format(name=names[k], value=sizes[k]) for k in order)


def out_of_reach(problem: OptimalControl, unreachable: np.ndarray) -> str:
    """What no input changes, to first order."""
    names = unique(problem.goal_labels)
    if not unreachable.size or not np.any(unreachable):
        return ""
    return f"what no input changes: {_largest_of(names, unreachable)}"


def nearest(problem: OptimalControl, iterate: Iterate) -> str:
    """How near to the goal a motion comes that no change of the inputs brings nearer, and what holds it."""
    names = unique(problem.goal_labels)
    missed = _largest_of(names, np.asarray(iterate.path.end.missing))
    return f"the nearest motion misses {missed}{at_limits(problem, iterate)}"


def needed(wider: OptimalControl, problem: OptimalControl) -> str:
    """Limits of the inputs that would do, beside those there are."""
    time, found = float(jnp.sum(problem.lengths(jnp.zeros(len(problem.free))))), []
    for wide, bound in zip(wider.bounds.everything(), problem.bounds.everything()):
        if isinstance(bound, Input) and isinstance(wide, Input):
            names = ", ".join(bound.names(problem.system))
            found.append(f"{names} from {_range(wide)}; the limits are {_range(bound)}")
    return f"reaching the goal in {time:.4g} s needs {', '.join(found)} [N, N m]"


def _range(bound: Input) -> str:
    lower, upper = (np.asarray(x) for x in (bound.lower, bound.upper))
    if lower.ndim or upper.ndim:
        return f"{np.round(lower, 6).tolist()} to {np.round(upper, 6).tolist()}"
    return f"{float(lower):.4g} to {float(upper):.4g}"


def waiting(problem: OptimalControl, free: dict[str, float]) -> str:
    """That a free time has grown without end, where nothing makes waiting cost; nothing where it has not."""
    costly = any(part.hurries for part in problem.cost.everything() if isinstance(part, Cost))
    values, first = list(free.values())[: problem.times], np.asarray(problem.references()[0])
    upper = problem.limits()[1]
    for k, (name, value) in enumerate(zip(problem.free, values)):
        if not costly and not np.isfinite(upper[k]) and value > ENDLESS * float(first[k]):
            return (
                f"{name} has grown from {float(first[k]):.4g} to {value:.4g}: where waiting costs nothing "
                "the best time is without end; add nc.cost.Duration() to the cost or an upper limit, "
                "free_time=(lower, upper)"
            )
    return ""


def at_limits(problem: OptimalControl, iterate: Iterate) -> str:
    """Which bounds hold an iterate in the most of its steps."""
    excess = np.asarray(iterate.path.stages.excess)
    labels = unique(problem.path_labels)
    counts = np.sum(excess > -AT_LIMIT, axis=0)
    most = [k for k in np.argsort(-counts, kind="stable")[:NAMED] if counts[k] > 0]
    named = [f"{labels[k]} in {counts[k]} of {problem.steps} steps" for k in most]
    return f", at the limits: {', '.join(named)}" if named else ""


def switches(problem: OptimalControl, iterate: Iterate) -> dict[str, list[int]]:
    """Steps within which an input goes from one of its limits to the other: held, it is a mean of both.

    Twice as many steps show the moment twice as well.
    """
    steep = np.asarray(_excess_at_start(problem)[1])
    held = np.asarray(iterate.path.stages.excess) > -AT_LIMIT
    alone = np.count_nonzero(steep, axis=1) == 1
    found = {}
    for k, name in enumerate(problem.system.structure.inputs):
        low, high = (np.any(held[:, alone & (side * steep[:, k] > 0)], axis=1) for side in (-1, 1))
        free = ~(low | high)[1:-1]
        across = (low[:-2] & high[2:]) | (high[:-2] & low[2:])
        found[f"input {name!r}"] = (np.flatnonzero(free & across) + 1).tolist()
    return {name: steps for name, steps in found.items() if steps}


def not_simulated(problem: OptimalControl, iterate: Iterate) -> str:
    """Where the simulation with the inputs of an iterate fails."""
    unknowns = iterate.unknowns
    system, _ = problem.applied(unknowns.free)
    inputs = held_inputs(problem, unknowns.coefficients)
    trajectory = motion(problem, unknowns.free, inputs, throw=False)
    if int(trajectory.result) == 0:
        return "steps had to be divided, which is none of the problem's"
    return explain(system, trajectory)


def undefined(problem: OptimalControl, iterate: Iterate) -> str:
    """The first of what is no number, and where."""
    path = iterate.path
    times = np.cumsum(np.asarray(problem.lengths(iterate.unknowns.free)))

    def at(values: Array) -> str:
        bad = np.flatnonzero(~np.isfinite(np.asarray(values).reshape(problem.steps, -1)).all(axis=1))
        return f"step {bad[0]}, t = {float(times[bad[0]]):.4g} s" if bad.size else ""

    for what, values in (
        ("the motion", path.stages.residual),
        ("the running cost", path.stages.cost),
        ("a bound", path.stages.excess),
    ):
        if at(values):
            return f"{what} is no number in {at(values)}"
    if not np.isfinite(float(path.end.cost)):
        return "the cost at the end is no number"
    for name, value in zip(unique(problem.goal_labels), np.asarray(path.end.missing)):
        if not np.isfinite(value):
            return f"the goal is no number: {name}"
    if at(iterate.derivatives.jacobians.inverses):
        return f"a step has no derivative: {at(iterate.derivatives.jacobians.inverses)}"
    if not np.isfinite(float(iterate.errors.stationarity)):
        return "a derivative of cost, goal or bounds is no number"
    return ""


def largest_multiplier(problem: OptimalControl, iterate: Iterate) -> str:
    """The multiplier that has grown most, by the name of its condition."""
    found = {}
    for name, value in zip(unique(problem.goal_labels), np.asarray(iterate.multipliers.goal)):
        found[name] = abs(float(value))
    if iterate.multipliers.motion is not None:
        sizes = np.max(np.abs(np.asarray(iterate.multipliers.motion)), axis=1)
        found[f"equations of motion, step {int(np.argmax(sizes))}"] = float(np.max(sizes))
    name = max(found, key=lambda name: found[name])
    return f"largest multiplier: {name}, {found[name]:.1e}, for a cost of {float(iterate.unit):.1e}"


def outside_at_start(problem: OptimalControl) -> dict[str, float]:
    """Bounds that the initial state exceeds whatever the inputs are, and by how much, in half their range.

    Those of problems whose parameters are free are not looked at.
    """
    if problem.free_numbers:
        return {}
    # (With inputs before it that stay as they are, so that their rates depend on the inputs.)
    before = jnp.zeros(len(problem.system.structure.inputs))
    excess, by_input = (np.asarray(x) for x in _excess_at_start(problem, before))
    fixed = ~np.any(by_input != 0, axis=-1)
    names = unique(problem.path_labels)
    return {name: float(x) for name, x, keep in zip(names, excess, fixed) if keep and x > AT_BOUND}


@eager_numpy
def _excess_at_start(problem: OptimalControl, before: Array | None = None) -> tuple[Array, Array]:
    def excess(u: Array) -> Array:
        return standing_excess(problem, problem.state, u, jnp.zeros(len(problem.free)), before)

    idle = jnp.zeros(len(problem.system.structure.inputs))
    return excess(idle), jax.jacfwd(excess)(idle)


def worst_condition(problem: OptimalControl, iterate: Iterate) -> tuple[float, str]:
    """Largest violation of an iterate, and the name of what violates it."""
    found: list[tuple[float, str]] = [(float(iterate.errors.motion), "equations of motion")]
    missing = np.abs(np.asarray(iterate.path.end.missing))
    if missing.size:
        k = int(np.argmax(missing))
        found.append((float(missing[k]), problem.goal_labels[k]))
    excess = np.asarray(iterate.path.stages.excess)
    if excess.size:
        at, k = np.unravel_index(int(np.argmax(excess)), excess.shape)
        name = problem.path_labels[int(k)]
        found.append((max(float(excess[at, k]), 0.0), f"{name}, step {int(at)}"))
    last = np.asarray(iterate.path.end.excess)
    if last.size:
        k = int(np.argmax(last))
        found.append((max(float(last[k]), 0.0), problem.end_labels[k]))
    return max(found)
