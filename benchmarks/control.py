"""Optimal control: costs of the ready manoeuvres against known ones, and speed beside CasADi with IPOPT.

usage: python -m benchmarks.control [--quick] [--json FILE] [--peers-python PATH] [--no-peers]
       [--parts PART ...]

Accuracy: least costs at three numbers of steps, each twice the one before, and from the last two the limit
that order two predicts. Each solve but the first of a chain starts from nothing or, where the problem has
several optima, from the coarser solution; times are those of a second solve, after compilation.

Speed: the paper's spacecraft turned by its wheels, 100 steps, from rest and zero inputs. The peer solves the
same discrete problem, and a simpler one that only minimal coordinates allow, see
`benchmarks.peers.casadi_control`. Ours is timed as `nc.optimise` without progress, checks and Python's loop
included; the peer's is the call of its solver alone, its setup apart. All programs are compiled with full
effort: by default, the first solves run quick ones.
"""

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import natcoord_jax as nc
from benchmarks import common
from natcoord_jax.control import sequential
from natcoord_jax.control.guess import unknowns_of
from natcoord_jax.control.iterate import Options
from natcoord_jax.control.problem import numeric
from natcoord_jax.gallery import manoeuvres

OWN = "natcoord_jax"
PARTS = ("speed", "cases", "cart", "pendulum")
STEPS = 100
REPEATS = 7
SHARE = 0.5
"""Part of CasADi's time that is aimed at."""
SWITCHES = (1.00268, 2.10893, 3.21519)
"""Of two masses in least time [s]."""
PENDULUM = {"least of Betts": 12.8738850, "second of Betts": 76.552, "third of Betts": 94.119}
SAME = 0.05
"""Relative change of the cost at twice the steps below which an optimum is taken for the same."""
FASTEST = 12.0
"""Largest rate of the pendulum's guesses [rad/s]."""
CART = {"known extremal": 57.9448, "published, Dymos": 58.8839}


class Case(NamedTuple):
    """One line of the table of accuracy.

    Attributes:
        name: in the table.
        problem: by the number of steps.
        steps: the smallest number.
        known: cost, exact or published; None: unknown.
        warm: whether solves start from the coarser solution.
    """

    name: str
    problem: Callable[[int], nc.OptimalControl]
    steps: int
    known: float | None
    warm: bool = False


CASES = (
    Case("beanie", manoeuvres.beanie, 20, 12 * 0.75**2),
    Case("two masses, least effort", manoeuvres.two_masses, 60, 0.2271424),
    Case("two masses, least time", lambda n: manoeuvres.two_masses(n, fastest=True), 60, 4.21786651, True),
    Case("turn, principal axis", lambda n: manoeuvres.turn(n, axis=(0, 0, 1), angle=1.0), 20, 108.0),
    Case("turn", manoeuvres.turn, 20, 120.852118),
    Case("turn by wheels", lambda n: manoeuvres.turn(n, wheels=True), 20, 129.028096),
)


class Peer(NamedTuple):
    """One way to solve by CasADi."""

    name: str
    same: bool
    settings: dict[str, Any]


FAST = {"mumps_permuting_scaling": 0, "mumps_scaling": 0, "mu_strategy": "adaptive"}
PEERS = (
    Peer("CasADi, same equations", True, {"model": "directors"}),
    Peer("CasADi, same equations, tuned", True, {"model": "directors", "settings": FAST}),
    Peer("CasADi, same equations, tuned, C", True, {"model": "directors", "settings": FAST, "jit": True}),
    Peer("CasADi, minimal coordinates", False, {"model": "minimal", "transcription": "unrolled"}),
    Peer("CasADi, minimal coordinates, tuned", False, {"model": "minimal", "settings": FAST}),
    Peer(
        "CasADi, minimal coordinates, tuned, C",
        False,
        {"model": "minimal", "transcription": "unrolled", "settings": FAST, "jit": True},
    ),
)


