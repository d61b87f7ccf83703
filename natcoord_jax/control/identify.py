"""Identification: numbers of a system, and of its initial states, from what sensors have measured."""

import sys
from typing import Annotated, Any

import jax
import numpy as np

from natcoord_jax.control.fitting import At, Fit, Measurement, Scaling, finished, searched
from natcoord_jax.control.identified import Identified, concluded
from natcoord_jax.control.measurement import MEASURED, SENSORS, Predicted, Setting, of_one, predicted
from natcoord_jax.control.problem import PARAMETERS
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.side_by_side import side_by_side
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.closures import with_callables
from natcoord_jax.core.kinds import FLAG, Concrete, of
from natcoord_jax.core.numeric import Number, Vector, Whole
from natcoord_jax.core.state import STATE, State
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.checked import INPUTS, STEP, check_state, checked_inputs
from natcoord_jax.stepping.scheme import SCHEME, SECOND_ORDER, Scheme
from natcoord_jax.system import System

GUESS = of("values by name", dict) | of("what nc.identify(...) returned", Identified)


@checked()
def identify(
    system: Annotated[System, Concrete(SYSTEM)],
    state: Annotated[State, Concrete(STATE)],
    parameters: Annotated[Any, PARAMETERS],
    measured: Annotated[Any, Concrete(MEASURED)],
    sensors: Annotated[Any, SENSORS],
    *,
    dt: Annotated[Any, Concrete(STEP)],
    inputs: Annotated[Any, Concrete(INPUTS)] = None,
    guess: Annotated[Any, GUESS] = None,
    noise: Annotated[Any, Concrete(Number("positive") | Vector(None))] = None,
    save_every: Annotated[int, Whole(1)] = 1,
    starts: Annotated[int, Whole(1)] = 1,
    spread: Annotated[float, Concrete(Number("positive"))] = 1.0,
    seed: Annotated[int, Whole(0)] = 0,
    max_evaluations: Annotated[int, Whole(1)] = 100,
    scheme: Annotated[Scheme, SCHEME] = SECOND_ORDER,
    progress: Annotated[bool, FLAG] = False,
) -> Identified:
    """Find numbers of a system from measured motions, and how well they are known (output error method).

    The sum of squares of simulated less measured channels, each in units of its noise, is made small within
    bounds by the trust region method of Branch, Coleman and Li (1999) in `scipy.optimize.least_squares`, with
    exact derivatives. Positive unknowns whose bounds are far apart are searched for by their logarithms.

    Args:
        system: compiled system.
        state: state at the first sample; of several experiments stacked along a leading axis, or one for all.
        parameters: unknown numbers of the system (`nc.Parameter`) and of the initial state
            (`nc.InitialCoordinate`, `nc.InitialRate`, `nc.InitialState`), of which every experiment has its
            own. Bounds hold wherever it looks.
        measured: shape (samples, channels), or (experiments, samples, channels) of several at once. The first
            sample is at the initial state. NaN where a number is missing, as at the end of an experiment that
            is shorter than others.
        sensors: function (system, trajectory) -> (samples, channels), a joint (its coordinates), an
            `nc.Point` (its position), or several of them, whose channels follow each other.
        dt: step [s].
        inputs: as in `nc.simulate`, known; arrays of several experiments along a leading axis.
        guess: where the first search begins, values by name or an earlier `Identified`; what it does not name
            begins with `value` of the unknown, or as the system and the state have it.
        noise: standard deviation of the measured numbers, in their units, one for all or one for each
            channel. None: estimated from what is left of each channel, and channels are weighed by it.
        save_every: steps from sample to sample.
        starts: number of places where searches begin: the guess, then random ones, between bounds or about
            it. All searches go on at once, in one batch.
        spread: of random places of unknowns without two bounds: how many times the size, or, of logarithms,
            by what factor exp(spread).
        seed: of the random places.
        max_evaluations: how many points may be looked at from each start.
        scheme: of the simulation, as in `nc.simulate`.
        progress: print a line for each batch to stderr.

    Returns:
        What was found from the best start; `outcome` and `explain()` say how it ended. Where a simulation
        fails the point is refused and the step shortened. An interruption by the keyboard returns what was
        reached.

    Raises:
        ValueError: for shapes that do not fit, a channel without numbers, fewer numbers than unknowns, or
            a start outside of the bounds.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
        >>> spring = scene.add(nc.JointSpring(hinge, stiffness=5.0, rest=1.0, name="spring"))
        >>> system, state = scene.compile()
        >>> truth = nc.simulate(system.set("spring", stiffness=8.0), state, dt=0.05, steps=60)
        >>> measured = truth.states.coordinates + 0.01 * jax.random.normal(jax.random.key(0), (61, 1))
        >>> stiffness = nc.Parameter(
        ...     "stiffness", apply=lambda s, k: s.set("spring", stiffness=k), value=5.0, lower=0.1
        ... )
        >>> found = nc.identify(system, state, [stiffness], measured, hinge, dt=0.05)
        >>> low, high = found.interval(0.999)["stiffness"]
        >>> bool(low < 8.0 < high and high - low < 0.2)
        True
    """
    values = np.array(measured, float)
    values = values.reshape(-1, *(values.shape if values.ndim > 1 else (len(values), 1))[-2:])
    states = _states(system, state, len(values))
    steps = (values.shape[1] - 1) * save_every
    control, inputs = _inputs(system, inputs, len(values), steps, scheme)
    sensors = tuple(sensors) if isinstance(sensors, list | tuple) else (sensors,)
    setting = Setting(
        system, as_array(dt, float), tuple(sorted(parameters, key=lambda number: number.starts)),
        tuple(map(Function.of, sensors)), Function.of(control), steps, save_every, scheme,
    )  # fmt: skip
    scaling = Scaling.of(setting, states, guess.values if isinstance(guess, Identified) else guess or {})
    data = Measurement.of(values, setting.labels(*of_one((states, inputs), 0)), noise)
    if len(data.channel) <= len(scaling.names):
        raise ValueError(
            f"identify: measured has {len(data.channel)} numbers for {len(scaling.names)} unknowns, "
            f"{', '.join(scaling.names)}; measure more, or leave some out"
        )
    points = scaling.scattered(starts, spread, seed)
    lanes = jax.tree.map(lambda x: _repeated(x, starts, join=True), (states, inputs))

    def search(lean: Setting) -> tuple[Fit, np.ndarray, list[Fit]]:
        evaluate = _Evaluation(lean, lanes, data, scaling, progress)
        return _best(evaluate, points, max_evaluations)

    # What functions compute is looked at once, and not for every point: that takes longer than a simulation.
    found = with_callables(predicted, search, (setting.lean(),))
    return concluded(setting, scaling, data, states, *found)


