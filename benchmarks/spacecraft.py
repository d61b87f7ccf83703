"""Error against time beside Exudyn, MuJoCo and MJX: the spacecraft and the open tree, one run, one core.

usage: python -m benchmarks.spacecraft [--quick] [--output FOLDER] [--peers-python PATH] [--no-peers]
       [--models NAME ...]
       [--redraw JSON]

The systems are those of the gallery. Of natcoord_jax the compiled rollout is timed at its default settings
(Newton to the floor of round-off, every step saved), after compilation, which is given apart; the checks that
an eager `nc.simulate` makes in Python at each call are left out. Peers are run with the settings that
`benchmarks.peers` documents, by an interpreter of their own if they live in another environment; one that is
missing is left out. Errors are those of the final state:

- spacecraft: angle [rad] between the base's orientation and the exact one. (Kinetic energy alone is a weak
  test: codes in minimal coordinates find it almost exactly at any step.)
- open_tree: largest component of the error of the centres of mass [m] against a converged reference.

Conservation: `energy_error` is that of the final energy, relative to the change of energy in the exact
motion; `angular_momentum_error` is |J| at the end over the sum of the motors' impulses (spacecraft, where J
stays zero). Of natcoord_jax also `energy_balance`, energy less work over the whole run, and the errors of the
constraints. Its energy and J are those of its rows and their velocities, which the scheme conserves; these
velocities obey the constraints to second order only, see `velocity_constraint_error`.
"""

import json
import math
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common, compiled
from benchmarks.peers import measure as peer_measure
from natcoord_jax import gallery

OWN = "natcoord_jax"
LANES = 1000
BATCH_REPEATS = 5
COMPARED = (100, 1000)  # numbers of steps at which times are compared
ERRORS = {"spacecraft": (1e-2, 1e-3, 1e-4, 1e-5), "open_tree": (1e-2, 1e-3, 1e-4, 1e-5)}
# The part of Exudyn's time per step that is aimed at.
SHARE = {"spacecraft": 1 / 5, "open_tree": 1 / 3}
# What the first gradient is with respect to: the open tree has no inputs.
VARIED = {"spacecraft": "inputs", "open_tree": "state"}


class Peer(NamedTuple):
    """One way to run a peer code.

    Attributes:
        name: in tables and figures.
        module: in `benchmarks.peers`.
        needs: the package that must be there.
        settings: of its `run`.
        compared: whether it sets the target of time per step (implicit, with constraints, as ours).
        only: numbers of steps it is run at; None: all.
        models: models it is run on; None: all.
    """

    name: str
    module: str
    needs: str
    settings: dict[str, Any]
    compared: bool = False
    only: tuple[int, ...] | None = None
    models: tuple[str, ...] | None = None


PEERS = (
    Peer("Exudyn generalised alpha", "exudyn_models", "exudyn", {}, compared=True),
    Peer(
        "Exudyn generalised alpha, Euler parameters",
        "exudyn_models",
        "exudyn",
        {"node": "RotationEulerParameters"},
        compared=True,
    ),
    Peer("Exudyn kinematic tree RK44", "exudyn_models", "exudyn", {"formulation": "tree"}),
    Peer("MuJoCo Euler", "mujoco_models", "mujoco", {"integrator": "Euler"}),
    Peer("MuJoCo RK4", "mujoco_models", "mujoco", {"integrator": "RK4"}),
    Peer("MJX Euler", "mjx_models", "mujoco.mjx", {"integrator": "Euler"}, only=COMPARED),
    Peer("MJX RK4", "mjx_models", "mujoco.mjx", {"integrator": "RK4"}, only=COMPARED),
)


class Plan(NamedTuple):
    """Sizes of a run.

    Attributes:
        steps: numbers of steps.
        gradient_steps: those of gradients.
        all_leaves: whether there are gradients with respect to all leaves, which take longest to compile.
        repeats: timed repetitions, of a batch `BATCH_REPEATS`.
        lanes: of a batch.
        peers: the peers.
    """

    steps: tuple[int, ...]
    gradient_steps: tuple[int, ...]
    all_leaves: bool
    repeats: int
    lanes: int
    peers: tuple[Peer, ...]