def limit(costs: list[float]) -> tuple[float, float | None]:
    """Extrapolated cost from the last two, and the ratio of successive differences; near 4 for order two."""
    extrapolated = costs[-1] + (costs[-1] - costs[-2]) / 3
    ratio = None
    if len(costs) > 2 and costs[-1] != costs[-2]:
        ratio = (costs[-3] - costs[-2]) / (costs[-2] - costs[-1])
    return extrapolated, ratio


def line(
    name: str, known: float | None, solutions: list[nc.Solution], seconds: float | None
) -> dict[str, Any]:
    """One line of the table."""
    costs = [s.cost for s in solutions]
    found = {
        "name": name,
        "steps": [s.problem.steps for s in solutions],
        "costs": costs,
        "outcomes": [s.outcome.name for s in solutions],
        "iterations": len(solutions[-1].history),
        "second_solve_s": seconds,
        "known": known,
    }
    if len(costs) > 1:
        extrapolated, ratio = limit(costs)
        error = None if known is None else abs(extrapolated / known - 1)
        found |= {"extrapolated": extrapolated, "ratio": ratio, "relative_error": error}
    return found


def solved(problem: nc.OptimalControl, guess: Any = None, method: str = "auto") -> tuple[nc.Solution, float]:
    """Solution, and the time of a second solve [s]."""
    found = nc.optimise(problem, guess, method=method, progress=False)
    return found, common.seconds(lambda: nc.optimise(problem, guess, method=method, progress=False))


def measured(case: Case, quick: bool) -> dict[str, Any]:
    """Costs of one case."""
    numbers = [case.steps << k for k in range(2 if quick else 3)]
    pairs: list[tuple[nc.Solution, float]] = []
    for n in numbers:
        pairs.append(solved(case.problem(n), pairs[-1][0] if case.warm and pairs else None))
    found = line(case.name, case.known, [s for s, _ in pairs], pairs[-1][1])
    if case.known == 4.21786651:
        found |= {"switches": switches(pairs[-1][0]), "known_switches": SWITCHES}
    return found


def switches(solution: nc.Solution) -> list[float]:
    """Times at which an input in +-1 changes sign [s], within a step from its mean value there."""
    u, found, k = np.asarray(solution.inputs)[:, 0], [], 0
    while k < len(u) - 1:
        sign = np.sign(u[k])
        ahead = np.flatnonzero(u[k:] * sign < -0.99)
        if not ahead.size:
            break
        end = k + int(ahead[0])
        found.append(solution.dt * (k + float(np.sum((1 + sign * u[k:end]) / 2))))
        k = end
    return found


def refined(
    first: nc.Solution, problem: Callable[[int], nc.OptimalControl], numbers: list[int], name: str, known: Any
) -> dict[str, Any]:
    """A chain of solutions, each from the one before."""
    chain, seconds = [first], None
    lost = ""
    for n in numbers:
        for method in ("lifted", "shooting"):
            found, time_taken = solved(problem(n), chain[-1], method)
            if found.ok and abs(found.cost / chain[-1].cost - 1) < SAME:
                break
            lost = f"{n} steps: {found.outcome.name}, cost {found.cost:.7g}"
        else:
            # Another optimum, or none: the chain ends here.
            break
        chain.append(found)
        seconds, lost = time_taken, ""
    return line(name, known, chain, seconds) | {"lost": lost}


def _circling(steps: int, target: float, t_end: float = 3.0) -> nc.Guess:
    """The pendulum's bob on its circle at a constant rate to an angle [rad]."""
    angle = np.linspace(0.0, target, steps + 1)
    places = np.stack([np.cos(angle), np.sin(angle), np.zeros(steps + 1)], axis=1)
    return nc.Guess(rates=np.diff(places, axis=0) * steps / t_end)


