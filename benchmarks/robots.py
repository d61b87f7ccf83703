"""Robots from files beside MuJoCo: mass matrices, gravity torques and accelerations, flights, torques.

usage: python -m benchmarks.robots [--quick] [--output FOLDER] [--redraw JSON]

Every URDF of the package example-robot-data and every MJCF model in dm-control and gymnasium that is
installed (pip install --no-deps example-robot-data dm-control gymnasium) is read. At ten random states with
velocities and controls or torques, mass matrix, gravity torques and accelerations of all rows are compared
with MuJoCo's, which runs without what it has as soft constraints. Differences are relative to the largest
number of each; `condition` is the largest condition number of the mass matrix at these states. Some URDF of
what walks and flies are read with a root that floats, too.

A humanoid flies freely for 1000 steps, beside MuJoCo's RK4 with the same step: time a step of the program
with full effort, and `first_s`, the first run as a user waits for it, by the quick program. Torques of
inverse dynamics: those that MuJoCo finds for random accelerations at random states bring these about here.
"""

import sysconfig
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled
from tests.robots import HARD, accelerations_of, agreement, comparable, inputs_of, off, random_data

SITE = Path(sysconfig.get_paths()["purelib"])
FOLDERS = {
    "example-robot-data": (SITE / "cmeel.prefix" / "share" / "example-robot-data" / "robots", "*.urdf"),
    "gymnasium": (SITE / "gymnasium", "*.xml"),
    "dm-control": (SITE / "dm_control", "*.xml"),
}
QUICK = ("panda.urdf", "solo12.urdf", "ant.xml", "humanoid.xml")
FLOATING = (
    "a1.urdf", "anymal.urdf", "g1_29dof_rev_1_0.urdf", "icub_reduced.urdf", "iris_simple.urdf",
    "quadrotor_base.urdf", "simple_humanoid.urdf", "solo12.urdf", "talos_reduced.urdf",
)  # fmt: skip
FLIERS = (("dm-control", "suite/humanoid.xml"), ("dm-control", "suite/humanoid_CMU.xml"))
TORQUES = (
    ("example-robot-data", "panda_description/urdf/panda.urdf", False),
    ("example-robot-data", "solo_description/robots/solo12.urdf", False),
    ("example-robot-data", "solo_description/robots/solo12.urdf", True),
)
TARGET = 1e-9
COLUMNS = {
    "file": ("file", ""),
    "floating": ("floating", ""),
    "bodies": ("bodies", "d"),
    "rates": ("rates", "d"),
    "inputs": ("inputs", "d"),
    "left_out": ("left out", "d"),
    "mass": ("mass", ".0e"),
    "gravity": ("gravity", ".0e"),
    "acceleration": ("acceleration", ".0e"),
    "condition": ("condition", ".0e"),
    "read_s": ("read s", ".2f"),
}
STEP, STEPS = 2e-3, 1000


def read(package: str, file: Path, floating: bool) -> dict[str, Any]:
    """One model: what was read, and how far it is from MuJoCo."""
    folder = FOLDERS[package][0]
    found: dict[str, Any] = {"package": package, "file": str(file.relative_to(folder)), "floating": floating}
    start = time.perf_counter()
    try:
        robot = nc.io.load(file, leave_out=HARD, floating=floating)
    except ValueError as error:
        return found | {"refused": str(error).replace(str(SITE), "")}
    found |= {"read_s": time.perf_counter() - start, "bodies": len(robot.bodies), "joints": len(robot.joints)}
    found |= {"inputs": len(robot.inputs), "rates": robot.description.rate_count}
    found["left_out"] = sum(not note.mapped for note in robot.notes)
    found["otherwise"] = sum(note.mapped for note in robot.notes)
    if robot.bodies:
        compared = agreement(robot)
        found |= {key: getattr(compared, key) for key in ("mass", "gravity", "acceleration", "condition")}
        found["seconds"] = time.perf_counter() - start
    return found


def sweep(quick: bool) -> list[dict[str, Any]]:
    """All models."""
    runs = []
    for package, (folder, pattern) in FOLDERS.items():
        for file in sorted(folder.rglob(pattern)):
            if quick and file.name not in QUICK:
                continue
            for floating in (False, True) if file.name in FLOATING else (False,):
                runs.append(read(package, file, floating))
                said = {k: v for k, v in runs[-1].items() if k in ("mass", "acceleration", "refused")}
                print(f"{file.name}{', floating' * floating}: {said}", flush=True)
            if len(runs) % 20 == 0:
                jax.clear_caches()  # or memory grows
    return runs


def without_losses(file: Path) -> Any:
    """A model without dampers and actuators: its energy is kept."""
    spec = mujoco.MjSpec.from_file(str(file))
    for joint in spec.joints:
        joint.damping[:] = 0.0
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    return spec


def fly(package: str, name: str, steps: int) -> dict[str, Any]:
    """Free flight: what energy and momenta are worth, and times a step."""
    robot = nc.io.load(without_losses(FOLDERS[package][0] / name), leave_out=HARD)
    scene = nc.Scene()
    handle = scene.add(robot)
    system, state = scene.compile()
    rates = np.random.default_rng(0).normal(size=robot.description.rate_count)
    state = handle.state(system, state, None, rates)
    once = common.seconds(lambda: jax.block_until_ready(nc.simulate(system, state, dt=STEP, steps=steps)))
    rollout = compiled.Rollout(system, state, np.zeros((steps, len(system.structure.inputs))), STEP)
    timing = common.timed(rollout.run, steps, 3)
    kept = nc.balance(system, rollout.run())
    peer = beside(robot, rates, steps)
    return {
        "file": name, "joints": len(robot.joints), "unknowns": system.structure.unknowns,
        **rollout.about, "energy": float(np.max(kept.energy)), "momentum": float(np.max(kept.momentum)),
        "angular_momentum": float(np.max(kept.angular_momentum)), "first_s": once,
        **timing, "mujoco_rk4_us_per_step": 1e6 * peer["seconds"] / steps,
        "mujoco_rk4_energy": peer["energy"],
    }  # fmt: skip


