"""What accuracy costs in time: errors, times and drifts of one scene over steps and orders."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.analysis.accuracy_table import TARGETS, Accuracy, Row
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import FunctionOf, Several, of
from natcoord_jax.core.numeric import Number, Vector, Whole
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import STATE, State
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.endpoint import Endpoint, endpoints
from natcoord_jax.stepping.scheme import ORDER, EnergyMomentum
from natcoord_jax.system import System

ORDERS = (2, 4, 6, 8, 10)
FIRST = 8
"""Steps of the coarsest run."""
FINEST = 1 << 18
"""Steps of the finest run."""
FLAT = 3.0
"""An error within this factor of that of the reference says nothing more."""
FALLING = 0.7
"""An error above this part of that with twice the step does not fall."""
ROUND_OFF = 1e3
"""An error within this factor of that of the reference that does not fall is made by rounding."""
SAMPLES = 32
"""Times at which the balance of energy of a run is looked at."""

Quantities = Mapping[str, Callable[[State], Array]]


DEFAULT: Quantities = {"positions": lambda state: state.q, "velocities": lambda state: state.v}


def _difference(quantities: Quantities, one: State, other: State) -> dict[str, float]:
    found = {name: jnp.max(jnp.abs(f(one) - f(other))) for name, f in quantities.items()}
    return {name: float(x) if np.isfinite(float(x)) else math.inf for name, x in found.items()}


def drift(system: System, *states: State) -> float:
    """Largest change of energy less work since the first of the states, relative to the energies involved."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    energy, work = system.energy(stacked), np.asarray(stacked.work - stacked.work[0])
    sizes = [np.abs(x) for x in (energy.kinetic, *energy.stores.values())]
    scale = np.max(np.sum(sizes, axis=0) + np.sum(np.abs(work), axis=-1))
    balance = np.asarray(energy.total) - np.sum(work, axis=-1)
    error = float(np.max(np.abs(balance - balance[0])))
    return 0.0 if scale == 0 else error / float(scale)


def note_of(error: float, before: float, reference_error: float) -> str:
    """Why an error does not fall any more, or "".

    Args:
        error: of a run.
        before: of that with twice the step; infinite if there is none.
        reference_error: of the reference.
    """
    if error <= FLAT * reference_error:
        return "as good as the reference"
    if error <= FALLING * before:
        return ""
    return "round-off" if error <= ROUND_OFF * reference_error else "does not fall"


