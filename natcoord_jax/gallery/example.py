"""What a scene of the gallery consists of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.system import System


@dataclass(frozen=True)
class Example:
    """A ready scene with a sensible run.

    Attributes:
        name: name in the gallery.
        description: one line.
        system: compiled system.
        state: initial state.
        dt: step of the suggested run [s].
        steps: number of steps of the suggested run.
        control: inputs as a function of the mid-times (steps,) [s] of the steps, shape (steps, inputs)
            [N, N m]; None: no inputs, or all zero.
        facts: what is known of the scene, by name: exact values, published numbers, useful handles.
        figure: draws the scene's own figure of a run, which the command line writes unasked; None: it has
            none.
        problem: the optimal control problem, for (steps, dt), whose solution are the inputs; None: they are
            given by `control`.
        guess: inputs that the solution of a problem starts from, for the problem; None: zero.
        phases: makes the run, for (steps, dt) and options of `nc.simulate`, where it is more than a rollout
            with given inputs; `system` and `state` are then those of its start.
        beams: whose sections pictures draw.
        traces: points whose paths pictures draw.
        within: corners of the box that pictures look into (2, 3) [m]; None: they show all.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> from natcoord_jax import gallery
        >>> example = gallery.load("pendulum")
        >>> trajectory = example.simulate(steps=10, dt=0.01)
        >>> trajectory.q.shape
        (11, 4, 3)
    """

    name: str
    description: str
    system: System
    state: State
    dt: float
    steps: int
    control: Callable[[Float[Array, " steps"]], Float[Array, "steps inputs"]] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    figure: Callable[[nc.Phases], Any] | None = None
    problem: Callable[[int, float], nc.OptimalControl] | None = None
    guess: Callable[[nc.OptimalControl], Array] | None = None
    phases: Callable[..., nc.Phases] | None = None
    beams: Sequence[nc.BeamHandle] = ()
    traces: Sequence[Any] = ()
    within: Any = None

    @property
    def t_end(self) -> float:
        """End time of the suggested run [s]."""
        return self.steps * self.dt

    @property
    def torques(self) -> Callable[[Array], Array] | None:
        """Inputs as a function of one time [s], None where there are none."""
        return None if self.control is None else self._at

    def _at(self, t: Float[Array, ""]) -> Float[Array, " inputs"]:
        assert self.control is not None
        return self.control(t[None])[0]

    def inputs(
        self, steps: int | None = None, dt: Any = None, scheme: Scheme | None = None
    ) -> Float[Array, "steps inputs"] | Float[Array, "steps stages inputs"]:
        """Inputs of a run with other steps; default the suggested one.

        They are those at mid-steps, held; with a scheme of several stages, those at its stages.

        Raises:
            RuntimeError: for an optimal control problem that is not solved.
        """
        steps, dt = steps or self.steps, self.dt if dt is None else dt
        if self.problem is not None:
            solution = self.solved(steps, float(dt), progress=False)
            assert solution is not None
            if not solution.ok:
                raise RuntimeError(f"{self.name}: {solution.explain()}")
            return solution.inputs
        if self.control is None:
            return jnp.zeros((steps, len(self.system.structure.inputs)))
        if scheme is not None and scheme.stages > 1:
            times = scheme.times(dt, steps)
            return self.control(times.reshape(-1)).reshape(*times.shape, -1)
        return self.control((jnp.arange(steps) + 0.5) * dt)

    def solved(self, steps: int, dt: float, *, progress: bool = True) -> nc.Solution | None:
        """The solution of the scene's problem of optimal control; None where it has none."""
        if self.problem is None:
            return None
        problem = self.problem(steps, dt)
        return nc.optimise(problem, self.guess and self.guess(problem), progress=progress)

    def simulate(self, *, steps: int | None = None, dt: Any = None, **options: Any) -> Trajectory:
        """One rollout with the scene's inputs, as far as it has any; `options` go to `nc.simulate`."""
        steps, dt = steps or self.steps, self.dt if dt is None else dt
        return nc.simulate(self.system, self.state, dt=dt, inputs=self.inputs(steps, dt), **options)

    def run(self, steps: int | None = None, dt: Any = None, **options: Any) -> nc.Phases:
        """The suggested run, in one phase or several; `options` go to `nc.simulate`."""
        steps, dt = steps or self.steps, self.dt if dt is None else dt
        if self.phases is not None:
            return self.phases(steps, float(dt), **options)
        if "inputs" not in options:
            options["inputs"] = self.inputs(steps, dt)
        return nc.Phases((self.system,), (nc.simulate(self.system, self.state, dt=dt, **options),))
