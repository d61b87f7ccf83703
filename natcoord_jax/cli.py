"""The command line: `natcoord-jax scenes`, `natcoord-jax run SCENE` and `natcoord-jax accuracy SCENE`."""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import Trajectory

WHOLE = 1e-9
"""How far the number of steps may be from a whole number, relatively."""
FIGURES = (".png", ".pdf", ".svg")


class BadOptionError(ValueError):
    """An option that cannot be meant."""


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line and ends with code 2."""

    def error(self, message: str) -> NoReturn:
        """One line on stderr, exit code 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def parser() -> Parser:
    """The command line's options."""
    whole = Parser(prog="natcoord-jax", description="Differentiable multibody simulation: ready scenes.")
    commands = whole.add_subparsers(dest="command", required=True, parser_class=Parser)
    commands.add_parser("scenes", help="list the scenes of the gallery")
    run = commands.add_parser("run", help="simulate a scene and report its balances")
    run.add_argument("scene", metavar="SCENE", help="a name that `natcoord-jax scenes` lists")
    run.add_argument("--steps", type=int, help="number of steps; alone, it keeps the scene's end time")
    run.add_argument("--dt", type=float, help="step [s]; alone, it must divide the scene's end time")
    run.add_argument("--order", type=int, default=2, metavar="P", help="order of the scheme, 2 to 10")
    costs = commands.add_parser("accuracy", help="show what accuracy costs in time, over steps and orders")
    costs.add_argument("scene", metavar="SCENE", help="a name that `natcoord-jax scenes` lists")
    costs.add_argument("--time", type=float, metavar="T", help="end time [s]; by default that of the scene")
    costs.add_argument(
        "--orders", default="2,4,6,8,10", metavar="P,P", help="orders to compare, by default all from 2 to 10"
    )
    for command in (run, costs):
        command.add_argument("--json", type=Path, metavar="FILE", help="write the report as JSON")
        command.add_argument("--plot", type=Path, metavar="FILE", help="write a figure")
    return whole


def choose_steps(example: gallery.Example, steps: int | None, dt: float | None) -> tuple[int, float]:
    """Number of steps and step [s] of a run.

    Raises:
        BadOptionError: for numbers that are not positive, or a step that does not divide the end time.
    """
    if steps is not None and steps < 1:
        raise BadOptionError(f"--steps is {steps}; pass a positive integer")
    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise BadOptionError(f"--dt [s] is {dt:g}; pass a positive number")
    if dt is None:
        return (example.steps, example.dt) if steps is None else (steps, example.t_end / steps)
    if steps is not None:
        return steps, dt
    ratio = example.t_end / dt
    if round(ratio) < 1 or abs(ratio - round(ratio)) > WHOLE * ratio:
        raise BadOptionError(
            f"--dt {dt:g} s does not divide the end time {example.t_end:g} s of {example.name}; "
            "pass another step, or --steps as well"
        )
    return round(ratio), dt


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


def _solved(
    example: gallery.Example, steps: int, dt: float, scheme: nc.EnergyMomentum
) -> tuple[nc.Solution | None, Any]:
    """The solution of an optimal control problem, if the scene is one, and the inputs of the run."""
    if example.problem is None:
        return None, example.inputs(steps, dt, scheme)
    solution = nc.optimise(example.problem(steps, dt))
    return solution, solution.inputs


def measure(
    example: gallery.Example, steps: int, dt: float, scheme: nc.EnergyMomentum
) -> tuple[dict[str, Any], Trajectory, nc.Solution | None]:
    """Run a scene twice, the first time with compilation, and judge the run.

    Args:
        example: the scene.
        steps: number of steps.
        dt: step [s].
        scheme: the scheme.

    Returns:
        The report, the trajectory, and the solution of an optimal control problem.
    """
    system = example.system
    structure = system.structure
    solution, inputs = _solved(example, steps, dt, scheme)
    options = {"dt": dt, "inputs": inputs, "throw": False, "scheme": scheme}
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
        "energy_error_max": _largest(balance.energy),
        "momentum_error_max": _largest(balance.momentum),
        "momentum_components": balance.directions,
        "angular_momentum_error_max": _largest(balance.angular_momentum),
        "angular_momentum_components": balance.axes,
        "momentum_note": balance.note,
        "constraint_error_max": _largest(errors.position),
        "velocity_constraint_error_max": _largest(errors.velocity),
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