class _Evaluation:
    """What belongs to points, one for each start, from one batch of simulations."""

    def __init__(
        self, setting: Setting, lanes: tuple[State, Any], data: Measurement, scaling: Scaling, progress: bool
    ) -> None:
        self.setting, self.lanes, self.data, self.scaling = setting, lanes, data, scaling
        self.progress, self.count = progress, 0

    def __call__(self, points: np.ndarray) -> list[At]:
        """What is missed at each point, and its derivatives."""
        data, scaling, experiments = self.data, self.scaling, len(self.data.values)
        values = np.concatenate([scaling.by_experiment(z, experiments) for z in points])
        found = jax.tree.map(np.asarray, predicted(self.setting, *self.lanes, as_array(values)))
        parts = [slice(k * experiments, (k + 1) * experiments) for k in range(len(points))]
        ats = [
            At.of(z, data, scaling, Predicted(*(x[part] for x in found))) for z, part in zip(points, parts)
        ]
        self.count += 1
        if self.progress:
            sigma = data.sigma[data.channel]
            least = min(np.sum((at.missed / sigma) ** 2) / 2 if at.sound else np.inf for at in ats)
            print(f"evaluation {self.count}: least cost {least:.8g}", file=sys.stderr, flush=True)
        return ats


def _best(evaluate: _Evaluation, points: np.ndarray, most: int) -> tuple[Fit, np.ndarray, list[Fit]]:
    """The best of the searches from all points, with the noise of each channel, and how all have ended."""
    data, scaling = evaluate.data, evaluate.scaling
    sigma, first = data.sigma[data.channel], evaluate(points)
    runs = {k: lambda ask, at=at: searched(ask, at, scaling, sigma, most) for k, at in enumerate(first)}
    found = side_by_side(evaluate, points, runs)
    fits = [found[k] for k in range(len(points))]
    best = min(range(len(fits)), key=lambda k: (fits[k].cost, k))
    fit = fits[best]
    if not np.isfinite(fit.cost) or fit.outcome is Outcome.STOPPED:
        return fit, data.sigma, fits
    run = {best: lambda ask: finished(ask, fit, scaling, data, most)}
    return *side_by_side(evaluate, points, run)[best], fits


def _states(system: System, state: State, experiments: int) -> State:
    """Initial states of all experiments.

    Raises:
        ValueError: for another number of them, or states of another system.
    """
    if state.t.ndim == 0:
        check_state(system, state)
        return jax.tree.map(lambda x: _repeated(x, experiments), state)
    if state.t.shape != (experiments,):
        raise ValueError(
            f"identify: state has the leading axes {state.t.shape}, and measured {experiments} experiments; "
            "pass as many states as experiments, or one for all"
        )
    state = jax.tree.map(as_array, state)
    check_state(system, of_one(state, 0))
    return state


def _inputs(system: System, inputs: Any, experiments: int, steps: int, scheme: Scheme) -> tuple[Any, Any]:
    """Inputs as a function, or as arrays of all experiments; None and None: there are none.

    Raises:
        ValueError: for a shape that does not fit.
    """
    if inputs is None or callable(inputs):
        return inputs, None
    array = as_array(inputs, float)
    if array.ndim > 2 and array.shape[:2] == (experiments, steps):
        checked_inputs(system, array[0], steps, scheme.stages)
        return None, array
    array, _ = checked_inputs(system, array, steps, scheme.stages)
    return None, _repeated(array, experiments)


def _repeated(array: Any, times: int, join: bool = False) -> Any:
    """An array along a new leading axis so many times, or the same along the first one that it has."""
    array = np.asarray(array)
    return as_array(
        np.concatenate([array] * times) if join else np.broadcast_to(array, (times, *array.shape))
    )