def beside(robot: Any, rates: np.ndarray, steps: int) -> dict[str, float]:
    """The same flight with MuJoCo's RK4: time, and drift of the energy relative to the kinetic one."""
    model = robot.description.model
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, STEP
    data = mujoco.MjData(model)
    data.qvel[:] = rates
    mujoco.mj_forward(model, data)
    before = np.array(data.energy)
    seconds = common.seconds(lambda: mujoco.mj_step(model, data, steps))
    mujoco.mj_forward(model, data)
    return {"seconds": seconds, "energy": float(abs(data.energy.sum() - before.sum()) / before[1])}


def torques(package: str, name: str, floating: bool) -> dict[str, Any]:
    """At random states: inputs that bring about MuJoCo's accelerations here, beside those it inverts to."""
    robot = nc.io.load(FOLDERS[package][0] / name, leave_out=HARD, floating=floating)
    model, scene = comparable(robot), nc.Scene()
    arm = scene.add(robot)
    system, start = scene.compile()
    rng, worst = np.random.default_rng(0), 0.0
    driven = [robot.joints[joint].rate_index for joint in robot.inputs]
    places = [system.body_index(bodies[-1]) for bodies in arm.parts.carriers]
    units = np.vstack([np.zeros(len(driven)), np.eye(len(driven))])
    for _ in range(10):
        data = random_data(model, rng)
        inputs_of(robot, system, data, rng)
        mujoco.mj_forward(model, data)
        wanted = accelerations_of(robot, data)
        mujoco.mj_inverse(model, data)
        state = arm.state(system, start, data.qpos, data.qvel)
        many = jax.tree.map(lambda x: np.broadcast_to(x, (len(units), *np.shape(x))), state)
        rows = np.asarray(system.instant(many, units).accelerations).reshape(len(units), -1, 4, 3)[:, places]
        gains, missing = (rows[1:] - rows[0]).reshape(len(driven), -1), (wanted - rows[0]).reshape(-1)
        found = np.linalg.lstsq(gains.T, missing, rcond=None)[0]
        worst = max(worst, off(found, data.qfrc_inverse[driven]))
    return {"file": name, "floating": floating, "inputs": len(driven), "torque": worst}


def targets(results: dict[str, Any]) -> list[dict[str, Any]]:
    """What was asked for, and what was measured."""
    refused = [run for run in results["runs"] if "refused" in run and run["package"] == "example-robot-data"]
    compared = [run for run in results["runs"] if "mass" in run]
    rows = [common.target("URDF that are refused", len(refused), 0, "models")]
    for what in ("mass", "gravity", "acceleration"):
        beyond = sum(run[what] > TARGET for run in compared)
        rows.append(common.target(f"{what} differs by more than {TARGET:g}", beyond, 0, "models"))
    for run in results["flights"]:
        worst = max(run["energy"], run["momentum"], run["angular_momentum"])
        rows.append(common.target(f"{run['file']}: energy and momenta", worst, 1e-11))
        slower = run["us_per_step"] / run["mujoco_rk4_us_per_step"]
        rows.append(common.target(f"{run['file']}: time a step over that of MuJoCo's RK4", slower, 3.0))
    for run in results["torques"]:
        name = f"{run['file']}{', floating' * run['floating']}: torques"
        rows.append(common.target(name, run["torque"], TARGET))
    return rows


def show(runs: list[dict[str, Any]]) -> str:
    """The table, one model a line; of one that is refused the reason."""
    lines = [[head for head, _ in COLUMNS.values()]]
    for run in runs:
        words = [format(run[key], form) if key in run else "-" for key, (_, form) in COLUMNS.items()]
        lines.append(words)
    table = common.aligned(lines)
    refused = [f"{run['file']}: {run['refused']}" for run in runs if "refused" in run]
    return "\n".join([table, "", *refused])


def draw(results: dict[str, Any]) -> Any:
    """Differences of the accelerations over the condition of the mass matrix."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for package in FOLDERS:
        runs = [r for r in results["runs"] if r["package"] == package and "mass" in r]
        x, y = ([r[key] for r in runs] for key in ("condition", "acceleration"))
        axes.loglog(x, np.maximum(y, 1e-17), "o", label=f"{package}, {len(runs)} models")
    axes.axhline(TARGET, color="k", ls=":", lw=1, label="target")
    axes.set(xlabel="condition of the mass matrix", ylabel="difference of accelerations, relative to MuJoCo")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    options = common.parser("Robots from files beside MuJoCo.", "the figure").parse_args()
    if options.redraw:
        common.redraw(options.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("robots", quick=options.quick)
    there = ("mujoco", *(name for name, (folder, _) in FOLDERS.items() if folder.is_dir()))
    results["versions"] |= {name: version(name) for name in there}
    results["runs"] = sweep(options.quick)
    turned = TORQUES[:1] if options.quick else TORQUES
    results["torques"] = [torques(*given) for given in turned if given[0] in there]
    flown = FLIERS[:0] if options.quick else FLIERS
    results["flights"] = [fly(*given, STEPS) for given in flown if given[0] in there]
    results["targets"] = targets(results)
    print(f"\n{common.environment_line(results)}\n\n{show(results['runs'])}\n")
    print(common.show_targets(results["targets"]))
    common.write(results, draw, common.folder(options))


if __name__ == "__main__":
    main()
