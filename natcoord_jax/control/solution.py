"""What an optimisation returns, and files of it."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.control.collocation import known_rates, unknowns_each
from natcoord_jax.control.guess import Guess, fitted
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.motion import motion, motions
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.reasons import seen, unique, worst_condition
from natcoord_jax.control.resampling import Ends, averaged, ends_of, in_phases, in_proportion, interpolated
from natcoord_jax.control.results import ADVICE, OUTCOMES, Outcome
from natcoord_jax.control.transcription import Unknowns, followed, held_inputs, roll, simulated
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.system import System

FILE = of("the name of a file", str, Path)


class Row(NamedTuple):
    """One line of the history.

    Attributes:
        iteration: number, counted over all attempts.
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


class Attempt(NamedTuple):
    """An attempt that another one followed.

    Attributes:
        method: by which.
        outcome: how it ended.
        iterations: how many it took.
        seconds: with compilation.
        reason: what was seen.
    """

    method: str
    outcome: Outcome
    iterations: int
    seconds: float
    reason: str

    def __str__(self) -> str:
        """In words."""
        found = f"{self.method}: {OUTCOMES[self.outcome]} after {self.iterations} iterations"
        return f"{found}, {self.seconds:.1f} s" + (f"; {self.reason}" if self.reason else "")


class Solution(eqx.Module):
    """The end of an optimisation, reached or not.

    Its numbers are leaves: `eqx.tree_serialise_leaves` writes them, and reads them into a solution of the
    same problem with as many rows of history. `save` writes what a warm start needs, for any number of steps.

    Attributes:
        problem: the problem.
        inputs: of all steps (steps, inputs) [N, N m].
        free: values of final time [s] and parameters by name.
        dt: step [s]; of unequal steps their mean.
        cost: whole cost.
        code: how it ended, see `outcome`.
        method: how it was found: "shooting", "lifted" or "first-order", and with what.
        iterate: where the second-order method ended, for warm starts, feedback and sensitivities.
        unreachable: part of the goal's residual that no input changes.
        history: one row for each iteration, of all attempts.
        reason: what was seen where it did not end well.
        attempts: those before the last one.
        note: what is to be known of it however it ended, as whole turns of the guess that it has not.
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
    reason: str = ""
    attempts: list[Attempt] = eqx.field(default_factory=list)
    note: str = ""

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
            ValueError: if its phases have systems of their own.
        """
        if self.problem.later:
            raise ValueError(
                f"the motion has {len(self.problem.systems)} systems, one for each phase; use "
                "`solution.phases`, which has them and their trajectories"
            )
        return motion(self.problem, self._scaled(), self.inputs)

    @property
    def phases(self) -> Phases:
        """The motion, simulated with the inputs found, in phases of one system each.

        A phase begins with the state that `nc.transfer` makes of the last one before it: velocities jump
        where a joint closes.

        Raises:
            SimulationError: if it cannot be simulated.
        """
        if not self.problem.later:
            return Phases((self.system,), (self.trajectory,))
        systems, trajectories = zip(*motions(self.problem, self._scaled(), self.inputs))
        return Phases(systems, trajectories)

    @property
    def missing(self) -> dict[str, float]:
        """Residual of the goal at the end of the simulated motion, by name."""
        names = self.problem.goal_labels
        if self.problem.later or self.problem.stages > 1:
            residual = _missing_of_phases(self.problem, self._scaled(), jnp.asarray(self.inputs))
        else:
            states = self.trajectory.states
            residual = _missing(self.problem, self._scaled(), states, jnp.asarray(self.inputs))
        return dict(zip(unique(names), np.asarray(residual).tolist()))

    @property
    def multipliers(self) -> dict[str, Any]:
        """Multipliers of the goal and of the bounds at the end by name, and of those of each step."""
        if self.iterate is None:
            return {}
        m = self.iterate.multipliers
        goal = unique(self.problem.goal_labels)
        bounds = unique(self.problem.path_labels)
        found: dict[str, Any] = dict(zip(goal, np.asarray(m.goal).tolist()))
        found |= dict(zip(unique(self.problem.end_labels), np.asarray(m.end).tolist()))
        return found | {name: np.asarray(m.path)[:, k] for k, name in enumerate(bounds)}

    def explain(self) -> str:
        """How it ended, in words, with what was seen and what is to be known, and the attempts before."""
        text = OUTCOMES[self.outcome]
        if self.iterate is not None or self.history:
            text += f" after {len(self.history)} iterations by {self.method}"
        if self.history:
            # The last attempt is not always the one that is returned.
            last, it = self.history[-1], self.iterate
            slope, violation = last.stationarity, last.violation
            if it is not None:
                slope, violation = it.errors.stationarity, worst_condition(self.problem, it)[0]
            text += f": cost {self.cost:.8g}, gradient {slope:.1e}, violation {violation:.1e}"
        if not self.ok:
            text += f"; {self.reason}" if self.reason else ""
            text += f"; {ADVICE[self.outcome]}" if self.outcome in ADVICE else ""
        text += f"; {self.note}" if self.note else ""
        return text + "".join(f"\n  before that, {attempt}" for attempt in self.attempts)

    @checked("Solution.guess", steps=Whole(1))
    def guess(self, steps: int | None = None) -> Guess:
        """A guess for another problem, with the inputs resampled in time to another number of steps."""
        ends = ends_of(self.problem)
        return self._on(in_proportion(ends, steps or self.problem.steps))

    def guess_for(self, problem: OptimalControl) -> Guess:
        """A guess for a problem with other steps: with as many phases, what belongs to the same times."""
        if len(problem.phases) == len(self.problem.phases):
            return self._on(ends_of(problem))
        return self.guess(problem.steps)

    def _on(self, new: Ends) -> Guess:
        rates, old = None, ends_of(self.problem)
        systems, phases = self.problem.systems, self.problem.phases
        if self.iterate is not None and all(system.structure.solver == "reduced" for system in systems):
            rates = known_rates(self.problem, self.iterate.unknowns.y)
        free = [self.free[name] for name in self.problem.free] or None
        if rates is not None and self.problem.later:
            # Those of different systems are not of the same motions.
            pieces = zip(np.split(rates, np.cumsum(phases)[:-1]), in_phases(old), in_phases(new))
            rates = np.concatenate([interpolated(*piece) for piece in pieces])
        elif rates is not None:
            rates = interpolated(rates, old, new)
        return Guess(averaged(np.asarray(self.inputs), old, new), rates=rates, free=free)

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
    old, new = (np.linspace(0.0, 1.0, number + 1) for number in (len(inputs), count))
    return Guess(
        averaged(inputs, old, new),
        rates=None if rates is None else interpolated(rates, old, new),
        free=content["free"],
    )


@eager_numpy
def _missing(problem: OptimalControl, free: Array, states: State, inputs: Array) -> Float[Array, " n"]:
    return followed(problem, free, states, inputs)[2].missing


@compiled
def _missing_of_phases(problem: OptimalControl, free: Array, inputs: Array) -> Float[Array, " n"]:
    unknowns = Unknowns(fitted(problem, inputs), free, jnp.zeros((problem.steps, unknowns_each(problem))))
    return roll(problem, simulated(problem, unknowns, False)[0]).end.missing


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
    reason = seen(problem, iterate, outcome)
    code = int(outcome)
    return Solution(problem, inputs, names, dt, cost, code, method, iterate, unreachable, history, reason)
