"""What accuracy costs in time, by order, beside MuJoCo, MJX and Exudyn: one run, one core.

usage: python -m benchmarks.work_precision [--quick] [--output FOLDER] [--peers-python PATH] [--no-peers]
       [--models NAME ...] [--keep] [--gradients [--orders ORDER ...]] [--redraw JSON]

Open trees (spacecraft, from rest and spinning, open tree, heavy top, double pendulum), closed loops (a row of
two four-bars, Bricard's mechanism) and a chain of rods on stiff springs, beside the peers at the settings
that `benchmarks.peers` documents. That all start from the same state is checked first. Times are those of
compiled runs that keep nothing but their end, compilation apart; medians. Errors are those of the end state:
of the spacecraft from rest the angle [rad] of the base against the exact one, of others the centres of mass
[m] against a converged reference, our own of order ten, which half its step confirms (open tree: MuJoCo's).
`drift` is the energy at the end less energy at the start and work, relative; of the peers the error of their
energy.

`time_to_error` is interpolated between runs, None where no two of them bracket the error. `time_at_most` is
the time of the coarsest run that came to an end, where that is more accurate already: explicit methods on the
stiff chain are, as soon as they are stable. Tables print it with a "<", and "-" for what is not reached.

With --gradients nothing is measured but value and gradient by the initial state, over the value alone, of
some scenes at every order. That goes into gradients.json, written after every scene and order: they compile
for up to minutes each.

Codes are compared on one scene in one run. JSON and figure are written after every scene, so a run that is
stopped loses only the scene it was at; --keep goes on from there, or measures some scenes again. `run` of
each scene has the date and commit of its figures, and the load of the machine; everything else must be the
same for all.

`long`, made with the heavy top, are runs of 10^6 steps (10^4 with --quick) of 1 ms: by code the largest
drift of energy, and its trend from start to end; None for runs that fail or diverge.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common
from benchmarks import spacecraft as beside
from benchmarks.peers import measure as peer_measure
from benchmarks.peers import spinning_spacecraft
from benchmarks.spacecraft import OWN, Peer
from natcoord_jax import gallery
from natcoord_jax.analysis.accuracy import drift as drift_of
from natcoord_jax.stepping.endpoint import endpoints

ORDERS = (2, 4, 6, 8, 10)
TREES = ("spacecraft", "spinning_spacecraft", "open_tree", "heavy_top", "double_pendulum")
LOOPS = ("four_bar", "bricard")
STIFF = ("stiff_chain",)
SHARED = (*TREES, *LOOPS, *STIFF)
RUN = ("date", "commit", "uncommitted_changes")
GRADIENTS = ("spacecraft", "heavy_top", "double_pendulum", "four_bar")
GRADIENT_STEPS = 200
"""Scenes that value and gradient are timed for, and the number of their steps, of the length that the gallery
suggests: a run that fails, or hardly converges, would flatter its gradient."""
GRADIENT_ROUNDS = 5
"""Rounds of both, as a multiple of the repeats of a plan: a ratio of two times asks for more of them."""
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
PEERS = (
    Peer("MuJoCo RK4", "mujoco_models", "mujoco", {"integrator": "RK4"}),
    Peer("MuJoCo implicitfast", "mujoco_models", "mujoco", {"integrator": "implicitfast"}),
    Peer("Exudyn generalised alpha", "exudyn_models", "exudyn", {}),
    Peer(
        "Exudyn generalised alpha, Euler parameters",
        "exudyn_models",
        "exudyn",
        {"node": "RotationEulerParameters"},
    ),
    # Explicit methods cannot close loops.
    Peer(
        "Exudyn kinematic tree RK44",
        "exudyn_models",
        "exudyn",
        {"formulation": "tree"},
        models=(*TREES, *STIFF),
    ),
    # With springs a step takes ten times as long as in redundant coordinates.
    Peer(
        "Exudyn kinematic tree, generalised alpha",
        "exudyn_models",
        "exudyn",
        {"formulation": "tree", "solver": "GeneralizedAlpha"},
        models=("spacecraft", "spinning_spacecraft", "heavy_top", "double_pendulum", *LOOPS),
    ),
    Peer(
        "MJX RK4", "mjx_models", "mujoco.mjx", {"integrator": "RK4"}, only=(100, 1000), models=TREES + LOOPS
    ),
)
LONG_PEERS = (
    *PEERS[:4],
    Peer("Exudyn generalised alpha, radius 0.6", "exudyn_models", "exudyn", {"spectral_radius": 0.6}),
    Peer("Exudyn trapezoidal, index 2", "exudyn_models", "exudyn", {"solver": "TrapezoidalIndex2"}),
    *PEERS[4:6],
)
"""Generalised alpha at its usual spectral radius of 0.9 does not solve all steps of the top; hence others."""
RECORDS = 1000
LONG_DT = 1e-3
"""Records of energy of the long run, and its step [s]."""
IMPLICIT = "Exudyn generalised alpha"
"""Head of the names of integrators for constrained systems; the faster one counts."""


class Plan(NamedTuple):
    """Sizes of a run: steps by code, repetitions, peers, steps of the long run and, by code, of the chain."""

    own: tuple[int, ...]
    theirs: tuple[int, ...]
    repeats: int
    peers: tuple[Peer, ...]
    long: int
    own_stiff: tuple[int, ...]
    theirs_stiff: tuple[int, ...]


FULL = Plan(
    (8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1024, 4096, 16384),
    (8, 16, 32, 50, 100, 200, 500, 1000, 2000, 5000, 10000),
    11,
    PEERS,
    10**6,
    # Order two takes more than ten iterations a step from here down, higher orders seconds a run.
    (128, 192, 256, 512, 1024, 4096, 16384),
    # 13 700 and 19 400 are within 1 % of where RK4 and the symplectic Euler method get stable.
    (100, 200, 500, 1000, 2000, 5000, 10000, 13700, 19400, 40000),
)
QUICK = Plan(
    (16, 32, 64), (100, 1000), 3, PEERS[:3] + PEERS[5:6], 10**4, (128, 512, 8192), (500, 1000, 13700, 19400)
)


def scene_of(model: str) -> gallery.Example:
    """The scene of a model, with its start."""
    if model != spinning_spacecraft.NAME:
        return gallery.load(model)
    example = gallery.load("spacecraft")
    spin, rows = jnp.asarray(spinning_spacecraft.SPIN), example.state.q
    # All rows turn about the origin, the centre of the base: points and directors alike.
    start = eqx.tree_at(lambda s: s.v, example.state, jnp.cross(spin, rows))
    return replace(example, name=model, state=start)


def check_start(model: str, example: gallery.Example) -> None:
    """See that the scene and the data of the peers start from the same state.

    Raises:
        ValueError: if positions, energy or angular momentum differ by more than round-off.
    """
    source = peer_measure.MODELS[model]
    places = np.array([body["com"] for body in source.BODIES])
    velocities = np.array([peer_measure.moving(body) for body in source.BODIES])
    spins = np.array([peer_measure.turning(body) for body in source.BODIES])
    pose = np.tile(np.eye(3), (len(places), 1, 1))
    theirs = peer_measure.final_state(source, places, pose, velocities, spins)
    own = beside.own_state(model, example.system, example.state)
    for part in ("positions", "energy", "angular_momentum"):
        one, other = np.asarray(own[part]), np.asarray(theirs[part])
        gap = float(np.max(np.abs(one - other)) / max(1.0, float(np.max(np.abs(other)))))
        if not gap < 1e-13:
            raise ValueError(f"{model}: {part} of scene and data differ by {gap:.1g}")
    print(f"{model}: scene and data of the peers start from the same state")


def own_runs(model: str, plan: Plan) -> list[dict[str, Any]]:
    """Times, errors and drifts of all orders."""
    example = scene_of(model)
    check_start(model, example)
    system, start = example.system, example.state
    t_end = peer_measure.MODELS[model].T_END
    judge = judge_of(model)
    found = []
    for order in ORDERS:
        scheme = nc.EnergyMomentum(order=order)
        run = endpoints(system, start, inputs=example.torques, scheme=scheme)
        jax.clear_caches()  # the reference may have compiled this order already
        compile_s = common.seconds(lambda run=run: jax.block_until_ready(run(t_end / 64, 2)))
        for steps in plan.own_stiff if model in STIFF else plan.own:
            if order > 2 and steps > 2048:
                continue
            call = lambda run=run, steps=steps: jax.block_until_ready(run(t_end / steps, steps))  # noqa: E731
            begun = time.perf_counter()
            end = call()
            enough = max(peer_measure.FEW, int(peer_measure.ENOUGH / (time.perf_counter() - begun)))
            if int(end.result) != 0:
                continue
            timing = common.timed(call, steps, min(plan.repeats, enough)) | {"compile_s": compile_s}
            errors = judge(beside.own_state(model, system, end.state))
            drift = drift_of(system, start, end.state)
            newton = int(end.iterations) / steps
            code = f"{OWN}, order {order}"
            about = common.about(t_end / steps, steps, order)
            found.append({"code": code, **about, **timing, **errors, "drift": drift, "newton": newton})
        print(f"{model}: order {order} done", flush=True)
    return found


def own_gradient(model: str, order: int, repeats: int) -> dict[str, Any]:
    """Value and gradient by the initial state over the value."""
    example = replace(scene_of(model), steps=GRADIENT_STEPS)
    check_run(example, order)
    rounds = GRADIENT_ROUNDS * repeats
    found = {"order": order} | beside.own_gradient(example, "state", GRADIENT_STEPS, rounds, order)
    ratio, tangent = found["over_forward"], found["tangent"]["over_forward"]
    print(f"{model}: order {order}: gradient {ratio:.2f}, tangent {tangent:.2f}", flush=True)
    return found


def gradients(chosen: argparse.Namespace, plan: Plan) -> None:
    """Value and gradient of the chosen scenes, by order: the lowest one of all scenes first."""
    results, where = common.circumstances("gradients", quick=chosen.quick), common.folder(chosen)
    models = earlier(where, results)["models"] if chosen.keep else {}
    for order in chosen.orders or (ORDERS[:2] if chosen.quick else ORDERS):
        for model in (model for model in GRADIENTS if model in chosen.models):
            others = [row for row in models.get(model, []) if row["order"] != order]
            run = {key: results[key] for key in RUN}
            found = own_gradient(model, order, plan.repeats) | {"run": run}
            models[model] = sorted([*others, found], key=lambda row: row["order"])
            results |= {"models": models, "targets": gradient_targets(models)}
            common.write(results, None, where)
    print(f"{common.environment_line(results)}\n\n{common.show_targets(results['targets'])}")


def gradient_targets(found: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """What value and gradient are to take."""
    return [
        common.target(
            f"{model}: value and gradient over value at order {row['order']}", row["over_forward"], 2.5
        )
        for model, rows in found.items()
        for row in rows
    ]


def check_run(example: gallery.Example, order: int) -> None:
    """See that the suggested run comes to its end without a failed step.

    Raises:
        RuntimeError: if it does not.
    """
    options = dict(dt=example.dt, steps=example.steps, inputs=example.inputs(example.steps, example.dt))
    run = nc.simulate(example.system, example.state, scheme=nc.EnergyMomentum(order), **options)
    if int(run.steps_rejected):
        raise RuntimeError(f"{example.name}: {int(run.steps_rejected)} steps of order {order} were repeated")


def _reference(example: gallery.Example, t_end: float) -> nc.State:
    run = endpoints(example.system, example.state, inputs=example.torques, scheme=nc.EnergyMomentum(order=10))
    fine, finer = (run(t_end / n, n).state for n in (1000, 2000))
    gap = float(np.max(np.abs(fine.q - finer.q)))
    print(f"{example.name}: reference good to {gap:.1g}")
    return fine


@cache
def judge_of(model: str) -> Callable[[dict[str, Any]], dict[str, float | None]]:
    """Errors of a final state in the words of the peers."""
    if model in beside.SHARE:
        return partial(beside.errors, model)
    example = scene_of(model)
    system, start = example.system, example.state
    end = _reference(example, peer_measure.MODELS[model].T_END)
    exact = beside.own_state(model, system, end)
    first, last = system.energy(start), system.energy(end)
    scale = max(float(e.kinetic) + sum(float(abs(x)) for x in e.stores.values()) for e in (first, last))

    def judge(state: dict[str, Any]) -> dict[str, float | None]:
        error = np.max(np.abs(np.subtract(state["positions"], exact["positions"])))
        drift = abs(state["energy"] - float(last.total)) / scale
        return {
            key: float(x) if np.isfinite(x) else None
            for key, x in (("error", error), ("energy_error", drift))
        }

    return judge


def long_run(steps: int) -> dict[str, Any]:
    """Drift of natcoord_jax over many steps of the heavy top."""
    example = gallery.load("heavy_top")
    every = steps // RECORDS
    trajectory = nc.simulate(
        example.system,
        example.state,
        dt=LONG_DT,
        steps=steps,
        save_every=every,
        scheme=nc.EnergyMomentum(order=2),
    )
    energy = example.system.energy(trajectory)
    involved = energy.kinetic + sum(np.abs(v) for v in energy.stores.values())
    return {"code": f"{OWN}, order 2", "steps": steps, **drifting(energy.total, involved)}


def peer_long_run(peer: Peer, python: str, steps: int) -> dict[str, Any]:
    """The same of a peer."""
    settings = {"t_end": LONG_DT * steps, "records": RECORDS}

    def judge(answer: dict[str, Any]) -> dict[str, float | None]:
        kinetic, total = np.transpose(answer["records"])
        return drifting(total, kinetic + np.abs(total - kinetic))

    one = beside.QUICK._replace(lanes=0)
    run = beside.peer_run(
        peer._replace(settings=peer.settings | settings), python, "heavy_top", steps, one, judge
    )
    row: dict[str, Any] = {"code": peer.name, "steps": steps, "largest_drift": None, "trend": None}
    return row if run is None else {key: run[key] for key in row}


def drifting(total: Any, involved: Any) -> dict[str, float | None]:
    """Largest drift of energy of a run, and its trend from start to end; None unless all of it is finite.

    Args:
        total: energy, by time [J].
        involved: the kinetic energy and the absolute values of all others, by time [J].
    """
    total, scale = np.asarray(total), float(np.max(involved))
    if not (np.all(np.isfinite(total)) and math.isfinite(scale)):
        return {"largest_drift": None, "trend": None}
    drift = (total - total[0]) / scale
    slope = np.polyfit(np.linspace(0, 1, drift.size), drift, 1)[0]
    return {"largest_drift": float(np.max(np.abs(drift))), "trend": float(slope)}


def long_table(rows: list[dict[str, Any]]) -> str:
    """The long runs as plain text."""
    lines = [("heavy top, steps of 1 ms", "steps", "largest drift", "trend")]
    for row in rows:
        drift, trend = ("-" if row[key] is None else f"{row[key]:.1e}" for key in ("largest_drift", "trend"))
        lines.append((row["code"], f"{row['steps']}", drift, trend))
    return common.aligned(lines)


def times(runs: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Time [ms] to given errors, by code, and of the best order."""
    return _with_best(beside.equal_error(None, runs, ERRORS))


