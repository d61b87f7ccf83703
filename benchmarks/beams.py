"""A rope and a cantilever by number of elements, beside Exudyn and PyElastica, on one core.

usage: python -m benchmarks.beams [--quick] [--peers-python PATH] [--output FOLDER] [--redraw JSON]

1. Time per step and element for 8 to 512 elements, compile time, and value and gradient beside the value
   alone (the final velocities by all numbers of the system). The exponent is the slope of log(time) over
   log(elements) from 32 elements on.
2. With `--peers-python`, the Python of an environment with exudyn and pyelastica: the same with Exudyn, and
   the least time for half a second of motion (one for the cantilever) with an error of the tip below 1 % of
   the length, over elements and steps, of each code. The error is that against a fine run of this code,
   beside which the finest runs of the others stand in the JSON.
"""

import json
import subprocess
from typing import Any

import jax
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled
from natcoord_jax import gallery

SCENES = ("rope", "cantilever")
SIZES = (8, 16, 32, 64, 128, 256, 512)
QUICK_SIZES = (8,)
FIT_FROM = 32
DT = {"rope": 1e-3, "cantilever": 2e-3}  # [s]
T_END = {"rope": 0.5, "cantilever": 1.0}  # [s]
FINE = {"rope": (128, 2000), "cantilever": (128, 2000)}
ERROR = 0.01  # [m], of a length of one
PATIENCE = 120.0  # [s] for the repeats of one setting of a peer: some never get there
GRIDS = {
    "natcoord_jax": ((4, 8, 16, 32), {"rope": (50, 100, 200, 400), "cantilever": (50, 100, 200, 400)}),
    "exudyn": ((4, 8, 16, 32), {"rope": (50, 100, 200, 400), "cantilever": (50, 100, 200, 400)}),
    "elastica": ((8, 16, 32, 64), {"rope": (500, 1000, 2000, 4000), "cantilever": (160000, 320000)}),
}


def tip(example: gallery.Example, trajectory: nc.Trajectory) -> np.ndarray:
    """Place of the end at the end [m]."""
    return np.asarray(example.system.sense(trajectory, example.facts["beam"].end).position[-1])


def rollout(scene: str, elements: int, steps: int, dt: float) -> tuple[gallery.Example, compiled.Rollout]:
    """A scene and its compiled rollout."""
    example = gallery.load(scene, elements=elements)
    return example, compiled.Rollout(example.system, example.state, example.inputs(steps, dt), dt)


def measure(scene: str, elements: int, steps: int, repeats: int, gradient: bool) -> dict[str, Any]:
    """Time, compile time and conservation of one scene with so many elements."""
    example: Any = None

    def build():
        nonlocal example
        example = gallery.load(scene, elements=elements)

    built = common.seconds(build)
    run = compiled.Rollout(example.system, example.state, example.inputs(steps, DT[scene]), DT[scene])
    timing = common.timed(run.run, steps, repeats)
    trajectory = run.run()
    found = {
        "scene": scene,
        "elements": elements,
        "solver": example.system.structure.solver,
        **run.about,
        **timing,
        "us_per_step_and_element": timing["us_per_step"] / elements,
        "build_s": built,
        "newton_iterations_mean": int(trajectory.iterations) / int(trajectory.steps_taken),
        "energy_balance": float(np.max(nc.balance(example.system, trajectory).energy)),
        "result": "successful" if int(trajectory.result) == 0 else example.system.explain(trajectory),
    }
    if gradient:
        value, both, _, _ = run.loss("system")
        _, whole = common.timed_in_turn((value, both), steps, repeats)
        found["gradient_ratio"] = whole["over_first"]
        found["gradient_compile_s"] = whole["compile_s"]
    return found


def peer(
    python: str, code: str, scene: str, elements: int, steps: int, t_end: float
) -> dict[str, Any] | None:
    """One run of a peer, in its own environment; None if it takes longer than `PATIENCE`."""
    command = [python, "-m", "benchmarks.peers.beam_models", code, scene]
    command += [str(elements), str(steps), str(t_end), "3"]
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "cwd": common.ROOT}
    try:
        done = subprocess.run(command, timeout=PATIENCE, **options)
    except subprocess.TimeoutExpired:
        print(f"{code}, {scene}, {elements} elements, {steps} steps: given up after {PATIENCE:.0f} s")
        return None
    return json.loads(done.stdout.strip().splitlines()[-1])


def own_error(scene: str, elements: int, steps: int, reference: np.ndarray) -> dict[str, Any]:
    """Time and error of the tip of one setting of this code."""
    example, run = rollout(scene, elements, steps, T_END[scene] / steps)
    timing = common.timed(run.run, steps, 5)
    error = float(np.max(np.abs(tip(example, run.run()) - reference)))
    wall = 1e-6 * timing["us_per_step"] * steps
    return {"code": "natcoord_jax", "elements": elements, **run.about, "wall_s": wall, "error": error}


