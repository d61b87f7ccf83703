"""Time per step of chains and binary trees of 4 to 256 bodies, on one core.

usage: python -m benchmarks.scaling [--quick] [--output FOLDER] [--redraw JSON]

Scenes of the gallery, compiled as everybody's are. A time is the median of runs of the compiled rollout,
every step saved; compile seconds are those of the first call, in a process without a cache of programs. The
exponent is the slope of a straight line fitted to log(time) over log(bodies) from 32 bodies on.
"""

from typing import Any

import jax
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled
from natcoord_jax import gallery

SCENES = ("chain", "binary_tree")
SIZES = (4, 8, 16, 32, 64, 128, 256)
QUICK_SIZES = (4, 32, 64)
FIT_FROM = 32  # [bodies]
DT = 0.005  # [s]


def measure(scene: str, bodies: int, steps: int, repeats: int) -> dict[str, Any]:
    """Time, compile time and balances of one scene of one size."""
    example: Any = None

    def build():
        nonlocal example
        example = gallery.load(scene, bodies=bodies)

    built = common.seconds(build)
    rollout = compiled.Rollout(example.system, example.state, example.inputs(steps, DT), DT)
    timing = common.timed(rollout.run, steps, repeats)
    trajectory = rollout.run()
    errors = example.system.constraint_errors(trajectory)
    structure = example.system.structure
    return {
        "scene": scene,
        "bodies": bodies,
        "unknowns": structure.unknowns,
        "solver": structure.solver,
        **rollout.about,
        **timing,
        "us_per_step_and_body": timing["us_per_step"] / bodies,
        "build_s": built,
        "newton_iterations_mean": int(trajectory.iterations) / int(trajectory.steps_taken),
        "energy_balance": float(np.max(nc.balance(example.system, trajectory).energy)),
        "constraint_error": float(np.max(errors.position)),
        "result": "successful" if int(trajectory.result) == 0 else example.system.explain(trajectory),
    }


def exponent(runs: list[dict[str, Any]], scene: str) -> float | None:
    """Slope of log(time per step) over log(bodies) from `FIT_FROM` on; None: fewer than two sizes."""
    own = [r for r in runs if r["scene"] == scene and r["bodies"] >= FIT_FROM]
    points = [(r["bodies"], r["us_per_step"]) for r in own]
    if len(points) < 2:
        return None
    x, y = np.log(points).T
    return float(np.polyfit(x, y, 1)[0])


def targets(runs: list[dict[str, Any]], exponents: dict[str, float | None]) -> list[dict[str, Any]]:
    """The issue's targets next to what was measured."""
    lines = [common.target(f"{s}: exponent from {FIT_FROM} bodies on", exponents[s], 1.15) for s in SCENES]
    for scene in SCENES:
        slowest = max(r["compile_s"] for r in runs if r["scene"] == scene)
        lines.append(common.target(f"{scene}: longest compile time", slowest, 5.0, "s"))
    return lines


COLUMNS = {
    "scene": ("scene", ""),
    "bodies": ("bodies", "d"),
    "solver": ("solver", ""),
    "us_per_step": ("µs/step", ".1f"),
    "us_per_step_and_body": ("µs/step/body", ".2f"),
    "newton_iterations_mean": ("Newton", ".1f"),
    "compile_s": ("compile s", ".2f"),
    "energy_balance": ("energy", ".0e"),
    "result": ("result", ""),
}


def draw(results: dict[str, Any]) -> Any:
    """Time per step and compile time over the number of bodies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    speed, compiling = figure.subplots(1, 2)
    for scene in SCENES:
        runs = [r for r in results["runs"] if r["scene"] == scene]
        x = [r["bodies"] for r in runs]
        slope = results["exponents"][scene]
        label = scene if slope is None else f"{scene}, exponent {slope:.2f} from {FIT_FROM} on"
        speed.loglog(x, [r["us_per_step"] for r in runs], "o-", label=label)
        compiling.semilogx(x, [r["compile_s"] for r in runs], "o-", label=scene)
    first = results["runs"][0]
    x = [r["bodies"] for r in results["runs"]]
    ends = np.array([min(x), max(x)])
    speed.loglog(ends, first["us_per_step"] * ends / ends[0], "k:", lw=1, label="proportional")
    compiling.axhline(5.0, color="k", ls=":", lw=1, label="target")
    for axes, title in ((speed, "time per step [µs]"), (compiling, "compile time [s]")):
        axes.set(xlabel="bodies", title=title)
        axes.set_xticks(sorted(set(x)), [str(n) for n in sorted(set(x))], minor=False)
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend()
    compiling.set_ylim(bottom=0)
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    options = common.parser("Time per step over the number of bodies.", "the figure").parse_args()
    if options.redraw:
        common.redraw(options.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("scaling", quick=options.quick)
    sizes, steps, repeats = (QUICK_SIZES, 20, 5) if options.quick else (SIZES, 100, 15)
    runs = []
    for scene in SCENES:
        for bodies in sizes:
            runs.append(measure(scene, bodies, steps, repeats))
            print(f"{scene} {bodies}: {runs[-1]['us_per_step']:.1f} µs a step", flush=True)
    exponents = {scene: exponent(runs, scene) for scene in SCENES}
    results |= {"runs": runs, "exponents": exponents, "targets": targets(runs, exponents)}
    print(f"\n{common.environment_line(results)}\n\n{common.columns(runs, COLUMNS)}\n")
    print(common.show_targets(results["targets"]))
    common.write(results, draw, common.folder(options))


if __name__ == "__main__":
    main()
