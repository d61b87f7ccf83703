"""The command line: `natcoord-jax scenes`, `natcoord-jax run SCENE` and `natcoord-jax accuracy SCENE`."""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.results import Result
from natcoord_jax.gallery.report import measure, table
from natcoord_jax.stepping.error_control import Tolerance
from natcoord_jax.stepping.scheme import Scheme

WHOLE = 1e-9
"""How far the number of steps may be from a whole number, relatively."""
SCHEMES = ("energy-momentum", "variational", "dissipative")
FIGURES = (".png", ".pdf", ".svg")
FILMS = (".gif", ".mp4", ".html")


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
    whole.add_argument("--version", action="version", version=f"natcoord-jax {nc.__version__}")
    commands = whole.add_subparsers(dest="command", required=True, parser_class=Parser)
    commands.add_parser("scenes", help="list the scenes of the gallery")
    run = commands.add_parser("run", help="simulate a scene and report its balances")
    run.add_argument("scene", metavar="SCENE", help="a name that `natcoord-jax scenes` lists")
    run.add_argument("--steps", type=int, help="number of steps; alone, it keeps the scene's end time")
    run.add_argument("--dt", type=float, help="step [s]; alone, it must divide the scene's end time")
    run.add_argument("--scheme", choices=SCHEMES, default=SCHEMES[0], metavar="NAME", help=", ".join(SCHEMES))
    run.add_argument("--order", type=int, metavar="P", help="order of energy-momentum, 2 to 10; by default 2")
    run.add_argument(
        "--spectral-radius", type=float, metavar="R", help="of the dissipative scheme, 0 to 1; by default 0.8"
    )
    run.add_argument("--rtol", type=float, metavar="R", help="error tolerated in a substep, relative")
    run.add_argument("--atol", type=float, metavar="A", help="the same in metres; by default as --rtol")
    run.add_argument("--film", type=Path, metavar="FILE", help="write a film: .gif, .mp4 or .html")
    run.add_argument(
        "--view",
        action="store_true",
        help="write SCENE.html, to be turned and played, and open it",
    )
    costs = commands.add_parser("accuracy", help="show what accuracy costs in time, over steps and orders")
    costs.add_argument("scene", metavar="SCENE", help="a name that `natcoord-jax scenes` lists")
    costs.add_argument("--time", type=float, metavar="T", help="end time [s]; by default that of the scene")
    costs.add_argument(
        "--orders", default="2,4,6,8,10", metavar="P,P", help="orders to compare, by default all from 2 to 10"
    )
    for command in (run, costs):
        command.add_argument("--json", type=Path, metavar="FILE", help="write the report as JSON")
        command.add_argument("--plot", type=Path, metavar="FILE", help="write a figure")
        command.add_argument(
            "--keep-programs",
            action=argparse.BooleanOptionalAction,
            default=True,
            help="keep compiled programs for the next time, in the cache folder of this user",
        )
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


def _json_ready(value: Any) -> Any:
    """JSON has no infinities and no NaN: they become null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plot(
    example: gallery.Example, phases: nc.Phases, solution: nc.Solution | None, file: Path | None
) -> Path | None:
    """Write the scene's own figure, or the curves of the run if a file is asked for."""
    if solution is not None:
        figure, file = nc.plot(solution), file or Path(f"{example.name}.png")
    elif example.figure is not None:
        figure, file = example.figure(phases), file or Path(f"{example.name}.png")
    elif file is not None:
        figure = nc.plot(phases)
    else:
        return None
    figure.savefig(file, dpi=150)
    return file


def _checked(arguments: argparse.Namespace) -> gallery.Example:
    """The scene, after a look at the files to write."""
    scene = arguments.scene.replace("-", "_")
    if scene not in gallery.SCENES:
        raise BadOptionError(f"no scene {arguments.scene!r}; there are {', '.join(gallery.SCENES)}")
    film = getattr(arguments, "film", None)
    if film is not None and film.suffix.lower() not in FILMS:
        raise BadOptionError(f"cannot write {film}; a film ends in {', '.join(FILMS)}")
    for file in (arguments.json, arguments.plot, film):
        if file is not None and not file.resolve().parent.is_dir():
            raise BadOptionError(f"cannot write {file}: no such folder")
    if arguments.plot is not None and arguments.plot.suffix.lower() not in FIGURES:
        raise BadOptionError(f"cannot write {arguments.plot}; a figure ends in {', '.join(FIGURES)}")
    return gallery.load(scene)


