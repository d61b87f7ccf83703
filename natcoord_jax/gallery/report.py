"""A run of a scene with everything there is to say about it: time, energy, momenta, constraints."""

import time
from typing import Any

import jax
import numpy as np

import natcoord_jax as nc
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import Trajectory
from natcoord_jax.gallery.example import Example
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.scheme import Scheme


def _timed(run: Any) -> tuple[nc.Phases, float]:
    start = time.perf_counter()
    phases = jax.block_until_ready(run())
    return phases, time.perf_counter() - start


def _completed(trajectory: Trajectory) -> Trajectory:
    """The part of a trajectory before the step that failed."""
    steps = trajectory.t.shape[0] - 1
    done = steps if Result(int(trajectory.result)).ok else min(int(trajectory.failed_step), steps)
    states = jax.tree.map(lambda x: x[: done + 1], trajectory.states)
    return nc.Trajectory(**(vars(trajectory) | {"states": states, "inputs": trajectory.inputs[:done]}))


def _largest(values: Any) -> float | None:
    """Largest of all numbers of several arrays; None where there is none."""
    known = [float(np.max(x)) for x in values if x is not None]
    return max(known) if known else None


def measure(
    example: Example,
    steps: int,
    dt: float,
    scheme: Scheme,
    tolerance: Tolerance | None = None,
) -> tuple[dict[str, Any], nc.Phases, nc.Solution | None]:
    """Run a scene twice, the first time with compilation, and judge the run.

    Args:
        example: the scene.
        steps: number of steps.
        dt: step [s].
        scheme: the scheme.
        tolerance: error that a substep may have; None: steps are made as they are.

    Returns:
        The report, the run, and the solution of an optimal control problem.
    """
    solution = None
    options: dict[str, Any] = {"throw": False, "scheme": scheme}
    if example.phases is None:
        solution = example.solved(steps, dt)
        options["inputs"] = example.inputs(steps, dt, scheme) if solution is None else solution.inputs
    if tolerance is not None:
        options |= {"rtol": tolerance.relative, "atol": tolerance.absolute}
    before = nc.set_effort("full")  # times are to be those of programs that run for long
    try:
        _, first = _timed(lambda: example.run(steps, dt, **options))
        phases, wall = _timed(lambda: example.run(steps, dt, **options))
    finally:
        nc.set_effort(before)
    report = {
        "scene": example.name,
        "steps": steps,
        "dt": dt,
        "scheme": type(scheme).__name__,
        "order": scheme.order,
        "t_end": steps * dt,
        "compile_s": first - wall,
        "wall_s": wall,
        **_judged(phases),
    }
    if solution is None:
        return report, phases, None
    report["cost"] = solution.cost
    report["iterations"] = len(solution.history)
    report["goal_error_max"] = max((abs(x) for x in solution.missing.values()), default=0.0)
    if not solution.ok and report["result"] == "successful":
        report["result"] = solution.explain()
    return report, phases, solution