FULL = Plan((25, 50, 100, 200, 500, 1000, 2000), COMPARED, True, 15, LANES, PEERS)
QUICK = Plan((50, 100), (100,), False, 5, 100, tuple(p for p in PEERS if p.name != "MJX RK4"))


def _angle(rotation: Any, exact: Any) -> float:
    """Angle between two orientations [rad], accurate where it is small."""
    chord = np.linalg.norm(np.subtract(rotation, exact)) / math.sqrt(8)
    return 2 * math.asin(min(float(chord), 1.0))


def errors(model: str, state: dict[str, Any]) -> dict[str, float | None]:
    """Errors of a final state, as `benchmarks.peers.measure.final_state` words it."""
    source = peer_measure.MODELS[model]
    if model == "spacecraft":
        exact = source.exact_state(source.T_END)
        impulse = sum(torque for _, torque in source.MOTORS) * source.T_END
        found: dict[str, float | None] = {
            "error": _angle(state["base_rotation"], exact["base_rotation"]),
            "energy_error": abs(state["energy"] / exact["kinetic_energy"] - 1),
            "angular_momentum_error": float(np.linalg.norm(state["angular_momentum"])) / impulse,
        }
    else:
        file = Path(peer_measure.__file__).with_name("open_tree_reference.json")
        exact = json.loads(file.read_text("utf-8"))
        change = abs(exact["energy"] - exact["energy_start"])
        found = {
            "error": float(np.abs(np.subtract(state["positions"], exact["positions"])).max()),
            "energy_error": abs(state["energy"] - exact["energy"]) / change,
            "angular_momentum_error": None,
        }
    return {key: x if x is not None and math.isfinite(x) else None for key, x in found.items()}


def own_state(model: str, system: nc.System, last: nc.State) -> dict[str, Any]:
    """Final state in the words of the peers."""
    source = peer_measure.MODELS[model]
    bodies = [system.sense(last, name) for name in system.structure.bodies]
    known = [body["name"].replace("_", " ") for body in source.BODIES]
    order = [known.index(name.replace("_", " ")) for name in system.structure.bodies]
    parts = ("com", "rotation", "com_velocity", "angular_velocity")
    arrays = [np.stack([np.asarray(getattr(body, part)) for body in bodies]) for part in parts]
    own = {"energy": float(system.energy(last).total), "angular_momentum": system.angular_momentum(last)}
    return peer_measure.final_state(source, *(a[np.argsort(order)] for a in arrays)) | own


def _rollout(example: gallery.Example, steps: int, order: int = 2) -> compiled.Rollout:
    dt = example.t_end / steps
    return compiled.Rollout(example.system, example.state, example.inputs(steps, dt), dt, order)


def own_run(model: str, example: gallery.Example, steps: int, repeats: int) -> dict[str, Any]:
    """Times, errors and balances of natcoord_jax."""
    system, rollout = example.system, _rollout(example, steps)
    timing = common.timed(rollout.run, steps, repeats)
    trajectory = rollout.run()
    constraints = system.constraint_errors(trajectory)
    return {
        "code": OWN,
        **rollout.about,
        "h": example.t_end / steps,
        "settings": {"scheme": "energy-momentum (57)", "solver": system.structure.solver},
        **timing,
        **errors(model, own_state(model, system, jax.tree.map(lambda x: x[-1], trajectory.states))),
        "energy_balance": float(np.max(nc.balance(system, trajectory).energy)),
        "constraint_error": float(np.max(constraints.position)),
        "velocity_constraint_error": float(np.max(constraints.velocity)),
        "newton_iterations_mean": int(trajectory.iterations) / max(int(trajectory.steps_taken), 1),
        "result": "successful" if int(trajectory.result) == 0 else system.explain(trajectory),
    }


