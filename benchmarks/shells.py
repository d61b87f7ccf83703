"""A cantilever plate that falls under its weight, by number of elements, beside Kratos, on one core.

usage: python -m benchmarks.shells [--quick] [--peers-python PATH] [--output FOLDER]

A plate of 1 m x 1 m x 10 mm of soft rubber (E 10 MPa) is held along one side and let go: 100 steps of 1 ms,
in which it bends by some 50 mm. Times are those of the processor. Time per step, compile time of value and
gradient (of the sum of squares of the final velocities, by all numbers of the system), energy balance, and
the middle of the free edge at the end. With `--peers-python`, the Python of an environment with
kratosmultiphysics, kratosstructuralmechanicsapplication and kratoslinearsolversapplication, the same with
Kratos: thick corotational quadrilaterals, Newmark's rule, its sparse LU. Kratos tells no energy of these.
"""

import json
import subprocess
import time
from typing import Any

import jax
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled

SIZES, QUICK_SIZES = (8, 16, 32), (4,)
DT = 1e-3  # [s]
COLUMNS = {
    "elements": ("elements", ""),
    "us_per_step": ("us a step", ".0f"),
    "compile_s": ("compile s", ".1f"),
    "newton_iterations_mean": ("iterations", ".1f"),
    "energy_balance": ("energy", ".1e"),
    "tip_z": ("tip z m", ".6f"),
}


def plate(count: int) -> tuple[nc.System, nc.State, Any]:
    """The plate, and the node in the middle of its free edge."""
    scene = nc.Scene()
    soft = nc.Elastic(E=1e7, nu=0.3, density=1000.0)
    mesh = nc.mesh.rectangle((1.0, 1.0), (count, count))
    shell = scene.add(nc.Shell(mesh, thickness=0.01, material=soft, name="plate"))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    scene.add(nc.Gravity())
    return *scene.compile(), shell.nearest((1.0, 0.5, 0.0))


def measure(count: int, steps: int, repeats: int, gradient: bool) -> dict[str, Any]:
    """Time, compile time and conservation on count x count elements."""
    start = time.perf_counter()
    system, state, tip = plate(count)
    built = time.perf_counter() - start
    run = compiled.Rollout(system, state, np.zeros((steps, 0)), DT)
    # Compile time is waited for; steps are those of the processor, which others on the machine disturb less.
    waited = common.seconds(run.run)
    timing = common.timed(run.run, steps, repeats, time.process_time)
    trajectory = run.run()
    found = {
        "elements": f"{count} x {count}",
        "unknowns": system.structure.unknowns,
        **run.about,
        **timing,
        "build_s": built,
        "newton_iterations_mean": int(trajectory.iterations) / int(trajectory.steps_taken),
        "energy_balance": float(np.max(nc.balance(system, trajectory).energy)),
        "tip_z": float(system.sense(trajectory, tip).position[-1, 2]),
        "result": "successful" if int(trajectory.result) == 0 else system.explain(trajectory),
    }
    found["compile_s"] = waited - 1e-6 * timing["us_per_step"] * steps
    if gradient:
        value, both, _, _ = run.loss("system")
        waited = common.seconds(both)
        _, whole = common.timed_in_turn((value, both), steps, repeats, time.process_time)
        found["gradient_ratio"] = whole["over_first"]
        found["gradient_compile_s"] = waited - 1e-6 * whole["us_per_step"] * steps
    return found


def kratos(python: str, count: int, steps: int) -> dict[str, Any] | None:
    """The same with Kratos; None if it is not there."""
    command = [python, str(common.ROOT / "benchmarks" / "peers" / "kratos_plate.py")]
    done = subprocess.run(
        [*command, str(count), str(steps), str(DT)], capture_output=True, text=True, check=False
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if not lines:
        print(f"Kratos, {count} x {count}: {done.stderr.strip().splitlines()[-1:]}")
        return None
    found = json.loads(lines[0].removeprefix("RESULT "))
    return {"elements": f"{count} x {count}", "tip_z": found["tip"][2], **found}


def exponent(runs: list[dict[str, Any]]) -> float | None:
    """Slope of log(time) over log(unknowns), from 16 x 16 elements on."""
    some = [r for r in runs if r["unknowns"] > 1000]
    if len(some) < 2:
        return None
    size, cost = (np.log([r[key] for r in some]) for key in ("unknowns", "us_per_step"))
    return float(np.polyfit(size, cost, 1)[0])


def targets(runs: list[dict[str, Any]], peers: list[dict[str, Any]], slope: float | None) -> list[dict]:
    """What was to be reached."""
    last = runs[-1]
    same = next((p for p in peers if p["elements"] == last["elements"]), None)
    over = None if same is None else 1e-6 * last["us_per_step"] / same["s_per_step"]
    gradients = [r["gradient_compile_s"] for r in runs if "gradient_compile_s" in r]
    ratios = [r["gradient_ratio"] for r in runs if "gradient_ratio" in r]
    return [
        common.target(f"time a step over that of Kratos, {last['elements']}", over, 0.25),
        common.target("compile time of the value", max(r["compile_s"] for r in runs), 20.0, "s"),
        common.target("compile time of the gradient", max(gradients, default=None), 45.0, "s"),
        common.target("value and gradient over value", max(ratios, default=None), 3.0),
        common.target("exponent of the time in the unknowns", slope, 1.3),
        common.target("energy balance", max(r["energy_balance"] for r in runs), 1e-11),
    ]


def main() -> None:
    """Run the benchmark."""
    options = common.peer_parser("A falling plate, beside Kratos.", "nothing").parse_args()
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("shells", quick=options.quick)
    sizes, steps, repeats = (QUICK_SIZES, 10, 1) if options.quick else (SIZES, 100, 2)
    runs, peers = [], []
    for count in sizes:
        runs.append(measure(count, steps, repeats, gradient=count == sizes[0]))
        print(f"{count} x {count}: {runs[-1]['us_per_step']:.0f} us a step", flush=True)
        found = None if options.no_peers else kratos(options.peers_python, count, steps)
        if found:
            peers.append(found)
            print(
                f"  Kratos: {1e6 * found['s_per_step']:.0f} us a step, tip {found['tip_z']:.6f} m", flush=True
            )
    slope = exponent(runs)
    results |= {"runs": runs, "kratos": peers, "exponent": slope, "targets": targets(runs, peers, slope)}
    print(f"\n{common.environment_line(results)}\n\n{common.columns(runs, COLUMNS)}\n")
    print(common.show_targets(results["targets"]))
    common.write(results, None, common.folder(options))


if __name__ == "__main__":
    main()
