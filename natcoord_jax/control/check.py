"""Whether a solution is one: conditions of optimality, refinement, conservation, the Hamiltonian."""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.analysis import balance
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.newton import as_unknowns
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.proposal import curved_in_free, softest
from natcoord_jax.control.reasons import switches
from natcoord_jax.control.refinement import refined
from natcoord_jax.control.run import optimise
from natcoord_jax.control.solution import SOLUTION, Solution
from natcoord_jax.control.transcription import each_step, entering, slices, stage
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG, FunctionOf


@dataclasses.dataclass(frozen=True)
class Check:
    """What a check of a solution found.

    Attributes:
        stationarity: gradient of the Lagrangian, relative.
        complementarity: multiplier times room of the bounds, relative to the cost.
        kind: "minimum", "saddle", or "unknown" where the curvature is too small to tell.
        curvature: the least of the Lagrangian, relative to the largest in a single input, along changes that
            keep to the motion and the goal to first order; bounds add to it as they press, and where they add
            more everywhere it is relative to the least of that. Without inputs it is that in what is free.
            None without an iterate of the second-order method, and where the goal leaves nothing free.
        direction: of unit length along which it is so, as change of the inputs' coefficients (coefficients,
            inputs); without inputs, of what is free, in units of its size.
        missing: residual of the goal by name, of the simulated motion.
        exceeded: largest excess of each bound by name; negative inside.
        switches: steps within which an input goes from one of its limits to the other, by its name: a held
            input is a mean of both there, and more steps show the moment better.
        costs: cost by number of steps, with the steps halved and doubled.
        order: observed order of the cost; None if it was not asked for or cannot be seen.
        extrapolated: cost at vanishing step by Richardson's extrapolation, of the order of scheme and inputs.
        angular_momentum: largest error of the balance of angular momentum, relative; None if nothing turns.
        energy: largest error of the balance of energy, relative.
        hamiltonian: mean over the steps; None for a problem that depends on time.
        hamiltonian_spread: largest deviation from the mean, relative to the largest of its two parts.
    """

    stationarity: float
    complementarity: float
    kind: str
    curvature: float | None
    direction: np.ndarray | None
    missing: dict[str, float]
    exceeded: dict[str, float]
    switches: dict[str, list[int]]
    costs: dict[int, float]
    order: float | None
    extrapolated: float | None
    angular_momentum: float | None
    energy: float | None
    hamiltonian: float | None
    hamiltonian_spread: float | None

    def __str__(self) -> str:
        """The findings, one a line."""
        lines = [
            f"gradient of the Lagrangian  {self.stationarity:.2e}",
            f"complementarity             {self.complementarity:.2e}",
        ]
        if self.curvature is not None:
            lines.append(f"least curvature, relative   {self.curvature:+.2e}: {self.kind}")
        lines += [f"goal: {name}  {value:+.2e}" for name, value in self.missing.items()]
        lines += [f"bound: {name}  {value:+.2e}" for name, value in self.exceeded.items()]
        lines += [
            f"{name} switches within step {', '.join(map(str, steps))}: a mean of its limits; refine it"
            for name, steps in self.switches.items()
        ]
        lines += [f"cost with {steps} steps  {cost:.10g}" for steps, cost in sorted(self.costs.items())]
        for label, value in (
            ("observed order", self.order),
            ("cost at vanishing step", self.extrapolated),
            ("angular momentum, relative error", self.angular_momentum),
            ("energy balance, relative error", self.energy),
            ("Hamiltonian", self.hamiltonian),
            ("its spread, relative", self.hamiltonian_spread),
        ):
            if value is not None:
                lines.append(f"{label}  {value:.6g}")
        return "\n".join(lines)


@compiled
def _hamiltonians(
    problem: OptimalControl, iterate: Iterate
) -> tuple[Float[Array, " steps"], Float[Array, " steps"]]:
    """Change of the Lagrangian per second that a step lasts longer, and the part of the cost in it."""
    before = jax.tree.map(lambda x: x[:-1], iterate.path.nodes)
    worth = iterate.derivatives.worth
    after = jax.tree.map(lambda x: x[1:], worth.nodes)
    _, dt = problem.applied(iterate.unknowns.free)
    w = entering(problem, iterate.unknowns.coefficients)

    def one(at, node, w, y, after, residual):
        def value(stretch: Array) -> tuple[Array, Array]:
            found = stage(problem, at, node, w, y, stretch)
            carried = sum(
                jnp.sum(a * b) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(found.after))
            )
            return found.cost + carried + residual @ found.residual, found.cost

        whole, cost = jax.jvp(value, (jnp.ones(()),), (jnp.ones(()),))[1]
        return whole / dt, cost / dt

    return each_step(problem, one, slices(problem), before, w, iterate.unknowns.y, after, worth.residuals)


def _hamiltonian(solution: Solution) -> tuple[float | None, float | None]:
    """Mean and relative spread of the Hamiltonian; alternate steps are averaged, as the scheme alternates."""
    if solution.iterate is None:
        return None, None
    whole, cost = (np.asarray(x) for x in _hamiltonians(solution.problem, solution.iterate))
    smooth = 0.5 * (whole[1:] + whole[:-1]) if whole.size > 1 else whole
    size = max(np.max(np.abs(cost)), np.max(np.abs(whole - cost)), 1e-300)
    return float(np.mean(smooth)), float(np.max(np.abs(smooth - np.mean(smooth))) / size)


