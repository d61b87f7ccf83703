"""What accuracy costs in time, by order, beside MuJoCo, MJX and Exudyn: one run, one core.

usage: python -m benchmarks.work_precision [--quick] [--output FOLDER] [--peers-python PATH] [--no-peers]
       [--models NAME ...] [--redraw JSON]

Spacecraft (from rest, and spinning), open tree, heavy top and double pendulum are run beside the peers at the
settings that `benchmarks.peers` documents; the loops by natcoord_jax alone. Times are those of compiled runs
that keep nothing but their end, compilation apart; medians. Errors are those of the end state: of the
spacecraft from rest the angle [rad] of the base against the exact one, of other trees the centres of mass [m]
against a converged reference, of loops positions and directors against a reference of order ten, which half
its step confirms. `drift` is the energy at the end less energy at the start and work, relative; of the peers
the error of their energy.

`long` are runs of 10^6 steps (10^4 with --quick) of the heavy top: largest drift, and its trend.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
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
SHARED = ("spacecraft", "spinning_spacecraft", "open_tree", "heavy_top", "double_pendulum")
ALONE = {"four_bar": 2.0, "bricard": 2.0}
"""Other scenes and their end times [s]."""
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
    Peer("Exudyn kinematic tree RK44", "exudyn_models", "exudyn", {"formulation": "tree"}),
    Peer("MJX RK4", "mjx_models", "mujoco.mjx", {"integrator": "RK4"}, only=(100, 1000)),
)
IMPLICIT = "Exudyn generalised alpha"
"""Head of the names of integrators for constrained systems; the faster one counts."""


class Plan(NamedTuple):
    """Sizes of a run: steps by code, repetitions, peers, steps of the long run."""

    own: tuple[int, ...]
    theirs: tuple[int, ...]
    repeats: int
    peers: tuple[Peer, ...]
    long: int


FULL = Plan(
    (8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1024, 4096, 16384),
    (50, 100, 200, 500, 1000, 2000, 5000, 10000),
    11,
    PEERS,
    10**6,
)
QUICK = Plan((16, 32, 64), (100, 1000), 3, PEERS[:2], 10**4)


def scene_of(model: str) -> gallery.Example:
    """The scene of a model, with its start."""
    if model != spinning_spacecraft.NAME:
        return gallery.load(model)
    example = gallery.load("spacecraft")
    spin, rows = jnp.asarray(spinning_spacecraft.SPIN), example.state.q
    # All rows turn about the origin, the centre of the base: points and directors alike.
    start = eqx.tree_at(lambda s: s.v, example.state, jnp.cross(spin, rows))
    return replace(example, name=model, state=start)


def own_runs(model: str, plan: Plan) -> list[dict[str, Any]]:
    """Times, errors and drifts of all orders."""
    example = scene_of(model)
    system, start = example.system, example.state
    shared = model in SHARED
    t_end = peer_measure.MODELS[model].T_END if shared else ALONE[model]
    judge = judge_of(model) if shared else None
    exact = None if shared else _reference(example, t_end).q
    found = []
    for order in ORDERS:
        scheme = nc.EnergyMomentum(order=order)
        run = endpoints(system, start, inputs=example.torques, scheme=scheme)
        jax.clear_caches()  # the reference may have compiled this order already
        compile_s = common.seconds(lambda run=run: jax.block_until_ready(run(t_end / 64, 2)))
        for steps in plan.own:
            if order > 2 and steps > 2048:
                continue
            call = lambda run=run, steps=steps: jax.block_until_ready(run(t_end / steps, steps))  # noqa: E731
            end = call()
            if int(end.result) != 0:
                continue
            timing = common.timed(call, steps, plan.repeats) | {"compile_s": compile_s}
            if judge is not None:
                errors = judge(beside.own_state(model, system, end.state))
            else:
                errors = {"error": float(np.max(np.abs(end.state.q - exact)))}
            drift = drift_of(system, start, end.state)
            newton = int(end.iterations) / steps
            code = f"{OWN}, order {order}"
            found.append({"code": code, "steps": steps, **timing, **errors, "drift": drift, "newton": newton})
        print(f"{model}: order {order} done", flush=True)
    return found


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
    """Largest energy drift of the heavy top over many steps, and its trend in terms of its noise."""
    example = gallery.load("heavy_top")
    every = steps // 1000
    trajectory = nc.simulate(
        example.system,
        example.state,
        dt=1e-3,
        steps=steps,
        save_every=every,
        scheme=nc.EnergyMomentum(order=2),
    )
    energy = example.system.energy(trajectory)
    scale = float(np.max(energy.kinetic + sum(np.abs(v) for v in energy.stores.values())))
    drift = (np.asarray(energy.total) - float(energy.total[0])) / scale
    slope = np.polyfit(np.linspace(0, 1, drift.size), drift, 1)[0]
    return {"steps": steps, "largest_drift": float(np.max(np.abs(drift))), "trend": float(slope)}


def times(runs: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Time [ms] to given errors, by code, and of the best order."""
    table = beside.equal_error(None, runs, ERRORS)
    own = [row for code, row in table.items() if code.startswith(OWN)]
    return {f"{OWN}, best order": _fastest(own), **table}


