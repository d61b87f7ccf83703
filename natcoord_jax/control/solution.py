"""What an optimisation returns, and files of it."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import System
from natcoord_jax.control.bounds import Bound
from natcoord_jax.control.goal import Goal
from natcoord_jax.control.guess import Guess, free_of_swings
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.results import ADVICE, OUTCOMES, Outcome
from natcoord_jax.control.transcription import held_inputs
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.host import on_host
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.stepping.simulate import simulate

FILE = of("the name of a file", str, Path)

AT_BOUND = 1e-9
"""Excess, in half a range, that is rounding."""

NAMED = 3
"""How many violated conditions a message names."""


class Row(NamedTuple):
    """One line of the history.

    Attributes:
        iteration: number.
        cost: whole cost.
        stationarity: gradient of the Lagrangian, relative.
        violation: largest violation of goal, bounds and equations.
        worst: what violates it.
        step: length of the step.
        newton: Newton iterations of the simulations so far.
        seconds: since the start.
    """

    iteration: int
    cost: float
    stationarity: float
    violation: float
    worst: str
    step: float
    newton: int
    seconds: float


class Solution(eqx.Module):
    """The end of an optimisation, reached or not.

    Its numbers are leaves: `eqx.tree_serialise_leaves` writes them, and reads them into a solution of the
    same problem with as many rows of history. `save` writes what a warm start needs, for any number of steps.

    Attributes:
        problem: the problem.
        inputs: of all steps (steps, inputs) [N, N m].
        free: values of final time [s] and parameters by name.
        dt: step [s].
        cost: whole cost.
        code: how it ended, see `outcome`.
        method: how it was found: "shooting", "lifted" or "first-order", and with what.
        iterate: where the second-order method ended, for warm starts, feedback and sensitivities.
        unreachable: part of the goal's residual that no input changes.
        history: one row for each iteration.
    """

    problem: OptimalControl
    inputs: Float[Array, "steps inputs"]
    free: dict[str, float]
    dt: float
    cost: float
    code: int
    method: str
    iterate: Iterate | None = None
    unreachable: Any = None
    history: list[Row] = eqx.field(default_factory=list)

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return Outcome(int(self.code))

    @property
    def ok(self) -> bool:
        """Whether the conditions of optimality are fulfilled."""
        return self.outcome.ok

    @property
    def system(self) -> System:
        """The system with the parameters found."""
        return self.problem.applied(self._scaled())[0]

    @property
    def start(self) -> State:
        """The initial state, assembled anew if a parameter moves geometry."""
        return self.problem.start(self._scaled())

    def _scaled(self) -> Array:
        reference, scale = self.problem.references()
        values = jnp.asarray([self.free[name] for name in self.problem.free])
        return (values - reference) / scale if values.size else jnp.zeros(0)

    @property
    def trajectory(self) -> Trajectory:
        """The motion, simulated with the inputs found.

        Raises:
            SimulationError: if it cannot be simulated.
        """
        return simulate(self.system, self.start, dt=self.dt, inputs=self.inputs)

    @property
    def missing(self) -> dict[str, float]:
        """Residual of the goal at the end of the simulated motion, by name."""
        final = jax.tree.map(lambda x: x[-1], self.trajectory.states)
        names = self.problem.goal.labels(self.problem.system)
        residual = _residual(self.problem.goal, self.system, final)
        return dict(zip(_unique(names), np.asarray(residual).tolist()))

    @property
    def multipliers(self) -> dict[str, Any]:
        """Multipliers of the goal by name, and of the bounds by name, one for each step."""
        if self.iterate is None:
            return {}
        m = self.iterate.multipliers
        goal = _unique(self.problem.goal.labels(self.problem.system))
        bounds = _unique(self.problem.bounds.labels(self.problem.system))
        found: dict[str, Any] = dict(zip(goal, np.asarray(m.goal).tolist()))
        return found | {name: np.asarray(m.path)[:, k] for k, name in enumerate(bounds)}

    def explain(self) -> str:
        """How it ended, in words, with the conditions that are violated most."""
        text = OUTCOMES[self.outcome]
        if self.iterate is not None or self.history:
            text += f" after {len(self.history)} iterations by {self.method}"
        if self.history:
            last = self.history[-1]
            text += (
                f": cost {last.cost:.8g}, gradient {last.stationarity:.1e}, violation {last.violation:.1e}"
            )
        if self.ok:
            return text
        if self.outcome is Outcome.INFEASIBLE_START:
            outside = outside_at_start(self.problem).items()
            text += ": " + ", ".join(f"{name}, missed by {x:.2g} of half the range" for name, x in outside)
        elif self.outcome is Outcome.UNREACHABLE:
            names = self.problem.goal.labels(self.problem.system)
            sizes = np.abs(np.asarray(self.unreachable))
            order = np.argsort(-sizes)[:NAMED]
            text += "; what no input changes: " + ", ".join(
                f"{names[k]} {sizes[k]:.2e}" for k in order if sizes[k] > 1e-3 * sizes.max()
            )
        elif self.history and self.history[-1].violation > 0:
            text += f"; worst: {self.history[-1].worst}"
        return text + (f"; {ADVICE[self.outcome]}" if self.outcome in ADVICE else "")

    @checked("Solution.guess", steps=Whole(1))
    def guess(self, steps: int | None = None) -> Guess:
        """A guess for another problem, with the inputs resampled in time to another number of steps."""
        rates = None
        structure = self.problem.system.structure
        if self.iterate is not None and structure.solver == "reduced":
            rates = np.asarray(self.iterate.unknowns.y)[:, : structure.unknowns]
        free = [self.free[name] for name in self.problem.free] or None
        steps = steps or self.problem.steps
        rates = None if rates is None else _interpolated(rates, steps)
        return Guess(_resampled(np.asarray(self.inputs), steps), rates=rates, free=free)

    @checked("Solution.save", file=FILE)
    def save(self, file: str | Path) -> None:
        """Write inputs, rates and what is free as JSON; `nc.load_guess` reads it for a warm start."""
        guess = self.guess()
        content = {
            "inputs": np.asarray(guess.inputs).tolist(),
            "rates": None if guess.rates is None else np.asarray(guess.rates).tolist(),
            "free": guess.free,
            "channels": list(self.problem.system.structure.inputs),
            "dt": self.dt,
            "cost": self.cost,
            "outcome": OUTCOMES[self.outcome],
            "method": self.method,
        }
        Path(file).write_text(json.dumps(content) + "\n", "utf-8")


SOLUTION = of("a solution, as nc.optimise(...) returned it", Solution)
"""What an argument may be."""


@checked(file=FILE, steps=Whole(1))
def load_guess(file: str | Path, steps: int | None = None) -> Guess:
    """Read what `Solution.save` wrote, as a guess.

    Args:
        file: the file.
        steps: number of steps to resample to; None: as saved.

    Raises:
        ValueError: for a file that is not such a one.
    """
    try:
        content = json.loads(Path(file).read_text("utf-8"))
        inputs = np.asarray(content["inputs"], float)
        rates = None if content["rates"] is None else np.asarray(content["rates"], float)
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is not a solution that `Solution.save` wrote: {error}") from error
    count = inputs.shape[0] if steps is None else steps
    return Guess(
        _resampled(inputs, count),
        rates=None if rates is None else _interpolated(rates, count),
        free=content["free"],
    )


def _resampled(values: np.ndarray, steps: int) -> np.ndarray:
    """Means of a history held over steps, over as many other steps of the same duration."""
    count = values.shape[0]
    if count == steps:
        return values
    ends = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    at = np.linspace(0.0, count, steps + 1)
    total = np.stack([np.interp(at, np.arange(count + 1), column) for column in ends.T], axis=1)
    return np.diff(total, axis=0) * steps / count


def _interpolated(values: np.ndarray, steps: int) -> np.ndarray:
    """Values at the middles of steps, at those of others; a staircase would shake the motion."""
    count = values.shape[0]
    if count == steps:
        return values
    at, old = (np.arange(steps) + 0.5) / steps, (np.arange(count) + 0.5) / count
    found = np.stack([np.interp(at, old, column) for column in values.T], axis=1)
    # The kinks between the old middles excite swings from step to step.
    first = 1.5 * found[:1] - 0.5 * found[1:2] if steps > 1 else found
    return free_of_swings(np, first, found)


@on_host
def _residual(goal: Goal, system: System, state: State) -> Float[Array, " n"]:
    return goal.residual(system, state)


def outside_at_start(problem: OptimalControl) -> dict[str, float]:
    """Bounds that the initial state exceeds whatever the inputs are, and by how much, in half their range.

    Those of problems whose parameters are free are not looked at.
    """
    if problem.parameters:
        return {}
    excess, by_input = (
        np.asarray(x) for x in _excess_at_start(problem.bounds, problem.system, problem.state)
    )
    fixed = ~np.any(by_input != 0, axis=-1)
    names = _unique(problem.bounds.labels(problem.system))
    return {name: float(x) for name, x, keep in zip(names, excess, fixed) if keep and x > AT_BOUND}


@on_host
def _excess_at_start(bounds: Bound, system: System, state: State) -> tuple[Array, Array]:
    def excess(u: Array) -> Array:
        return bounds.excess(system, state, u, state.t)

    idle = jnp.zeros(len(system.structure.inputs))
    return excess(idle), jax.jacfwd(excess)(idle)


def _unique(names: tuple[str, ...]) -> list[str]:
    """Names with numbers where they occur more than once."""
    return [
        name if names.count(name) == 1 else f"{name} #{names[:k].count(name) + 1}"
        for k, name in enumerate(names)
    ]


def solution_of(
    problem: OptimalControl, iterate: Iterate, method: str, history: list[Row], outcome: Outcome
) -> Solution:
    """What the user sees of an iterate."""
    free = problem.values(iterate.unknowns.free)
    dt = float(problem.applied(iterate.unknowns.free)[1])
    names = dict(zip(problem.free, np.asarray(free).tolist()))
    inputs = held_inputs(problem, iterate.unknowns.coefficients)
    cost = float(iterate.path.cost)
    unreachable = np.asarray(iterate.unreachable)
    code = int(outcome)
    return Solution(problem, inputs, names, dt, cost, code, method, iterate, unreachable, history)


def worst_condition(problem: OptimalControl, iterate: Iterate) -> tuple[float, str]:
    """Largest violation of an iterate, and the name of what violates it."""
    found: list[tuple[float, str]] = [(float(iterate.errors.motion), "equations of motion")]
    missing = np.abs(np.asarray(iterate.path.end.missing))
    if missing.size:
        k = int(np.argmax(missing))
        found.append((float(missing[k]), problem.goal.labels(problem.system)[k]))
    excess = np.asarray(iterate.path.stages.excess)
    if excess.size:
        at, k = np.unravel_index(int(np.argmax(excess)), excess.shape)
        name = problem.bounds.labels(problem.system)[int(k)]
        found.append((max(float(excess[at, k]), 0.0), f"{name}, step {int(at)}"))
    return max(found)
