"""A block that falls from rest, clamped at one end: time a step and energy beside Kratos and CalculiX.

usage: python -m benchmarks.solids [--quick] [--output FOLDER] [--peers-python PATH] [--no-peers]

Bricks of 8 x 2 x 2 to 24 x 6 x 6, E = 1 MPa, nu = 0.3, 1000 kg/m^3, 1 x 1/4 x 1/4 m, 100 steps of 1 ms.
Kratos (`pip install KratosStructuralMechanicsApplication KratosLinearSolversApplication
KratosConstitutiveLawsApplication`) takes the trapezoidal rule, neo-Hookean bricks, consistent masses and its
sparse LU, and stops at relative corrections of 1e-6; CalculiX (`apt install calculix-ccx`) the same rule,
masses and material with its bricks C3D8; ours, neo-Hookean or with enhanced strains, have lumped masses and
stop at round-off. Times are those of the process on one core, of CalculiX those of the whole run.
`energy_balance` is relative to the largest kinetic energy.
"""

import json
import subprocess
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled

DT, STEPS = 1e-3, 100
PEERS = Path(__file__).parent / "peers"
MATERIALS = {
    "neo-Hooke": nc.NeoHooke(E=1e6, nu=0.3, density=1000.0),
    "enhanced strains": nc.Elastic(E=1e6, nu=0.3, density=1000.0),
}


def build(refinement: int, material: Any) -> tuple[nc.System, nc.State, int]:
    """The block, and the number of the node in the middle of its free end."""
    scene = nc.Scene()
    mesh = nc.mesh.box((1.0, 0.25, 0.25), (8 * refinement, 2 * refinement, 2 * refinement))
    block = scene.add(nc.Solid(mesh, material=material, name="block"))
    scene.add(nc.Clamp(nc.ground, block.set("x0")))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    return system, state, system.body_index(block.nearest((1.0, 0.125, 0.125)))


def measure(refinement: int, name: str, repeats: int) -> dict[str, Any]:
    """Ours: times, energy, and where the tip is."""
    began = time.perf_counter()
    system, state, tip = build(refinement, MATERIALS[name])
    built = time.perf_counter() - began
    rollout = compiled.Rollout(system, state, jnp.zeros((STEPS, 0)), DT)
    timing = common.timed(rollout.run, STEPS, repeats, time.process_time)
    trajectory = rollout.run()
    energy = system.energy(trajectory)
    total, kinetic = np.asarray(energy.total), np.asarray(energy.kinetic)
    return {
        "code": f"natcoord_jax, {name}",
        "mesh": f"{8 * refinement} x {2 * refinement} x {2 * refinement}",
        "unknowns": system.structure.unknowns,
        **rollout.about,
        "build_s": built,
        "newton_iterations_mean": int(trajectory.iterations) / max(int(trajectory.steps_taken), 1),
        "energy_balance": float(np.ptp(total) / kinetic.max()),
        "tip": float(trajectory.q[-1, 4 * tip, 2]) - 0.125,
        "result": "successful" if int(trajectory.result) == 0 else system.explain(trajectory),
        **timing,
    }


def gradient(refinement: int, name: str) -> dict[str, Any]:
    """Ours: value and gradient of the height of the tip by Young's modulus."""
    system, state, tip = build(refinement, MATERIALS[name])

    @jax.jit
    def height(modulus):
        changed = system.set("block", E=modulus)
        return nc.simulate(changed, state, dt=DT, steps=STEPS).q[-1, 4 * tip, 2]

    both = jax.jit(jax.value_and_grad(height))
    calls = [lambda f=f: jax.block_until_ready(f(jnp.asarray(1e6))) for f in (height, both)]
    value, found = common.timed_in_turn(calls, STEPS, 1, time.process_time)
    return {
        "mesh": f"{8 * refinement} x {2 * refinement} x {2 * refinement}",
        "code": f"natcoord_jax, {name}",
        **common.about(DT, STEPS),
        "value_compile_s": value["compile_s"],
        "gradient_compile_s": found["compile_s"],
        "over_value": found["over_first"],
    }


def peer(name: str, refinement: int, python: str) -> dict[str, Any] | None:
    """Kratos or CalculiX, in a process of its own on the same core; None if it is not there."""
    command = [python, str(PEERS / f"{name}_block.py"), str(refinement), str(STEPS)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [x for x in run.stdout.splitlines() if x.startswith("{")]
    if not lines:
        print(f"{name}: {run.stderr.strip().splitlines()[-1:]}")
        return None
    mesh = f"{8 * refinement} x {2 * refinement} x {2 * refinement}"
    return {**json.loads(lines[0]), "mesh": mesh, "result": "successful"}


def targets(runs: list[dict[str, Any]], gradients: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is to be reached on the finest mesh."""
    finest = {run["code"].split(" ")[0]: run for run in runs if run["mesh"] == runs[-1]["mesh"]}
    ours = [run for run in runs if "natcoord" in run["code"]]
    mine = next(run for run in ours if run["mesh"] == runs[-1]["mesh"] and "neo-Hooke" in run["code"])
    over = {
        name: mine["us_per_step"] / finest[name]["us_per_step"] if name in finest else None
        for name in ("Kratos", "CalculiX")
    }
    last = gradients[-1] if gradients else None
    return [
        common.target("time a step over that of Kratos", over["Kratos"], 0.25),
        common.target("time a step over that of CalculiX", over["CalculiX"], 0.5),
        common.target("compilation, value", max(run["compile_s"] for run in ours), 20.0, "s"),
        common.target("compilation, gradient", last and last["gradient_compile_s"], 45.0, "s"),
        common.target("value and gradient over value", last and last["over_value"], 3.0),
        common.target("energy balance", max(run["energy_balance"] for run in ours), 1e-11),
    ]


COLUMNS = {
    "code": ("code", ""),
    "mesh": ("mesh", ""),
    "us_per_step": ("us a step", ".0f"),
    "newton_iterations_mean": ("iterations", ".2f"),
    "energy_balance": ("energy", ".1e"),
    "tip": ("tip [m]", ".5f"),
}


def main() -> None:
    """Run, print and write."""
    options = common.peer_parser(__doc__.splitlines()[0], "nothing").parse_args()
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("solids", quick=options.quick)
    sizes = (1, 2) if options.quick else (1, 2, 3)
    runs, gradients = [], []
    for refinement in sizes:
        for name in MATERIALS:
            runs.append(measure(refinement, name, 1 if options.quick else 2))
            print(common.columns(runs[-1:], COLUMNS), flush=True)
        for name in () if options.no_peers else ("kratos", "calculix"):
            found = peer(name, refinement, options.peers_python)
            if found:
                runs.append(found)
                print(common.columns(runs[-1:], COLUMNS), flush=True)
    if not options.quick:
        gradients.append(gradient(sizes[-1], "neo-Hooke"))
    results |= {"runs": runs, "gradients": gradients, "targets": targets(runs, gradients)}
    print(common.columns(runs, COLUMNS))
    print(common.show_targets(results["targets"]))
    common.write(results, None, common.folder(options))


if __name__ == "__main__":
    main()