def own_gradient(
    example: gallery.Example, part: str, steps: int, repeats: int, order: int = 2
) -> dict[str, Any]:
    """Value and gradient of the summed squares of the final velocities, over the value alone.

    Under `tangent`, the same of value and one tangent, in forward mode.
    """
    rollout = _rollout(example, steps, order)
    value, both, along, count = rollout.loss(part)
    forward, backward, tangent = common.timed_in_turn((value, both, along), steps, repeats)
    over_forward = backward.pop("over_first")
    _, gradient = both()
    return {
        "code": OWN,
        "with_respect_to": part,
        "parameters": count,
        **rollout.about,
        **backward,
        "forward_us_per_step": forward["us_per_step"],
        "forward_compile_s": forward["compile_s"],
        "over_forward": over_forward,
        "tangent": {"over_forward": tangent.pop("over_first"), **tangent},
        "finite": all(bool(np.all(np.isfinite(leaf))) for leaf in gradient),
    }


def own_batch(example: gallery.Example, lanes: int, steps: int, repeats: int) -> dict[str, Any]:
    """Time per step and lane of many rollouts at once.

    Lanes differ in their inputs, by up to a tenth; where there are none, in the initial rate of the joint
    that carries the first body, by up to 0.5 rad/s.
    """
    spread = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, lanes))
    rollout, system, state = _rollout(example, steps), example.system, example.state
    if system.structure.inputs:
        part, values = "inputs", (1 + 0.1 * spread)[:, None, None] * example.inputs(steps)
    else:
        joint = system.structure.joints[0]
        start = jax.vmap(lambda rate: system.with_coordinate(state, joint, 0.0, rate=rate))
        part, values = "state", start(0.5 * spread)
    call = rollout.batch(part, values)
    timing = common.timed(call, steps * lanes, repeats)
    failed = int(np.count_nonzero(call().result))
    about = {"lanes": lanes, "varied": part} | rollout.about
    return {"code": OWN, **about, **timing, "failed_lanes": failed}


def available(peers: tuple[Peer, ...], python: str) -> tuple[Peer, ...]:
    """The peers that the interpreter can import; a line for each package that is missing."""
    missing = set()
    for needs in dict.fromkeys(peer.needs for peer in peers):
        try:
            found = subprocess.run([python, "-c", f"import {needs}"], capture_output=True).returncode == 0
        except OSError:
            found = False
        if not found:
            missing.add(needs)
            print(f"{needs} is missing from {python} and is left out; pip install '.[benchmarks]'")
    return tuple(peer for peer in peers if peer.needs not in missing)


