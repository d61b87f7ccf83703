"""What accuracy costs in time: errors, times and drifts of one scene over steps and orders."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.assembly.system import System
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.stepping.endpoint import Endpoint, endpoints
from natcoord_jax.stepping.scheme import EnergyMomentum

ORDERS = (2, 4, 6, 8, 10)
TARGETS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
FIRST = 8
"""Steps of the coarsest run."""
FINEST = 1 << 18
"""Steps of the finest run."""
FLAT = 3.0
"""An error within this factor of that of the reference says nothing more."""
FALLING = 0.7
"""An error above this part of that with twice the step does not fall."""

Quantities = Mapping[str, Callable[[State], Array]]


@dataclass(frozen=True)
class Row:
    """One run.

    Attributes:
        order: of the scheme.
        steps: number of steps.
        error: of the first quantity at the end time, against the reference, in its own unit.
        errors: of all quantities, by name.
        wall_s: median time of the run, compiled [s].
        newton: Newton iterations per step.
        drift: energy at the end less energy at the start and work, relative to the energies involved.
        result: "successful", or why the run ended early.
        note: why the error does not fall any more, or "".
    """

    order: int
    steps: int
    error: float
    errors: dict[str, float]
    wall_s: float
    newton: float
    drift: float
    result: str = "successful"
    note: str = ""


@dataclass(frozen=True)
class Accuracy:
    """Errors and times of a scene over steps and orders.

    Attributes:
        t_end: end time [s].
        rows: one a run, by order and number of steps.
        reference_error: of the reference: the largest difference between two fine runs of the highest order,
            and between those of two orders.
        reference: order and steps of the reference.
        compile_s: time of compilation by order [s], not part of any other time.
        targets: errors that `cheapest` is printed for.
    """

    t_end: float
    rows: tuple[Row, ...]
    reference_error: float
    reference: tuple[int, int]
    compile_s: dict[int, float]
    targets: tuple[float, ...] = field(default=TARGETS)

    def cheapest(self, error: float) -> Row | None:
        """The fastest run with at most this error; None if there is none, or the reference is no better."""
        good = [r for r in self.rows if r.result == "successful" and r.error <= error]
        return min(good, key=lambda r: r.wall_s) if good and error >= self.reference_error else None

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        cheapest = {f"{target:g}": self.cheapest(target) for target in self.targets}
        return {
            "t_end": self.t_end,
            "rows": [asdict(row) for row in self.rows],
            "compile_s": sum(self.compile_s.values()),
            "compile_s_by_order": {str(k): v for k, v in self.compile_s.items()},
            "reference_error": self.reference_error,
            "reference": {"order": self.reference[0], "steps": self.reference[1]},
            "cheapest": {k: row and {"order": row.order, "steps": row.steps} for k, row in cheapest.items()},
        }

    def __str__(self) -> str:
        widths = {"order": 5, "steps": 7, "error": 9, "time": 10, "µs/step": 8, "Newton": 6, "drift": 8}
        lines = [" ".join(f"{name:>{width}}" for name, width in widths.items())]
        for r in self.rows:
            said = r.note if r.result == "successful" else r.result
            lines.append(
                f"{r.order:>5} {r.steps:>7} {r.error:>9.2g} {1e3 * r.wall_s:>7.3g} ms "
                f"{1e6 * r.wall_s / r.steps:>8.3g} {r.newton:>6.2f} {r.drift:>8.1g}  {said}".rstrip()
            )
        lines.append(f"reference: order {self.reference[0]}, {self.reference[1]} steps, "
                     f"good to {self.reference_error:.1g}")  # fmt: skip
        lines.append("compiled in " + ", ".join(f"{s:.1f} s (order {k})" for k, s in self.compile_s.items()))
        for target in self.targets:
            best = self.cheapest(target)
            found = f"order {best.order}, {best.steps} steps, {1e3 * best.wall_s:.3g} ms" if best else "none"
            lines.append(f"cheapest for an error of {target:g}: {found}")
        return "\n".join(lines)


def _default_quantities() -> Quantities:
    return {"positions": lambda state: state.q, "velocities": lambda state: state.v}


def _difference(quantities: Quantities, one: State, other: State) -> dict[str, float]:
    found = {name: jnp.max(jnp.abs(f(one) - f(other))) for name, f in quantities.items()}
    return {name: float(x) if np.isfinite(float(x)) else math.inf for name, x in found.items()}


def drift(system: System, start: State, end: State) -> float:
    """Energy at the end less energy at the start and work, relative to the energies involved."""
    before, after = system.energy(start), system.energy(end)
    work = end.work - start.work
    scale = max(
        float(e.kinetic) + sum(float(abs(x)) for x in e.stores.values()) for e in (before, after)
    ) + float(jnp.sum(jnp.abs(work)))
    error = abs(float(after.total - before.total - jnp.sum(work)))
    return error / scale if scale > 0 else 0.0


class _Runs:
    """Runs of one scene, compiled once an order."""

    def __init__(self, system: System, state: State, t_end: float, inputs: Callable | None):
        self.system, self.state, self.t_end, self.inputs = system, state, t_end, inputs
        self.compile_s: dict[int, float] = {}
        self.programs: dict[int, Callable[[Any, int], Endpoint]] = {}

    def __call__(self, order: int, steps: int) -> Endpoint:
        if order not in self.programs:
            scheme = EnergyMomentum(order=order)
            self.programs[order] = endpoints(self.system, self.state, inputs=self.inputs, scheme=scheme)
            # The first run compiles; its own time is that of the second.
            first, second = self.timed(order, 1), self.timed(order, 1)
            self.compile_s[order] = max(first - second, 0.0)
        return jax.block_until_ready(self.programs[order](self.t_end / steps, steps))

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


def accuracy(
    system: System,
    state: State,
    t_end: float,
    *,
    inputs: Callable[[Array], Array] | None = None,
    quantities: Quantities | None = None,
    orders: Sequence[int] = ORDERS,
    steps: Sequence[int] | None = None,
    targets: Sequence[float] = TARGETS,
    repeats: int = 5,
    limit_s: float = 0.2,
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
    if not (math.isfinite(t_end) and t_end > 0):
        raise ValueError(f"t_end [s] is {t_end}; pass a positive finite time")
    if not orders:
        raise ValueError("orders is empty; pass some of 2, 4, 6, 8, 10")
    measured, runs = quantities or _default_quantities(), _Runs(system, state, float(t_end), inputs)
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
            note = ""
            if error <= FLAT * reference_error:
                note = "as good as the reference"
            elif error > FALLING * last and code.ok:
                note = "round-off" if error <= 1e3 * reference_error else "does not fall"
            wall = runs.median(order, count, repeats)
            rows.append(
                Row(
                    order, count, error, errors, wall,
                    int(found.iterations) / max(int(found.substeps), 1),
                    drift(system, state, found.state),
                    "successful" if code == Result.SUCCESSFUL else code.name.lower(),
                    note,
                )
            )  # fmt: skip
            last = error if code.ok else math.inf
            if not steps and (wall > limit_s or note in ("as good as the reference", "round-off")):
                break
            count *= 2
    return Accuracy(float(t_end), tuple(rows), reference_error, made, runs.compile_s, tuple(targets))