def times_at_most(runs: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """The same of codes whose coarsest run is more accurate already: its time."""
    table: dict[str, dict[str, float | None]] = {}
    for code in dict.fromkeys(run["code"] for run in runs):
        first = min((r for r in runs if r["code"] == code), key=lambda r: r["steps"])
        spent = 1e-3 * first["us_per_step"] * first["steps"]
        table[code] = {f"{wanted:g}": spent if first["error"] < wanted else None for wanted in ERRORS}
    return _with_best(table)


def _with_best(table: dict[str, dict[str, float | None]]) -> dict[str, dict[str, float | None]]:
    """Times of all codes, after those of our best order."""
    own = [row for code, row in table.items() if code.startswith(OWN)]
    return {f"{OWN}, best order": _fastest(own), **table}


def _fastest(rows: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Shortest time to each error."""
    best: dict[str, float | None] = {}
    for error in map("{:g}".format, ERRORS):
        known = [t for row in rows if (t := row.get(error)) is not None]
        best[error] = min(known, default=None)
    return best


def _known(found: dict[str, Any]) -> dict[str, dict[str, float | None]]:
    """Times to errors, by code, those of `time_at_most` included."""
    bounds = found["time_at_most"]
    return {code: _fastest([row, bounds[code]]) for code, row in found["time_to_error"].items()}


def table_of(found: dict[str, Any]) -> str:
    """Times to errors of one model as plain text."""
    rows = [("ms to error", *map("{:g}".format, ERRORS))]
    for code, row in _known(found).items():
        interpolated = found["time_to_error"][code]
        words = (
            "-" if t is None else f"{'' if t == interpolated[e] else '<'}{t:.3g}" for e, t in row.items()
        )
        rows.append((code, *words))
    return common.aligned(rows)


def targets(models: dict[str, Any], long: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is aimed at next to what was measured."""
    lines = []
    for model in (m for m in TREES if m in models):
        table = _known(models[model])
        best = table[f"{OWN}, best order"]
        rk4 = table.get("MuJoCo RK4")
        implicit = _fastest([row for code, row in table.items() if code.startswith(IMPLICIT)])
        for error, share in (("1e-06", 1.0), ("1e-08", 0.2)):
            lines.append(
                common.target(f"{model}: over MuJoCo RK4 at {error}", _ratio(best, rk4, error), share)
            )
        lines.append(
            common.target(f"{model}: over Exudyn, implicit, at 0.001", _ratio(best, implicit, "0.001"), 1.0)
        )
        name = f"{model}: over Exudyn, implicit, at 1e-08, there extrapolated by its order two"
        lines.append(common.target(name, _ratio(best, _extrapolated(implicit), "1e-08"), 1 / 500))
    for model in (m for m in (*LOOPS, *STIFF) if m in models):
        table = _known(models[model])
        best = _fastest([row for code, row in table.items() if code.startswith(OWN)])
        several = [row for code, row in table.items() if not code.startswith(OWN)]
        theirs = _fastest(several)
        for error in map("{:g}".format, ERRORS):
            unmet = ", which no peer reaches" if several and theirs[error] is None else ""
            name = f"{model}: over every peer at {error}{unmet}"
            lines.append(common.target(name, _ratio(best, theirs, error), 1.0))
    if long:
        (own,) = (row["largest_drift"] for row in long if row["code"].startswith(OWN))
        theirs = [row["largest_drift"] for row in long if not row["code"].startswith(OWN)]
        least = min((drift for drift in theirs if drift is not None), default=None)
        name = (
            f"heavy top, 10^{round(math.log10(long[0]['steps']))} steps: drift over the least of the peers'"
        )
        lines.append(common.target(name, None if least is None or own is None else own / least, 1.0))
    return lines


def _extrapolated(times: dict[str, float | None]) -> dict[str, float | None]:
    """Time of a method of order two to an error of 1e-8, from that to the smallest error it was run to."""
    known = [(float(error), t) for error, t in times.items() if t is not None]
    if not known:
        return {}
    error, t = min(known)
    return {"1e-08": t * math.sqrt(error / 1e-8)}


def _ratio(own: dict, other: dict | None, error: str) -> float | None:
    if other is None or own.get(error) is None or other.get(error) is None:
        return None
    return own[error] / other[error]


def draw(results: dict[str, Any]) -> Any:
    """Error over wall time, one panel a scene."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 9), layout="constrained")
    axes = figure.subplots(2, 4).reshape(-1)
    for panel in axes[len(results["models"]) :]:
        panel.set_visible(False)
    codes = list(dict.fromkeys(r["code"] for found in results["models"].values() for r in found["runs"]))
    own = [code for code in codes if code.startswith(OWN)]
    looks = {code: ("o-", 1.8, f"C{k}") for k, code in enumerate(own)}
    looks |= {
        code: ("s--", 1.0, f"C{len(own) + k}" if len(own) + k < 10 else ("black", "gold")[len(own) + k - 10])
        for k, code in enumerate(code for code in codes if code not in own)
    }
    shown = {}
    for panel, (model, found) in zip(axes, results["models"].items()):
        for code, (style, width, colour) in looks.items():
            runs = sorted(
                (r for r in found["runs"] if r["code"] == code and r["error"]), key=lambda r: r["steps"]
            )
            if not runs:
                continue
            x, y = [1e-3 * r["us_per_step"] * r["steps"] for r in runs], [r["error"] for r in runs]
            (shown[code],) = panel.loglog(x, y, style, ms=3, lw=width, color=colour)
        panel.set(title=model, xlabel="wall time [ms]", ylabel="error of the end state [rad or m]")
        panel.grid(alpha=0.3)
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=4, fontsize=8)
    # Scenes may be of several runs.
    scenes = results["models"].values()
    lines = dict.fromkeys(common.environment_line(results | found["run"]) for found in scenes)
    figure.suptitle("\n".join(lines), fontsize=9)
    return figure


def earlier(where: Path | None, results: dict[str, Any]) -> dict[str, Any]:
    """What an earlier run has left in a folder: models and long.

    Raises:
        SystemExit: if there is nothing, or it is of another machine or other versions.
    """
    file = None if where is None else where / f"{results['benchmark']}.json"
    if file is None or not file.is_file():
        raise SystemExit(f"--keep: there is no {file or 'folder of results'} to add to")
    found = json.loads(file.read_text("utf-8"))
    here, there = (
        {"quick": run["quick"], "processor": run["machine"]["processor"]} | run["versions"]
        for run in (results, found)
    )
    other = [f"{key} {there.get(key)}, here {here[key]}" for key in here if there.get(key) != here[key]]
    if other:
        raise SystemExit(f"--keep: {file} does not compare with this run ({'; '.join(other)})")
    return {"models": found["models"], "long": found.get("long", [])}


def measured(model: str, plan: Plan, chosen: argparse.Namespace, peers: Sequence[Peer]) -> dict[str, Any]:
    """All that is measured of one scene, and when."""
    now = common.circumstances("work_precision", quick=chosen.quick)
    bare = beside.QUICK._replace(repeats=plan.repeats, lanes=0)
    runs = own_runs(model, plan)
    counts = plan.theirs_stiff if model in STIFF else plan.theirs
    for peer in (p for p in peers if p.models is None or model in p.models):
        for steps in peer.only or counts:
            run = beside.peer_run(peer, chosen.peers_python, model, steps, bare, judge_of(model))
            if run is not None and run["error"]:
                runs.append(run | {"drift": run.get("energy_error")})
    return {
        "run": {key: now[key] for key in RUN} | {"load_at_start": now["machine"]["load_at_start"]},
        "runs": runs,
        "time_to_error": times(runs),
        "time_at_most": times_at_most(runs),
    }


def long_runs(plan: Plan, chosen: argparse.Namespace) -> list[dict[str, Any]]:
    """Drift of energy over a million steps of the heavy top, by code."""
    several = () if chosen.no_peers else beside.available(LONG_PEERS, chosen.peers_python)
    found = [long_run(plan.long)]
    found += [peer_long_run(peer, chosen.peers_python, plan.long) for peer in several]
    print(long_table(found), flush=True)
    return found


def main() -> None:
    """Run the benchmark."""
    parser = common.peer_parser("What accuracy costs in time, beside other codes.", "the figure")
    parser.add_argument("--models", nargs="+", choices=SHARED, default=SHARED, help="only these scenes")
    parser.add_argument("--keep", action="store_true", help="keep what the file has of other scenes")
    parser.add_argument("--gradients", action="store_true", help="nothing but value and gradient")
    parser.add_argument("--orders", nargs="+", type=int, choices=ORDERS, help="of these")
    chosen = parser.parse_args()
    if chosen.orders and not chosen.gradients:
        parser.error("--orders: they are those of --gradients")
    if chosen.redraw:
        common.redraw(chosen.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    plan = QUICK if chosen.quick else FULL
    if chosen.gradients:
        gradients(chosen, plan)
        return
    results = common.circumstances("work_precision", quick=chosen.quick)
    peers = () if chosen.no_peers else beside.available(plan.peers, chosen.peers_python)
    where = common.folder(chosen)
    kept = earlier(where, results) if chosen.keep else {"models": {}, "long": []}
    models, long = kept["models"], kept["long"]
    for model in chosen.models:
        models[model] = measured(model, plan, chosen, peers)
        print(f"\n{model}\n{table_of(models[model])}\n", flush=True)
        if model == "heavy_top":
            long = long_runs(plan, chosen)
        models = {name: models[name] for name in SHARED if name in models}
        results |= {"models": models, "long": long, "targets": targets(models, long)}
        common.write(results, draw, where)
    print(f"{common.environment_line(results)}\n\n{common.show_targets(results['targets'])}")


if __name__ == "__main__":
    main()