def _judged(phases: nc.Phases) -> dict[str, Any]:
    """What a run is like: its size, iterations, balances of each phase, and how it ended."""
    structure, runs = phases.systems[-1].structure, phases.trajectories
    valid = nc.Phases(phases.systems, tuple(_completed(run) for run in runs))
    total, last = np.asarray(valid.energy().total), valid.trajectories[-1]
    balances = [nc.balance(*pair) for pair in valid.pairs]
    errors = [system.constraint_errors(run) for system, run in valid.pairs]
    changed = [one is not other for one, other in zip(phases.systems, phases.systems[1:])]
    taken = sum(int(run.steps_taken) for run in runs)
    ended = Result(int(runs[-1].result))
    return {
        "dofs": structure.dofs,
        "unknowns": structure.unknowns + structure.multipliers,
        "constraints": structure.constraints,
        "newton_iterations_mean": sum(int(run.iterations) for run in runs) / max(taken, 1),
        "newton_iterations_max": max(int(run.iterations_max) for run in runs),
        "energy_initial": float(total[0]),
        "energy_final": float(total[-1]),
        "energy_lost_at_changes": [float(x) for x, changes in zip(valid.losses(), changed) if changes],
        "dissipated": None if last.states.dissipated is None else float(last.states.dissipated[-1]),
        "energy_error_max": _largest([b.energy for b in balances]),
        "momentum_error_max": _largest([b.momentum for b in balances]),
        "momentum_components": min(b.directions for b in balances),
        "angular_momentum_error_max": _largest([b.angular_momentum for b in balances]),
        "angular_momentum_components": min(b.axes for b in balances),
        "momentum_note": balances[-1].note,
        "constraint_error_max": _largest([e.position for e in errors]),
        "velocity_constraint_error_max": _largest([e.velocity for e in errors]),
        "substeps": taken,
        "substeps_rejected": sum(int(run.steps_rejected) for run in runs),
        "steps_completed": sum(run.t.shape[0] - 1 for run in valid.trajectories),
        "result": "successful" if ended == Result.SUCCESSFUL else phases.systems[-1].explain(runs[-1]),
    }


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def table(report: dict[str, Any]) -> str:
    """The report as aligned plain text."""
    r = report
    most = f"a step in all attempts, at most {r['newton_iterations_max']} in one"
    parts = f"largest error, relative, of {r['momentum_components']} components"
    turns = f"largest error, relative, of {r['angular_momentum_components']} components"
    parts_made = f"{r['substeps_rejected']} attempts repeated in shorter ones"
    lines = [
        ("scene", r["scene"], ""),
        ("steps", f"{r['steps']}", f"of {r['dt']:.6g} s, to t = {r['t_end']:.6g} s, order {r['order']}"),
        *[("substeps", f"{r['substeps']}", parts_made)] * (r["substeps"] > r["steps"]),
        ("degrees of freedom", f"{r['dofs']}", f"{r['unknowns']} unknowns, {r['constraints']} constraints"),
        ("Newton iterations", _number(r["newton_iterations_mean"]), most),
        ("wall time", f"{1e3 * r['wall_s']:.3g} ms", f"{1e6 * r['wall_s'] / r['steps']:.3g} µs a step"),
        ("compile time", f"{r['compile_s']:.3g} s", ""),
        ("energy", f"{r['energy_final']:.8g} J", f"from {r['energy_initial']:.8g} J"),
        *[
            ("change of joints", f"{loss:.3g} J", "lost in the impact")
            for loss in r["energy_lost_at_changes"]
        ],
        *[("dissipated", _number(r["dissipated"]), "J, numerically")] * (r["dissipated"] is not None),
        ("energy balance", _number(r["energy_error_max"]), "largest error, relative"),
        ("momentum balance", _number(r["momentum_error_max"]), parts),
        ("angular momentum balance", _number(r["angular_momentum_error_max"]), turns),
        ("constraints", _number(r["constraint_error_max"]), "largest error [m, -]"),
        ("constraint velocities", _number(r["velocity_constraint_error_max"]), "largest error [m/s, 1/s]"),
        *_solution_lines(r),
        ("result", r["result"], ""),
    ]
    width, middle = max(len(a) for a, _, _ in lines), max(len(b) for _, b, _ in lines[:-1])
    text = [f"{a:<{width}}  {b:>{middle}}  {c}".rstrip() for a, b, c in lines[:-1]]
    text.append(f"{lines[-1][0]:<{width}}  {lines[-1][1]}")
    return "\n".join([*text, f"({r['momentum_note']})"] if r["momentum_note"] else text)


def _solution_lines(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What a solved problem adds to the table."""
    if "cost" not in report:
        return []
    return [
        ("cost", f"{report['cost']:.8g}", f"optimal control, {report['iterations']} iterations"),
        ("goal", _number(report["goal_error_max"]), "largest residual"),
    ]
