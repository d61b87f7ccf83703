"""Time of a rollout in a batch on the device that JAX finds, a GPU as a rule, beside MJX on the same device.

usage: python -m benchmarks.batches [--quick] [--output FOLDER] [--no-peers] [--models NAME ...]
       [--lanes NUMBER ...] [--redraw JSON]

Scenes of `benchmarks.work_precision`, in double precision; lanes differ by up to a thousandth in their start
velocities. Timed are the first `STEPS` steps, at the lengths of step that rollouts of several numbers of
steps have, compilation apart: a median. Errors are those that `work_precision` found at the same steps on one
core; on a GPU motions are the same (`pytest -m gpu`). `us_per_rollout` is a whole rollout's share of the time
of its batch, interpolated between runs to equal errors; `us_at_most` that of the coarsest run where that is
more accurate already. Rows without lanes are of one core of a CPU, from `work_precision`, on the machine that
is named there.
"""

import json
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import natcoord_jax as nc
from benchmarks import common
from benchmarks import spacecraft as beside
from benchmarks.peers import measure as peer_measure
from benchmarks.spacecraft import OWN
from benchmarks.work_precision import scene_of

MODELS = ("heavy_top", "double_pendulum", "spinning_spacecraft", "four_bar")
ORDERS = (2, 4)
COUNTS = (16, 32, 64, 128, 256, 512, 1024)
FEWEST = {"spinning_spacecraft": 64, "four_bar": 64}
"""Steps of the rollouts of natcoord_jax, and the fewest at which no lane repeats steps in parts: all others
wait for one that does, and such a batch takes minutes."""
THEIRS = (100, 1000)
"""Steps of the rollouts of MJX: those that its errors are known for."""
LANES = (1, 1024, 32768)
STEPS = 64
REPEATS = 3
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
DISTURBANCE = 1e-3
MJX = "MJX RK4"


def known(model: str, code: str, key: str) -> dict[int, float]:
    """What `work_precision` found of one code on one core, by the number of steps."""
    found = json.loads((common.RESULTS / "work_precision.json").read_text("utf-8"))["models"][model]
    return {run["steps"]: run[key] for run in found["runs"] if run["code"] == code}


def own_batch(model: str, order: int, lanes: int) -> Callable[[float], Any]:
    """A function of the step [s]: by lane, the end after `STEPS` steps, the code and the steps repeated."""
    example = scene_of(model)

    def run(state: nc.State, factor: Any, dt: Any) -> Any:
        state = eqx.tree_at(lambda s: s.v, state, factor * state.v)
        inputs = jax.vmap(example.torques)(dt * (jnp.arange(STEPS) + 0.5)) if example.torques else None
        options = {"save_every": STEPS, "scheme": nc.EnergyMomentum(order=order), "throw": False}
        found = nc.simulate(example.system, state, dt=dt, steps=STEPS, inputs=inputs, **options)
        return found.states.q[-1], found.result, found.steps_rejected

    program = jax.jit(jax.vmap(run, in_axes=(None, 0, None)))
    factors = 1.0 + DISTURBANCE * jnp.linspace(0.0, 1.0, lanes)
    return lambda dt: program(example.state, factors, jnp.asarray(dt))


def their_batch(model: str, lanes: int) -> Callable[[float], Any]:
    """The same of MJX."""
    from benchmarks.peers.mjx_models import batch

    return batch(model, "RK4", STEPS, 1.0 + DISTURBANCE * jnp.linspace(0.0, 1.0, lanes))


def runs_of(
    model: str, code: str, lanes: int, run: Callable[[float], Any], plan: dict[str, Any]
) -> list[dict[str, Any]]:
    """Times per step and lane, by the number of steps of a rollout."""
    errors, alone = known(model, code, "error"), known(model, code, "us_per_step")
    fewest = FEWEST.get(model, 0)
    counts = [n for n in (THEIRS if code == MJX else plan["counts"]) if n in errors and n >= fewest]
    found = []
    for steps in counts:
        dt = peer_measure.MODELS[model].T_END / steps
        timing = common.timed(lambda dt=dt: jax.block_until_ready(run(dt)), STEPS * lanes, plan["repeats"])
        ends = run(dt)
        finite = all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(ends))
        row = {
            "code": code,
            "lanes": lanes,
            "steps": steps,
            "dt": dt,
            "error": errors[steps],
            "finite": finite,
        }
        if code != MJX:
            row |= {"scheme": code.removeprefix(f"{OWN}, "), "effort": "full"}
            row |= {"failed_lanes": int(jnp.sum(ends[1] != 0)), "repeated_steps": int(jnp.sum(ends[2]))}
        del timing["compile_s"]  # of the first of them only
        found.append(row | {"one_core_us_per_step": alone[steps]} | timing)
        at = f"{model}: {code}, {lanes} lanes, {steps} steps: {timing['us_per_step']:.3g} us a step"
        print(at, {key: row[key] for key in row if key in ("failed_lanes", "repeated_steps")}, flush=True)
    return found