def pendulum(quick: bool) -> list[dict[str, Any]]:
    """All optima of the point pendulum found from constant rates to every angle where x = 0."""
    steps = 60 if quick else 120
    problem = manoeuvres.point_pendulum(steps)
    turns = int((3.0 * FASTEST + math.pi / 2) // math.pi)
    guesses = [_circling(steps, -math.pi / 2 + k * math.pi) for k in range(-turns + 1, turns + 1)]
    optima = []
    for method in ("lifted",) if quick else ("lifted", "shooting"):
        every = guesses if method == "lifted" else [_driven(g, steps) for g in guesses]
        optima += [s for s in nc.multi_start(problem, every, method=method) if s.ok]
    optima.sort(key=lambda s: s.cost)
    kept = [s for k, s in enumerate(optima) if k == 0 or s.cost > optima[k - 1].cost * (1 + 1e-6)]
    lines = []
    for k, s in enumerate(kept[: 2 if quick else 14]):
        near = [name for name, cost in PENDULUM.items() if abs(s.cost / cost - 1) < 0.03]
        known = PENDULUM[near[0]] if near else None
        found = refined(s, manoeuvres.point_pendulum, [2 * steps, 4 * steps], f"pendulum {k + 1}", known)
        lines.append(found | {"top": bool(float(s.trajectory.states.q[-1, 0, 1]) > 0)})
    return lines


def _driven(guess: nc.Guess, steps: int) -> nc.Guess:
    """Inputs that bring the pendulum's bob, if weightless, to the rate of a guess in a tenth of the time."""
    rates = np.asarray(guess.rates)
    start = np.linalg.norm(rates[0]) * np.sign(rates[0, 1])
    inputs = np.zeros((steps, 1))
    count = max(steps // 10, 1)
    inputs[:count] = -start / (count * 3.0 / steps)
    return nc.Guess(inputs=inputs)


def cart(quick: bool) -> list[dict[str, Any]]:
    """The swing-up on a cart: from nothing, and from many starts."""
    numbers = [100] if quick else [100, 200]
    first = nc.optimise(manoeuvres.cart_pole(50), method="lifted", progress=False)
    lines = [refined(first, manoeuvres.cart_pole, numbers, "cart-pole, direct", CART["published, Dymos"])]
    if not quick:
        kept = nc.multi_start(manoeuvres.cart_pole(50), starts=24, rates=3.0, spread=5.0, method="lifted")
        lines.append(
            refined(kept[0], manoeuvres.cart_pole, numbers, "cart-pole, best of 24", CART["known extremal"])
        )
    return lines


def own(name: str, problem: nc.OptimalControl, repeats: int) -> dict[str, Any]:
    """Times of natcoord_jax."""
    first = common.seconds(lambda: nc.optimise(problem, progress=False))
    times, solution = [], None
    for _ in range(repeats):
        start = time.perf_counter()
        solution = nc.optimise(problem, progress=False)
        times.append(time.perf_counter() - start)
    median = statistics.median(times)
    return {
        "code": name,
        **common.about(float(solution.dt), problem.steps),
        "cost": solution.cost,
        "iterations": len(solution.history),
        "outcome": solution.outcome.name,
        "solve_s": median,
        "solve_s_range": [min(times), max(times)],
        "repeats": repeats,
        "setup_s": first - median,
        "explained": solution.explain(),
    }


def profile(problem: nc.OptimalControl, repeats: int) -> dict[str, float]:
    """Milliseconds of the parts of one iteration, and of what goes before."""
    problem, options = numeric(problem), Options()
    unknowns = unknowns_of(problem, None, False)
    iterate = sequential.init(problem, options, unknowns)
    iterate = sequential.step(problem, options, sequential.step(problem, options, iterate))
    proposal = sequential.propose(problem, options, iterate)
    found, multipliers = sequential.tried(problem, options, iterate, proposal)
    given = (problem, found.unknowns, multipliers, found.slacks, found.path, iterate.unit)
    derivatives = sequential.linearised(*given)
    last = (options, iterate, proposal, found, multipliers, derivatives)
    parts = {
        "init": lambda: sequential.init(problem, options, unknowns),
        "propose": lambda: sequential.propose(problem, options, iterate),
        "tried": lambda: sequential.tried(problem, options, iterate, proposal),
        "linearised": lambda: sequential.linearised(*given),
        "concluded": lambda: sequential.concluded(*last),
    }

    def once(part: Callable[[], Any]) -> float:
        return 1e3 * common.seconds(lambda: jax.block_until_ready(part()))

    return {name: statistics.median(once(part) for _ in range(repeats + 1)) for name, part in parts.items()}


def peer_run(peer: Peer, python: str, steps: int, repeats: int) -> dict[str, Any] | None:
    """Times of a peer in a process of its own; None, with a line, if it fails."""
    settings = peer.settings | {"repeats": repeats}
    words = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in settings.items()]
    command = [python, "-m", "benchmarks.peers.casadi_control", "reorientation", str(steps), *words]
    run = subprocess.run(command, capture_output=True, text=True, cwd=common.ROOT)
    try:
        return {"code": peer.name, "same_equations": peer.same} | json.loads(run.stdout.splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        reason = (run.stderr.strip().splitlines() or [f"exit code {run.returncode}"])[-1]
        print(f"{peer.name}: left out, {reason}")
        return None


def peer_cart(python: str) -> list[dict[str, Any]]:
    """The cart-pole by collocation: limits, and what the published number contains."""
    runs = [(n, "trapezoidal", False) for n in (50, 100, 200)]
    runs += [(n, "hermite_simpson", released) for released in (False, True) for n in (40, 200)]
    found = []
    for steps, method, released in runs:
        words = [f"method={method}", f"released={json.dumps(released)}"]
        command = [python, "-m", "benchmarks.peers.casadi_control", "cart_pole", str(steps), *words]
        run = subprocess.run(command, capture_output=True, text=True, cwd=common.ROOT)
        if run.returncode == 0:
            found.append(json.loads(run.stdout.splitlines()[-1]))
    return found


NOTE = (
    "58.8839 is the reference, tolerance 1e-3, of a test of Dymos whose problem also asks for f(T) = 0. With "
    "that, Hermite-Simpson with 40 segments gives 58.83924863 here, to all digits another reference of the "
    "same test; without it the converged cost of this extremal is 58.80767. 58.8839 itself is not met."
)


def targets(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The target of time next to what was measured, against the quickest peer of each kind."""
    mine, lines = runs[0], []
    for same, word in ((True, "the same equations"), (False, "minimal coordinates")):
        theirs = [r["solve_s"] for r in runs if r.get("same_equations") is same]
        ratio = mine["solve_s"] / min(theirs) if theirs else None
        lines.append(common.target(f"time of a solve over CasADi's, {word}", ratio, SHARE))
    return lines


def _number(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)


def tables(results: dict[str, Any]) -> str:
    """Everything as plain text."""
    rows = [("manoeuvre", "steps", "costs", "limit", "ratio", "known", "error", "iter", "second s")]
    for r in results["accuracy"]:
        shown = (_number(r.get("extrapolated"), ".8g"), _number(r.get("ratio"), ".2f"))
        known = (_number(r["known"], ".9g"), _number(r.get("relative_error"), ".0e"))
        costs = " ".join(f"{c:.7g}" for c in r["costs"])
        last = (f"{r['iterations']}", _number(r["second_solve_s"], ".3f"))
        rows.append((r["name"], f"{r['steps'][0]}..{r['steps'][-1]}", costs, *shown, *known, *last))
    parts = [common.aligned(rows)]
    rows = [("reorientation, 100 steps", "cost", "iterations", "solve ms", "setup s", "outcome")]
    for r in results["runs"]:
        times = (f"{1e3 * r['solve_s']:.1f}", f"{r['setup_s']:.1f}")
        rows.append((r["code"], f"{r['cost']:.10g}", f"{r['iterations']}", *times, r["outcome"]))
    parts.append(common.aligned(rows))
    parts.append("ms: " + ", ".join(f"{name} {ms:.1f}" for name, ms in results["profile"].items()))
    return "\n\n".join(parts)


def options() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description="Optimal control: accuracy, and speed beside CasADi.")
    parser.add_argument("--quick", action="store_true", help="few sizes and repetitions, for a first look")
    default = common.RESULTS / "control.json"
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help=f"where results go; default {default.relative_to(common.ROOT)}, with --quick: nowhere",
    )
    parser.add_argument(
        "--peers-python",
        default=sys.executable,
        metavar="PATH",
        help="interpreter that has CasADi; default this one, with the extra [benchmarks]",
    )
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=list(PARTS), help="only these, the rest kept as in FILE"
    )
    parser.add_argument("--no-peers", action="store_true", help="natcoord_jax alone")
    chosen = parser.parse_args()
    chosen.json = chosen.json or (None if chosen.quick else default)
    return chosen


def speed(chosen: argparse.Namespace) -> dict[str, Any]:
    """Everything about time."""
    quick, repeats = chosen.quick, 3 if chosen.quick else REPEATS
    runs = [own(OWN, manoeuvres.reorientation(STEPS), repeats)]
    results: dict[str, Any] = {"profile": profile(manoeuvres.reorientation(STEPS), repeats)}
    if not chosen.no_peers:
        every = (peer_run(peer, chosen.peers_python, STEPS, repeats) for peer in PEERS[:: 3 if quick else 1])
        runs += [run for run in every if run]
        results["cart_pole_by_collocation"] = peer_cart(chosen.peers_python)
    if not quick:
        for working in ((1, 2), (2,)):
            problem = manoeuvres.reorientation(STEPS, working=working)
            runs.append(own(f"{OWN}, wheels {working} only", problem, repeats))
    return results | {"runs": runs, "targets": targets(runs), "cart_pole_note": NOTE}


def main() -> None:
    """Run the benchmark."""
    chosen = options()
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    nc.set_effort("full")
    now = common.circumstances("control", quick=chosen.quick)
    results: dict[str, Any] = {"parts": {}, "runs": [], "targets": [], "profile": {}, "accuracy": []}
    if chosen.json and chosen.json.exists() and chosen.parts != list(PARTS):
        results |= json.loads(chosen.json.read_text("utf-8"))
    results |= now
    cases = CASES[: 2 if chosen.quick else None]
    lines: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "cases": lambda: [measured(case, chosen.quick) for case in cases],
        "cart": lambda: cart(chosen.quick),
        "pendulum": lambda: pendulum(chosen.quick),
    }
    for part in chosen.parts:
        if part == "speed":
            results |= speed(chosen)
        elif not chosen.quick or part == "cases":
            kept = [x for x in results["accuracy"] if x["part"] != part]
            results["accuracy"] = kept + [{"part": part} | x for x in lines[part]()]
        kept_of_run = {key: now[key] for key in ("date", "commit", "uncommitted_changes")}
        results["parts"][part] = kept_of_run | {"effort": "full"}
        print(f"{part} done", flush=True)
        _write(results, chosen.json)
        # Every program takes regions of memory, of which a process on Linux has 65 530.
        jax.clear_caches()
    versions = {run["version"] for run in results["runs"] if "version" in run}
    results["versions"] |= {"peers": {"casadi": ", ".join(sorted(versions))} if versions else {}}
    print(f"\n{common.environment_line(results)}\n\n{tables(results)}\n")
    print(common.show_targets(results["targets"]))
    _write(results, chosen.json)


def _write(results: dict[str, Any], file: Path | None) -> None:
    """Write the JSON, as far as it is."""
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