def _fastest(rows: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Shortest time to each error."""
    best: dict[str, float | None] = {}
    for error in map("{:g}".format, ERRORS):
        known = [t for row in rows if (t := row.get(error)) is not None]
        best[error] = min(known, default=None)
    return best


def targets(models: dict[str, Any]) -> list[dict[str, Any]]:
    """What is aimed at next to what was measured."""
    lines = []
    for model in (m for m in SHARED if m in models):
        table = models[model]["time_to_error"]
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
    axes[-1].set_visible(False)
    codes = list(dict.fromkeys(r["code"] for found in results["models"].values() for r in found["runs"]))
    own = [code for code in codes if code.startswith(OWN)]
    looks = {code: ("o-", 1.8, f"C{k}") for k, code in enumerate(own)}
    looks |= {
        code: ("s--", 1.0, f"C{len(own) + k}" if len(own) + k < 10 else "black")
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
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.peer_parser("What accuracy costs in time, beside other codes.", "the figure")
    every = (*SHARED, *ALONE)
    parser.add_argument("--models", nargs="+", choices=every, default=every, help="only these scenes")
    chosen = parser.parse_args()
    if chosen.redraw:
        common.redraw(chosen.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    plan = QUICK if chosen.quick else FULL
    results = common.circumstances("work_precision", quick=chosen.quick)
    peers = () if chosen.no_peers else beside.available(plan.peers, chosen.peers_python)
    bare = beside.QUICK._replace(repeats=plan.repeats, lanes=0)
    models: dict[str, Any] = {}
    for model in chosen.models:
        runs = own_runs(model, plan)
        for peer in peers if model in SHARED else ():
            for steps in peer.only or plan.theirs:
                run = beside.peer_run(peer, chosen.peers_python, model, steps, bare, judge_of(model))
                if run is not None and run["error"]:
                    runs.append(run | {"drift": run.get("energy_error")})
        models[model] = {"runs": runs, "time_to_error": times(runs)}
        rows = [("ms to error", *map("{:g}".format, ERRORS))]
        for code, row in models[model]["time_to_error"].items():
            rows.append((code, *("-" if t is None or math.isnan(t) else f"{t:.3g}" for t in row.values())))
        print(f"\n{model}\n{common.aligned(rows)}\n", flush=True)
    results |= {"models": models, "long": long_run(plan.long), "targets": targets(models)}
    print(
        f"{common.environment_line(results)}\n{results['long']}\n\n{common.show_targets(results['targets'])}"
    )
    common.write(results, draw, common.folder(chosen))


if __name__ == "__main__":
    main()