class _Runs:
    """Runs of one scene, compiled once an order."""

    def __init__(self, system: System, state: State, t_end: float, inputs: Callable | None):
        self.system, self.state, self.t_end, self.inputs = system, state, t_end, inputs
        self.compile_s: dict[int, float] = {}
        self.programs: dict[int, Callable[[Any, int], Endpoint]] = {}

    def __call__(self, order: int, steps: int) -> Endpoint:
        if order not in self.programs:
            self.programs[order] = self.from_state(order, self.state)
            # The first run compiles; its own time is that of the second.
            first, second = self.timed(order, 1), self.timed(order, 1)
            self.compile_s[order] = max(first - second, 0.0)
        return jax.block_until_ready(self.programs[order](self.t_end / steps, steps))

    def from_state(self, order: int, state: State) -> Callable[[Any, int], Endpoint]:
        return endpoints(self.system, state, inputs=self.inputs, scheme=EnergyMomentum(order=order))

    def drift(self, order: int, steps: int) -> float:
        """Largest error of the balance of energy, by a run in parts."""
        ends, states = np.linspace(0, steps, min(steps, SAMPLES) + 1).astype(int), [self.state]
        for count in np.diff(ends):
            found = self.from_state(order, states[-1])(self.t_end / steps, int(count))
            states.append(found.state)
            if not Result(int(found.result)).ok:
                break
        return drift(self.system, *states)

    def timed(self, order: int, steps: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(self.programs[order](self.t_end / steps, steps))
        return time.perf_counter() - start

    def median(self, order: int, steps: int, repeats: int) -> float:
        return float(np.median([self.timed(order, steps) for _ in range(repeats)]))


def _reference(runs: _Runs, quantities: Quantities, orders: Sequence[int]) -> tuple[State, float, tuple]:
    """The end of the finest run that is worth its while, its error, its order and steps."""
    order = max(orders)
    steps, before, last = 4 * FIRST, None, math.inf
    while True:
        found = runs(order, steps)
        if before is not None and int(found.result) == 0:
            now = max(_difference(quantities, found.state, before).values())
            if now > FALLING * last or steps >= FINEST:
                break
            last = now
        before = found.state if int(found.result) == 0 else None
        if steps >= FINEST:
            break
        steps *= 2
    # The run before the differences stopped falling is the one with the least round-off.
    best, steps = (before, steps // 2) if before is not None and last < math.inf else (found.state, steps)
    error = last if last < math.inf else max(_difference(quantities, found.state, best).values())
    others = [k for k in sorted(orders) if k < order]
    if others:
        other = _extrapolated(runs, others[-1], min(2 * steps, FINEST // 2))
        error = max(error, *_difference(quantities, other, best).values())
    return best, error, (order, steps)


def _extrapolated(runs: _Runs, order: int, steps: int) -> State:
    """End of two runs by Richardson's formula, so that a lower order can judge a higher one."""
    coarse, fine = runs(order, steps).state, runs(order, 2 * steps).state
    return jax.tree.map(lambda x, y: y + (y - x) / (2.0**order - 1.0), coarse, fine)


@checked()
def accuracy(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    t_end: Annotated[float, Number("positive")],
    *,
    inputs: Annotated[
        Callable[[Array], Array] | None, FunctionOf("of time [s] to the inputs (inputs,)")
    ] = None,
    quantities: Annotated[
        Quantities | None, of("a dictionary of functions of the end state, by name", Mapping)
    ] = None,
    orders: Annotated[Sequence[int], Several(ORDER, 1)] = ORDERS,
    steps: Annotated[Sequence[int] | None, Several(Whole(1), 1)] = None,
    targets: Annotated[Sequence[float], Vector(None)] = TARGETS,
    repeats: Annotated[int, Whole(1)] = 5,
    limit_s: Annotated[float, Number("positive")] = 0.2,
) -> Accuracy:
    """What accuracy costs in time: run a scene over a range of steps and orders.

    The reference is made by the highest order: steps are halved until the end state changes no more, and
    the run is compared with the next lower order, extrapolated by Richardson's formula.

    Args:
        system: compiled system.
        state: initial state, with velocities that obey the constraints.
        t_end: length of the runs [s].
        inputs: function of time [s] to (inputs,) [N, N m], evaluated at the stages; None: zero.
        quantities: functions of the end state whose errors count, by name; the first one decides. Default:
            positions and directors [m, -], then their velocities.
        orders: of the schemes.
        steps: numbers of steps; None: from 8 on, doubled until errors fall no more or a run takes `limit_s`.
        targets: errors for which the cheapest run is named.
        repeats: runs whose median time counts.
        limit_s: time [s] of the longest run.

    Returns:
        The rows, the reference's own error and the times of compilation; printing it gives a table,
        `nc.plot` a figure.

    Raises:
        ValueError: for an end time or orders that make no sense.
        RuntimeError: if not even the reference can be computed.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> found = nc.accuracy(system, state, 2.0, orders=(2, 4), steps=(10, 20), repeats=1)
        >>> 3.5 < found.rows[0].error / found.rows[1].error < 4.5
        True
    """
    measured, runs = quantities or DEFAULT, _Runs(system, state, float(t_end), inputs)
    best, reference_error, made = _reference(runs, measured, orders)
    if not math.isfinite(reference_error):
        raise RuntimeError(
            f"no reference: the run of order {made[0]} fails even with {made[1]} steps over {t_end:g} s; "
            "simulate the scene first, see what it says, and shorten t_end"
        )
    rows: list[Row] = []
    for order in sorted(orders):
        last, count, given = math.inf, FIRST, iter(steps or ())
        while True:
            count = next(given, None) if steps else count
            if count is None or count > FINEST:
                break
            found = runs(order, count)
            code = Result(int(found.result))
            errors = _difference(measured, found.state, best)
            error = next(iter(errors.values()))
            note = note_of(error, last, reference_error) if code.ok else ""
            wall = runs.median(order, count, repeats)
            rows.append(
                Row(
                    order, count, error, errors, wall,
                    int(found.iterations) / max(int(found.substeps), 1),
                    runs.drift(order, count),
                    "successful" if code == Result.SUCCESSFUL else code.name.lower(),
                    note,
                )
            )  # fmt: skip
            last = error if code.ok else math.inf
            if not steps and (wall > limit_s or note in ("as good as the reference", "round-off")):
                break
            count *= 2
    return Accuracy(float(t_end), tuple(rows), reference_error, made, runs.compile_s, tuple(targets))