SEEN = 1e-6
"""Curvature, relative to the largest, that differences can tell from none."""


def _second_order(solution: Solution) -> tuple[str, float | None, np.ndarray | None]:
    """Whether it is a minimum, and the least curvature with its direction."""
    if solution.iterate is None:
        return "unknown", None, None
    if solution.problem.system.structure.inputs:
        value, along, unit = softest(solution.problem, solution.iterate)
        along = as_unknowns(solution.problem, solution.iterate, along).coefficients
    else:
        value, along, unit = _softest_in_free(solution.problem, solution.iterate)
        if along is None:
            return "minimum", None, None
    relative = float(value) / float(unit) if unit > 0 else 0.0
    kind = "minimum" if relative > SEEN else "saddle" if relative < -SEEN else "unknown"
    return kind, relative, np.asarray(along)


def _softest_in_free(problem: OptimalControl, iterate: Iterate) -> tuple[float, np.ndarray | None, float]:
    """The least curvature in what is free, its direction (None: the goal leaves none), and the largest."""
    curved, slopes = (np.asarray(x) for x in curved_in_free(problem, iterate))
    sizes = np.linalg.norm(slopes, axis=1, keepdims=True)
    _, s, vt = np.linalg.svd(np.where(sizes > 0, slopes / np.where(sizes > 0, sizes, 1.0), 0.0))
    ways = vt[np.count_nonzero(s > SEEN) :]
    if not len(ways):
        return 0.0, None, 0.0
    values, directions = np.linalg.eigh(ways @ curved @ ways.T)
    return float(values[0]), directions[:, 0] @ ways, float(np.max(np.abs(np.diagonal(curved))))


@checked(solution=SOLUTION, refine=FLAG, autonomous=FLAG, make=FunctionOf("(steps) -> problem"))
def check(
    solution: Solution,
    *,
    refine: bool = True,
    autonomous: bool = True,
    make: Callable[[int], OptimalControl] | None = None,
) -> Check:
    """Check a solution.

    Args:
        solution: what `optimise` returned.
        refine: solve again with half and with twice the number of steps, starting from the solution.
        autonomous: whether neither cost nor bounds nor loads depend on time; then the Hamiltonian is constant
            up to the order of the scheme.
        make: makes the problem for a number of steps, where it cannot be had by changing steps and dt.

    Returns:
        The findings; `print` shows them.
    """
    problem, iterate = solution.problem, solution.iterate
    excess = [] if iterate is None else np.asarray(iterate.path.stages.excess).max(axis=0, initial=-np.inf)
    exceeded: dict[str, float] = {}
    # At the stages bounds have their names again.
    for name, value in zip(problem.path_labels, np.asarray(excess).tolist()):
        exceeded[name] = max(value, exceeded.get(name, -np.inf))
    if iterate is not None:
        exceeded |= dict(zip(problem.end_labels, np.asarray(iterate.path.end.excess).tolist()))
    costs = {problem.steps: solution.cost}
    order = extrapolated = None
    if refine:
        for steps in (problem.steps // 2, 2 * problem.steps):
            finer = make(steps) if make and steps >= 1 else refined(problem, steps)
            if finer is not None:
                again = optimise(finer, solution, progress=False)
                if again.ok:
                    costs[steps] = again.cost
        # Splines of degree d come within h^(d + 1) of an input, and costs are of second order in that.
        expected = min(problem.scheme.order, 2 * problem.inputs.degree + 2)
        order, extrapolated = _refinement(costs, expected)
    # Of each phase by itself: an impact between them takes energy.
    found = [balance(system, trajectory) for system, trajectory in solution.phases.pairs]
    errors = [_worst([x.angular_momentum for x in found]), _worst([x.energy for x in found])]
    hamiltonian = _hamiltonian(solution) if autonomous else (None, None)
    return Check(
        float(iterate.errors.stationarity) if iterate is not None else math.nan,
        float(iterate.errors.complementarity) if iterate is not None else math.nan,
        *_second_order(solution),
        solution.missing,
        exceeded,
        {} if iterate is None else switches(problem, iterate),
        costs,
        order,
        extrapolated,
        errors[0],
        errors[1],
        *hamiltonian,
    )


def _worst(errors: list) -> float | None:
    """Largest error of all phases; None where none is known."""
    known = [float(np.max(error)) for error in errors if error is not None]
    return max(known) if known else None


def _refinement(costs: dict[int, float], expected: int) -> tuple[float | None, float | None]:
    """Observed order, and the cost extrapolated with that expected, from costs at some numbers of steps."""
    steps = sorted(costs)
    if len(steps) < 2:
        return None, None
    fine, coarse = costs[steps[-1]], costs[steps[-2]]
    ratio = (steps[-1] / steps[-2]) ** expected
    extrapolated = (ratio * fine - coarse) / (ratio - 1)
    if len(steps) < 3 or fine == coarse or (costs[steps[0]] - coarse) / (coarse - fine) <= 0:
        return None, extrapolated
    return math.log2((costs[steps[0]] - coarse) / (coarse - fine)), extrapolated