def _table(report: dict[str, Any]) -> str:
    """The report as aligned plain text."""
    r = report
    most = f"a step, at most {r['newton_iterations_max']}"
    parts = f"largest error, relative, of {r['momentum_components']} components"
    turns = f"largest error, relative, of {r['angular_momentum_components']} components"
    lines = [
        ("scene", r["scene"], ""),
        ("steps", f"{r['steps']}", f"of {r['dt']:.6g} s, to t = {r['t_end']:.6g} s, order {r['order']}"),
        ("degrees of freedom", f"{r['dofs']}", f"{r['unknowns']} unknowns, {r['constraints']} constraints"),
        ("Newton iterations", _number(r["newton_iterations_mean"]), most),
        ("wall time", f"{1e3 * r['wall_s']:.3g} ms", f"{1e6 * r['wall_s'] / r['steps']:.3g} µs a step"),
        ("compile time", f"{r['compile_s']:.3g} s", ""),
        ("energy", f"{r['energy_final']:.8g} J", f"from {r['energy_initial']:.8g} J"),
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


def _json_ready(value: Any) -> Any:
    """JSON has no infinities and no NaN: they become null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plot(
    example: gallery.Example, trajectory: Trajectory, solution: nc.Solution | None, file: Path | None
) -> Path | None:
    """Write the scene's own figure, or the curves of the run if a file is asked for."""
    if solution is not None:
        figure, file = nc.plot(solution), file or Path(f"{example.name}.png")
    elif example.figure is not None:
        figure, file = example.figure(), file or Path(f"{example.name}.png")
    elif file is not None:
        figure = nc.plot(example.system, trajectory)
    else:
        return None
    figure.savefig(file, dpi=150)
    return file


def _checked(arguments: argparse.Namespace) -> gallery.Example:
    """The scene, after a look at the files to write."""
    if arguments.scene not in gallery.SCENES:
        raise BadOptionError(f"no scene {arguments.scene!r}; there are {', '.join(gallery.SCENES)}")
    for file in (arguments.json, arguments.plot):
        if file is not None and not file.resolve().parent.is_dir():
            raise BadOptionError(f"cannot write {file}: no such folder")
    if arguments.plot is not None and arguments.plot.suffix.lower() not in FIGURES:
        raise BadOptionError(f"cannot write {arguments.plot}; a figure ends in {', '.join(FIGURES)}")
    return gallery.load(arguments.scene)


def _scheme(order: int) -> nc.EnergyMomentum:
    try:
        return nc.EnergyMomentum(order=order)
    except ValueError as problem:
        raise BadOptionError(f"--order: {problem}") from None


def _accuracy(arguments: argparse.Namespace) -> int:
    try:
        orders = [_scheme(int(part)).order for part in arguments.orders.split(",")]
    except ValueError as problem:
        raise BadOptionError(f"--orders is {arguments.orders!r}: {problem}") from None
    example = _checked(arguments)
    if example.problem is not None:
        raise BadOptionError(f"{example.name} is a problem of optimal control; pass another scene")
    t_end = example.t_end if arguments.time is None else arguments.time
    if not (math.isfinite(t_end) and t_end > 0):
        raise BadOptionError(f"--time [s] is {t_end:g}; pass a positive number")
    try:
        found = nc.accuracy(example.system, example.state, t_end, inputs=example.torques, orders=orders)
    except RuntimeError as problem:
        print(f"natcoord-jax: {example.name}: {problem}", file=sys.stderr)
        return 1
    print(f"{example.name}: {example.description}, to t = {t_end:g} s\n{found}")
    if arguments.json is not None:
        report = {"scene": example.name, **found.to_dict()}
        arguments.json.write_text(json.dumps(report, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if arguments.plot is not None:
        nc.plot(found).savefig(arguments.plot, dpi=150)
        print(f"wrote {arguments.plot}")
    return 0


def _run(arguments: argparse.Namespace) -> int:
    scheme = _scheme(arguments.order)
    example = _checked(arguments)
    steps, dt = choose_steps(example, arguments.steps, arguments.dt)
    report, trajectory, solution = measure(example, steps, dt, scheme)
    print(_table(report))
    if arguments.json is not None:
        ready = {key: _json_ready(value) for key, value in report.items()}
        arguments.json.write_text(json.dumps(ready, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if not Result(int(trajectory.result)).ok or (solution is not None and not solution.ok):
        print(f"natcoord-jax: {example.name}: {report['result']}", file=sys.stderr)
        return 1
    written = _plot(example, trajectory, solution, arguments.plot)
    if written is not None:
        print(f"wrote {written}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: those after the program's name; None: those of the process.

    Returns:
        The exit code: 0; 1 for a run that fails; 2 for an unknown scene or a bad option.
    """
    jax.config.update("jax_enable_x64", True)
    parsed = parser().parse_args(arguments)
    if parsed.command == "scenes":
        width = max(map(len, gallery.SCENES))
        print("\n".join(f"{name:<{width}}  {gallery.describe(name)}" for name in gallery.SCENES))
        return 0
    try:
        return _accuracy(parsed) if parsed.command == "accuracy" else _run(parsed)
    except BadOptionError as problem:
        print(f"natcoord-jax: {problem}", file=sys.stderr)
        return 2
