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


def _timed(run: Any) -> tuple[Trajectory, float]:
    start = time.perf_counter()
    trajectory = jax.block_until_ready(run())
    return trajectory, time.perf_counter() - start


def _completed(trajectory: Trajectory) -> Trajectory:
    """The part of a trajectory before the step that failed."""
    steps = trajectory.t.shape[0] - 1
    done = steps if Result(int(trajectory.result)).ok else min(int(trajectory.failed_step), steps)
    states = jax.tree.map(lambda x: x[: done + 1], trajectory.states)
    return nc.Trajectory(**(vars(trajectory) | {"states": states, "inputs": trajectory.inputs[:done]}))


def _largest(values: Any) -> float | None:
    return None if values is None else float(np.max(values))


def _solved(example: Example, steps: int, dt: float, scheme: Scheme) -> tuple[nc.Solution | None, Any]:
    """The solution of an optimal control problem, if the scene is one, and the inputs of the run."""
    if example.problem is None:
        return None, example.inputs(steps, dt, scheme)
    solution = nc.optimise(example.problem(steps, dt))
    return solution, solution.inputs


def measure(
    example: Example,
    steps: int,
    dt: float,
    scheme: Scheme,
    tolerance: Tolerance | None = None,
) -> tuple[dict[str, Any], Trajectory, nc.Solution | None]:
    """Run a scene twice, the first time with compilation, and judge the run.

    Args:
        example: the scene.
        steps: number of steps.
        dt: step [s].
        scheme: the scheme.
        tolerance: error that a substep may have; None: steps are made as they are.

    Returns:
        The report, the trajectory, and the solution of an optimal control problem.
    """
    system = example.system
    structure = system.structure
    solution, inputs = _solved(example, steps, dt, scheme)
    options = {"dt": dt, "inputs": inputs, "throw": False, "scheme": scheme}
    if tolerance is not None:
        options |= {"rtol": tolerance.relative, "atol": tolerance.absolute}
    _, first = _timed(lambda: nc.simulate(system, example.state, **options))
    trajectory, wall = _timed(lambda: nc.simulate(system, example.state, **options))
    valid = _completed(trajectory)
    energy, errors = np.asarray(system.energy(valid).total), system.constraint_errors(valid)
    balance = nc.balance(system, valid)
    result = Result(int(trajectory.result))
    report = {
        "scene": example.name,
        "steps": steps,
        "dt": dt,
        "scheme": type(scheme).__name__,
        "order": scheme.order,
        "t_end": steps * dt,
        "dofs": structure.dofs,
        "unknowns": structure.unknowns + structure.multipliers,
        "constraints": structure.constraints,
        "newton_iterations_mean": int(trajectory.iterations) / max(int(trajectory.steps_taken), 1),
        "newton_iterations_max": int(trajectory.iterations_max),
        "compile_s": first - wall,
        "wall_s": wall,
        "energy_initial": float(energy[0]),
        "energy_final": float(energy[-1]),
        "dissipated": None if valid.states.dissipated is None else float(valid.states.dissipated[-1]),
        "energy_error_max": _largest(balance.energy),
        "momentum_error_max": _largest(balance.momentum),
        "momentum_components": balance.directions,
        "angular_momentum_error_max": _largest(balance.angular_momentum),
        "angular_momentum_components": balance.axes,
        "momentum_note": balance.note,
        "constraint_error_max": _largest(errors.position),
        "velocity_constraint_error_max": _largest(errors.velocity),
        "substeps": int(trajectory.steps_taken),
        "substeps_rejected": int(trajectory.steps_rejected),
        "steps_completed": valid.t.shape[0] - 1,
        "result": "successful" if result == Result.SUCCESSFUL else system.explain(trajectory),
    }
    if solution is None:
        return report, trajectory, None
    report["cost"] = solution.cost
    report["iterations"] = len(solution.history)
    report["goal_error_max"] = max((abs(x) for x in solution.missing.values()), default=0.0)
    if not solution.ok and result.ok:
        report["result"] = solution.explain()
    return report, trajectory, solution


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