def peer_run(
    peer: Peer,
    python: str,
    model: str,
    steps: int,
    plan: Plan,
    judge: Callable[[dict[str, Any]], dict[str, float | None]] | None = None,
) -> dict[str, Any] | None:
    """Times and errors of a peer in a process of its own; None, with a line, if it fails.

    Args:
        peer: the code.
        python: its interpreter.
        model: name of the model.
        steps: number of steps.
        plan: sizes of the run.
        judge: function of the final state to errors; None: `errors`.
    """
    settings = peer.settings | {"repeats": plan.repeats}
    if peer.needs == "mujoco.mjx":
        extra = steps == COMPARED[0] and peer.settings["integrator"] == "Euler"
        gradient = steps if extra and plan.lanes == LANES else 0
        settings |= {"lanes": plan.lanes if extra else 0, "batch_steps": steps, "gradient_steps": gradient}
    words = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in settings.items()]
    command = [python, "-m", f"benchmarks.peers.{peer.module}", model, str(steps), *words]
    run = subprocess.run(command, capture_output=True, text=True, cwd=common.ROOT)
    try:
        answer = json.loads(run.stdout.splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        reason = (run.stderr.strip().splitlines() or [f"exit code {run.returncode}"])[-1]
        print(f"{peer.name}, {model}, {steps} steps: left out, {reason}")
        return None
    kept = ("steps", "h", "settings", "us_per_step", "us_per_step_range", "repeats", "version")
    optional = ("compile_s", "batch", "value_and_gradient")
    found = {key: answer[key] for key in kept} | {key: answer[key] for key in optional if key in answer}
    return {"code": peer.name} | found | (errors(model, answer) if judge is None else judge(answer))


def measure(model: str, plan: Plan, peers: tuple[Peer, ...], python: str) -> dict[str, Any]:
    """All runs of one model."""
    example = gallery.load(model)
    runs, gradients, batches = [], [], []
    for steps in plan.steps:
        runs.append(own_run(model, example, steps, plan.repeats))
        for peer in peers:
            run = peer_run(peer, python, model, steps, plan) if steps in (peer.only or plan.steps) else None
            if run is None:
                continue
            if "batch" in run:
                batches.append({"code": peer.name} | run.pop("batch"))
            if "value_and_gradient" in run:
                with_respect_to = {"with_respect_to": "inputs and initial velocities"}
                gradients.append({"code": peer.name} | with_respect_to | run.pop("value_and_gradient"))
            runs.append(run)
        print(f"{model}: {steps} steps done", flush=True)
    for steps in plan.gradient_steps:
        for part in (VARIED[model], "all") if plan.all_leaves else (VARIED[model],):
            gradients.append(own_gradient(example, part, steps, plan.repeats))
    batches.append(own_batch(example, plan.lanes, COMPARED[0], BATCH_REPEATS))
    print(f"{model}: gradients and batch done", flush=True)
    return {
        "runs": runs,
        "gradients": gradients,
        "batches": batches,
        "time_to_error": equal_error(model, runs),
    }


def equal_error(
    model: str | None, runs: list[dict[str, Any]], wanted_errors: tuple[float, ...] | None = None
) -> dict[str, dict[str, float | None]]:
    """Time [ms] of the whole manoeuvre at given errors, by code; None where no two runs bracket the error.

    Interpolated linearly between the logarithms of time and error of neighbouring numbers of steps.
    """
    table: dict[str, dict[str, float | None]] = {}
    levels = ERRORS[model or ""] if wanted_errors is None else wanted_errors
    for code in dict.fromkeys(run["code"] for run in runs):
        own = sorted((r for r in runs if r["code"] == code and r["error"]), key=lambda r: r["steps"])
        points = [(math.log(r["error"]), math.log(1e-3 * r["us_per_step"] * r["steps"])) for r in own]
        table[code] = {f"{wanted:g}": time_at(points, math.log(wanted)) for wanted in levels}
    return table


def time_at(points: list[tuple[float, float]], wanted: float) -> float | None:
    """Time at the first crossing of an error, from points (log error, log time) in the order of steps."""
    for (e0, t0), (e1, t1) in zip(points[:-1], points[1:], strict=True):
        if e0 >= wanted >= e1 and e0 > e1:
            return math.exp(t0 + (t1 - t0) * (e0 - wanted) / (e0 - e1))
    return None


def _find(runs: list[dict[str, Any]], codes: set[str], steps: int) -> list[float]:
    return [r["us_per_step"] for r in runs if r["code"] in codes and r["steps"] == steps]


def targets(models: dict[str, Any]) -> list[dict[str, Any]]:
    """The targets next to what was measured."""
    lines = []
    exudyn = {peer.name for peer in PEERS if peer.compared}
    for model, found in models.items():
        runs = found["runs"]
        for steps in COMPARED:
            own, theirs = _find(runs, {OWN}, steps), _find(runs, exudyn, steps)
            if own:  # a quick run leaves out the larger number
                ratio = own[0] / min(theirs) if theirs else None
                name = f"{model}: time per step over Exudyn's, {steps} steps"
                lines.append(common.target(name, ratio, SHARE[model]))
        mine = [g for g in found["gradients"] if g["code"] == OWN]
        for g in mine:
            name = f"{model}: gradient by {g['with_respect_to']} over forward, {g['steps']} steps"
            lines.append(common.target(name, g["over_forward"], 2.5))
        slowest = max(r["compile_s"] for r in runs if r["code"] == OWN)
        lines.append(common.target(f"{model}: longest compile time forward", slowest, 5.0, "s"))
        slowest = max(g["compile_s"] for g in mine)
        lines.append(common.target(f"{model}: longest compile time gradient", slowest, 10.0, "s"))
        single = _find(runs, {OWN}, COMPARED[0])[0]
        lane = next(b for b in found["batches"] if b["code"] == OWN)
        name = f"{model}: {lane['lanes']} lanes, time per step and lane over a single lane's"
        lines.append(common.target(name, lane["us_per_step"] / single, 1.0))
    return lines


def _number(value: float | None, form: str = ".1e") -> str:
    return "-" if value is None else format(value, form)


def tables(model: str, found: dict[str, Any]) -> str:
    """Everything of one model as plain text."""
    unit = {"spacecraft": "rad", "open_tree": "m"}[model]
    rows = [("code", "steps", "µs/step", "compile s", f"error [{unit}]", "energy", "J", "balance")]
    for r in found["runs"]:
        shown = (r["error"], r["energy_error"], r["angular_momentum_error"], r.get("energy_balance"))
        speed, compiling = f"{r['us_per_step']:.2f}", _number(r.get("compile_s"), ".1f")
        rows.append((r["code"], f"{r['steps']}", speed, compiling, *map(_number, shown)))
    parts = [f"{model}\n{common.aligned(rows)}"]
    rows = [("ms to error", *(f"{e:g}" for e in ERRORS[model]))]
    for code, times in found["time_to_error"].items():
        rows.append((code, *(_number(t, ".3g") for t in times.values())))
    parts.append(common.aligned(rows))
    rows = [("gradient with respect to", "steps", "µs/step", "over forward", "compile s")]
    for g in found["gradients"]:
        name = f"{g['code']}: {g['with_respect_to']}"
        speed = (f"{g['us_per_step']:.2f}", f"{g['over_forward']:.2f}", f"{g['compile_s']:.1f}")
        rows.append((name, f"{g['steps']}", *speed))
    parts.append(common.aligned(rows))
    rows = [("batch", "lanes", "steps", "µs/step/lane", "compile s")]
    for b in found["batches"]:
        speed = (f"{b['us_per_step']:.2f}", f"{b['compile_s']:.1f}")
        rows.append((b["code"], f"{b['lanes']}", f"{b['steps']}", *speed))
    parts.append(common.aligned(rows))
    return "\n\n".join(parts)


def draw(results: dict[str, Any]) -> Any:
    """Error and conservation over wall time of the whole manoeuvre."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    curves = {
        ("spacecraft", 0): ("error", "angle of the base against the exact one [rad]"),
        ("spacecraft", 1): ("angular_momentum_error", "|J| at the end over the impulse of the motors [-]"),
        ("open_tree", 0): ("error", "centres of mass against the reference [m]"),
        ("open_tree", 1): ("energy_error", "final energy against the reference, relative [-]"),
    }
    order = [OWN, *(peer.name for peer in PEERS)]
    for row, (model, found) in enumerate(results["models"].items()):
        for column in range(2):
            key, label = curves[model, column]
            panel = axes[row][column]
            for number, code in enumerate(order):
                runs = sorted((r for r in found["runs"] if r["code"] == code), key=lambda r: r["steps"])
                if not runs:
                    continue
                x = [1e-3 * r["us_per_step"] * r["steps"] for r in runs]
                y = [math.nan if r[key] is None else max(r[key], 1e-17) for r in runs]
                width = 2.5 if code == OWN else 1.2
                panel.loglog(x, y, "o-", ms=4, lw=width, color=f"C{number}", label=code)
            panel.set(xlabel="wall time of the manoeuvre [ms]", ylabel=label, title=model)
            panel.grid(alpha=0.3)
    axes[0][0].legend(fontsize=8)
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.peer_parser("Error against time beside other codes.", "the figure")
    parser.add_argument(
        "--models", nargs="+", default=list(SHARE), choices=list(SHARE), metavar="NAME", help="only these"
    )
    chosen = parser.parse_args()
    if chosen.redraw:
        common.redraw(chosen.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    plan = QUICK if chosen.quick else FULL
    results = common.circumstances("spacecraft", quick=chosen.quick)
    peers = () if chosen.no_peers else available(plan.peers, chosen.peers_python)
    models = {model: measure(model, plan, peers, chosen.peers_python) for model in chosen.models}
    versions = {
        r["code"].split()[0]: r["version"] for m in models.values() for r in m["runs"] if "version" in r
    }
    results["versions"] |= {"peers": versions}
    results |= {"models": models, "targets": targets(models)}
    print(f"\n{common.environment_line(results)}")
    for model, found in models.items():
        print(f"\n{tables(model, found)}")
    print(f"\n{common.show_targets(results['targets'])}")
    common.write(results, draw, common.folder(chosen))


if __name__ == "__main__":
    main()