def successful(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Runs that all lanes came to the end of: `STEPS` steps may be more than those of the rollout."""
    return [run for run in runs if run["finite"] and not run.get("failed_lanes")]


def rollouts(runs: list[dict[str, Any]], key: str = "us_per_step") -> dict[str, dict[str, float | None]]:
    """Time of a rollout [us] at given errors, and that of the coarsest run where it is more accurate."""
    sound = [(run["error"], run[key] * run["steps"]) for run in successful(runs)]
    points = [(math.log(error), math.log(time)) for error, time in sound]
    return {
        "us_per_rollout": {f"{wanted:g}": beside.time_at(points, math.log(wanted)) for wanted in ERRORS},
        "us_at_most": {
            f"{wanted:g}": sound[0][1] if sound and sound[0][0] < wanted else None for wanted in ERRORS
        },
    }


def measured(model: str, plan: dict[str, Any], peers: bool) -> dict[str, Any]:
    """All that is measured of one scene."""
    runs = []
    for lanes in plan["lanes"]:
        for order in ORDERS:
            runs += runs_of(model, f"{OWN}, order {order}", lanes, own_batch(model, order, lanes), plan)
        if peers:
            runs += runs_of(model, MJX, lanes, their_batch(model, lanes), plan)
    table = []
    for code in dict.fromkeys(run["code"] for run in runs):
        own = [run for run in runs if run["code"] == code]
        for lanes in plan["lanes"]:
            at = [run for run in own if run["lanes"] == lanes]
            table.append({"code": code, "lanes": lanes, **rollouts(at)})
        alone = [run for run in own if run["lanes"] == plan["lanes"][0]]
        table.append({"code": code, "lanes": None, **rollouts(alone, "one_core_us_per_step")})
    return {"runs": runs, "equal_error": table}


def table_of(model: str, found: dict[str, Any]) -> str:
    """Times of a rollout at equal errors, as plain text."""
    lines = [(f"{model}: us a rollout, to error", "lanes", *map("{:g}".format, ERRORS))]
    for row in found["equal_error"]:
        several = zip(row["us_per_rollout"].values(), row["us_at_most"].values(), strict=True)
        times = (f"{t:.3g}" if t else f"<{bound:.3g}" if bound else "-" for t, bound in several)
        lines.append((row["code"], "one core" if row["lanes"] is None else str(row["lanes"]), *times))
    return common.aligned(lines)


def draw(results: dict[str, Any]) -> Any:
    """Error over the time of a rollout, one panel a scene, one line a code and size of batch."""
    from matplotlib.figure import Figure

    models = results["models"]
    figure = Figure(figsize=(max(9.0, 4.2 * len(models)), 5.5), layout="constrained")
    panels = figure.subplots(1, len(models), squeeze=False)[0]
    shown = {}
    for panel, (model, found) in zip(panels, models.items()):
        codes = list(dict.fromkeys(run["code"] for run in found["runs"]))
        sizes = list(dict.fromkeys(run["lanes"] for run in found["runs"]))
        for k, code in enumerate(codes):
            for size, style in zip((*sizes, None), ("o:", "o--", "o-", "o-.", "x:")):
                at = [run for run in successful(found["runs"]) if run["code"] == code]
                at = [run for run in at if run["lanes"] == (sizes[0] if size is None else size)]
                key = "one_core_us_per_step" if size is None else "us_per_step"
                x, y = [run[key] * run["steps"] for run in at], [run["error"] for run in at]
                name = f"{code}, {'one core' if size is None else f'{size} lanes'}"
                (shown[name],) = panel.loglog(x, y, style, ms=3, lw=1.2, color=f"C{k}")
        panel.set(title=model, xlabel="time of a rollout [us]", ylabel="error of the end state [m]")
        panel.grid(alpha=0.3)
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(f"{results['device']}; one core: {results['one_core']}", fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.parser("Time of a rollout in a batch.", "the figure")
    parser.add_argument("--no-peers", action="store_true", help="natcoord_jax alone")
    parser.add_argument("--models", nargs="+", metavar="NAME", choices=MODELS, default=MODELS)
    parser.add_argument("--lanes", nargs="+", type=int, metavar="NUMBER", default=LANES)
    options = parser.parse_args()
    if options.redraw:
        common.redraw(options.redraw, draw)
        return
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("batches", quick=options.quick)
    device = jax.devices()[0]
    results |= {"device": f"{device.device_kind} ({device.platform})", "models": {}}
    beside_it = json.loads((common.RESULTS / "work_precision.json").read_text("utf-8"))
    results |= {"one_core": beside_it["machine"]["processor"], "targets": []}
    plan = {"counts": COUNTS, "lanes": options.lanes, "repeats": REPEATS}
    if options.quick:
        plan |= {"counts": COUNTS[2::2], "repeats": 1}
    for model in options.models:
        results["models"][model] = measured(model, plan, not options.no_peers)
        print(f"\n{table_of(model, results['models'][model])}\n", flush=True)
        common.write(results, None, common.folder(options))
    common.write(results, draw, common.folder(options))


if __name__ == "__main__":
    main()