def _scheme(order: int) -> nc.EnergyMomentum:
    try:
        return nc.EnergyMomentum(order=order)
    except ValueError as problem:
        raise BadOptionError(f"--order: {problem}") from None


def choose_scheme(name: str, order: int | None, spectral_radius: float | None) -> Scheme:
    """The scheme of a run.

    Raises:
        BadOptionError: for a number that the scheme does not take.
    """
    if order is not None and name != "energy-momentum":
        raise BadOptionError(f"--order is {order}, but the {name} scheme is of order 2; leave it out")
    if spectral_radius is not None and name != "dissipative":
        raise BadOptionError("--spectral-radius belongs to the dissipative scheme; pass --scheme dissipative")
    if name == "variational":
        return nc.VariationalMidpoint()
    if name == "energy-momentum":
        return _scheme(2 if order is None else order)
    if spectral_radius is None:
        return nc.Dissipative()
    try:
        return nc.Dissipative(spectral_radius=spectral_radius)
    except ValueError as problem:
        raise BadOptionError(f"--spectral-radius: {problem}") from None


def _accuracy(arguments: argparse.Namespace) -> int:
    try:
        orders = [_scheme(int(part)).order for part in arguments.orders.split(",")]
    except ValueError as problem:
        raise BadOptionError(f"--orders is {arguments.orders!r}: {problem}") from None
    example = _checked(arguments)
    if example.problem is not None:
        raise BadOptionError(f"{example.name} is a problem of optimal control; pass another scene")
    if example.phases is not None:
        raise BadOptionError(f"{example.name} is a run in several phases; pass another scene")
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
    scheme = choose_scheme(arguments.scheme, arguments.order, arguments.spectral_radius)
    example = _checked(arguments)
    steps, dt = choose_steps(example, arguments.steps, arguments.dt)
    try:
        tolerance = Tolerance.of(arguments.rtol, arguments.atol)
    except ValueError as problem:
        raise BadOptionError(str(problem)) from None
    report, phases, solution = measure(example, steps, dt, scheme, tolerance)
    print(table(report))
    if arguments.json is not None:
        ready = {key: _json_ready(value) for key, value in report.items()}
        arguments.json.write_text(json.dumps(ready, indent=2, ensure_ascii=False) + "\n", "utf-8")
    ended = Result(int(phases.trajectories[-1].result))
    if not ended.ok or (solution is not None and not solution.ok):
        print(f"natcoord-jax: {example.name}: {report['result']}", file=sys.stderr)
        return 1
    written = [_plot(example, phases, solution, arguments.plot)]
    if arguments.film is not None:
        nc.animate(phases, file=arguments.film, **_drawn(example))
        written.append(arguments.film)
    if arguments.view:
        written.append(Path(f"{example.name}.html"))
        nc.view(phases, file=written[-1], **_drawn(example))
    for file in filter(None, written):
        print(f"wrote {file}")
    if arguments.view:
        from natcoord_jax.viz.views import open_file  # matplotlib comes with it

        open_file(Path(f"{example.name}.html"))
    return 0


def _drawn(example: gallery.Example) -> dict[str, Any]:
    """How a scene is drawn."""
    drawn = {"beams": example.beams, "traces": example.traces, "within": example.within}
    return {"title": example.description, **drawn}


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
    # (Where the environment names a folder of JAX's own, that is meant.)
    if parsed.keep_programs and not jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        nc.keep_programs()
    try:
        return _accuracy(parsed) if parsed.command == "accuracy" else _run(parsed)
    except BadOptionError as problem:
        print(f"natcoord-jax: {problem}", file=sys.stderr)
        return 2