def comparison(scene: str, python: str, quick: bool) -> dict[str, Any]:
    """Least time for an error of the tip below `ERROR`, of every code."""
    elements, steps = (32, 500) if quick else FINE[scene]
    example, run = rollout(scene, elements, steps, T_END[scene] / steps)
    reference = tip(example, run.run())
    every: list[dict[str, Any]] = []
    for code, (sizes, counts) in GRIDS.items():
        for elements in sizes[:2] if quick else sizes:
            for steps in counts[scene][:2] if quick else counts[scene]:
                if code == "natcoord_jax":
                    every.append(own_error(scene, elements, steps, reference))
                    continue
                found = peer(python, code, scene, elements, steps, T_END[scene])
                if found is None:
                    continue
                error = float(np.max(np.abs(np.array(found["tip"]) - reference)))
                # An explicit run with steps too long is anywhere.
                every.append({**found, "tip": None, "error": error if np.isfinite(error) else 1e9})
    best = {}
    for code in GRIDS:
        good = [r for r in every if r["code"] == code and r["error"] < ERROR]
        best[code] = min(good, key=lambda r: r["wall_s"]) if good else None
    return {"scene": scene, "reference": list(reference), "runs": every, "best": best}


def exponent(runs: list[dict[str, Any]], scene: str) -> float | None:
    """Slope of log(time per step) over log(elements) from `FIT_FROM` on; None: fewer than two sizes."""
    points = [
        (r["elements"], r["us_per_step"]) for r in runs if r["scene"] == scene and r["elements"] >= FIT_FROM
    ]
    if len(points) < 2:
        return None
    x, y = np.log(points).T
    return float(np.polyfit(x, y, 1)[0])


def targets(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The issue's targets next to what was measured."""
    runs, lines = results["runs"], []
    for scene in SCENES:
        own = [r for r in runs if r["scene"] == scene]
        lines.append(common.target(f"{scene}: exponent", results["exponents"][scene], 1.15))
        lines.append(
            common.target(f"{scene}: longest compile time", max(r["compile_s"] for r in own), 15.0, "s")
        )
        ratios = [r["gradient_ratio"] for r in own if "gradient_ratio" in r]
        lines.append(common.target(f"{scene}: gradient over value", max(ratios) if ratios else None, 2.5))
        there = {r["elements"]: r["us_per_step"] for r in results["exudyn"] if r["scene"] == scene}
        pairs = [r["us_per_step"] / there[r["elements"]] for r in own if r["elements"] in {64} & set(there)]
        ratio = pairs[0] if pairs else None
        lines.append(common.target(f"{scene}: time over Exudyn's, 64 elements", ratio, 1 / 3))
    for found in results["comparisons"]:
        best = found["best"]
        ratio = None
        if best["natcoord_jax"] and best["elastica"]:
            ratio = best["natcoord_jax"]["wall_s"] / best["elastica"]["wall_s"]
        lines.append(common.target(f"{found['scene']}: time over PyElastica's at 1 % error", ratio, 1.0))
    return lines


COLUMNS = {
    "scene": ("scene", ""),
    "elements": ("elements", "d"),
    "us_per_step": ("µs/step", ".1f"),
    "us_per_step_and_element": ("µs/step/element", ".2f"),
    "newton_iterations_mean": ("Newton", ".1f"),
    "compile_s": ("compile s", ".1f"),
    "build_s": ("build s", ".1f"),
    "energy_balance": ("energy", ".0e"),
    "result": ("result", ""),
}


def draw(results: dict[str, Any]) -> Any:
    """Time per step over elements, and error over time."""
    from matplotlib.figure import Figure

    comparisons = results["comparisons"]
    figure = Figure(figsize=(5 * (1 + len(comparisons)), 4.5), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, 1 + len(comparisons)))
    for scene in SCENES:
        for source, marker in ((results["runs"], "o-"), (results["exudyn"], "s--")):
            runs = [r for r in source if r["scene"] == scene]
            label = scene if marker == "o-" else f"{scene}, Exudyn"
            axes[0].loglog(
                [r["elements"] for r in runs], [r["us_per_step"] for r in runs], marker, label=label
            )
    axes[0].set(xlabel="elements", title="time per step [µs]")
    for found, ax in zip(comparisons, axes[1:], strict=True):
        for code in GRIDS:
            runs = [r for r in found["runs"] if r["code"] == code]
            ax.loglog([r["wall_s"] for r in runs], [r["error"] for r in runs], "o", label=code)
        ax.axhline(ERROR, color="k", ls=":", lw=1)
        ax.set(xlabel="time [s]", title=f"{found['scene']}: error of the tip [m]")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.legend()
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    options = common.peer_parser(
        "Beams by number of elements, beside other codes.", "the figure"
    ).parse_args()
    if options.redraw:
        common.redraw(options.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("beams", quick=options.quick)
    python = None if options.no_peers else options.peers_python
    sizes, steps, repeats = (QUICK_SIZES, 20, 3) if options.quick else (SIZES, 100, 7)
    runs: list[dict[str, Any]] = []
    exudyn: list[dict[str, Any]] = []
    for scene in SCENES:
        for elements in sizes:
            runs.append(measure(scene, elements, steps, repeats, elements in (16, 64)))
            print(f"{scene} {elements}: {runs[-1]['us_per_step']:.0f} µs a step", flush=True)
            if python and elements <= 256:
                t_end = steps * DT[scene]
                found = peer(python, "exudyn", scene, elements, steps, t_end)
                exudyn += [found | {"scene": scene, "elements": elements}] if found else []
    results |= {
        "runs": runs,
        "exudyn": exudyn,
        "exponents": {scene: exponent(runs, scene) for scene in SCENES},
        "comparisons": [comparison(scene, python, options.quick) for scene in SCENES] if python else [],
    }
    results["targets"] = targets(results)
    print(f"\n{common.environment_line(results)}\n\n{common.columns(runs, COLUMNS)}\n")
    print(common.show_targets(results["targets"]))
    common.write(results, draw, common.folder(options))


if __name__ == "__main__":
    main()
