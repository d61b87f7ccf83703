"""Optimal control side by side with CasADi and Crocoddyl: the same manoeuvres, each from its default start.

usage: python -m benchmarks.control_peers [--problems NAME ...] [--rounds N] [--crocoddyl-python PATH]
       [--no-peers] [--json FILE]

One core; all codes wait, and solve in turn, `--rounds` times: medians. CasADi with IPOPT solves the
implicit midpoint rule in joint coordinates from a straight line at rest (the spacecraft: exactly our
equations, and in minimal coordinates at zero momentum), Crocoddyl symplectic Euler from rest with the goal as
a penalty; so that costs differ by the schemes, and "missed" is what is left of goal and equations. Ours is
timed as `nc.optimise`, and once more with IPOPT on `nc.to_nlp(states=True)`: same equations, other solver.
"first" is the first solve with compiling (ours) or with setting up the solver (theirs), by the clock; "warm"
are seconds of the processor, which other jobs on it do not change.
"""

import argparse
import json
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
from benchmarks import common, control_problems
from natcoord_jax.control import ipopt
from natcoord_jax.gallery import manoeuvres

ROUNDS = 5
TIMES = ("seconds", "processor_s")
"""By the clock, and of the processor."""


class Case(NamedTuple):
    """A manoeuvre.

    Attributes:
        problem: ours.
        steps: of all codes.
        peers: name, module and its arguments of each.
    """

    problem: Callable[[], nc.OptimalControl]
    steps: int
    peers: tuple[tuple[str, str, str], ...]


ARMS, CROCODDYL = "benchmarks.peers.casadi_arms", "benchmarks.peers.crocoddyl_control"
CRAFT = "benchmarks.peers.casadi_control"
CASES = {
    "cart-pole": Case(
        lambda: manoeuvres.cart_pole(100),
        100,
        (("CasADi, IPOPT", ARMS, "cart_pole 100"), ("Crocoddyl", CROCODDYL, "cart_pole 100")),
    ),
    "seven axes": Case(
        lambda: control_problems.panda(40, slow=True),
        40,
        (("CasADi, IPOPT", ARMS, "panda 40"), ("Crocoddyl", CROCODDYL, "panda 40")),
    ),
    "spacecraft": Case(
        lambda: manoeuvres.reorientation(100),
        100,
        (
            ("CasADi, IPOPT, same equations", CRAFT, "waiting 100 model=directors"),
            ("CasADi, IPOPT, zero momentum", CRAFT, "waiting 100 model=minimal"),
            ("Crocoddyl", CROCODDYL, "reorientation 100"),
        ),
    ),
}


class Waiting:
    """A peer in a process of its own that solves when it is asked."""

    def __init__(self, python: str, module: str, arguments: str) -> None:
        command = [python, "-m", module, *arguments.split()]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=common.ROOT,
        )
        self.about = self._line()

    def _line(self) -> dict[str, Any]:
        line = self.process.stdout.readline()  # type: ignore[union-attr]
        if not line:
            _, reason = self.process.communicate()
            raise RuntimeError((reason.strip().splitlines() or ["it said nothing"])[-1])
        return json.loads(line)

    def solve(self) -> dict[str, Any]:
        """Ask once."""
        self.process.stdin.write("\n")  # type: ignore[union-attr]
        self.process.stdin.flush()  # type: ignore[union-attr]
        return self._line()

    def close(self) -> None:
        """Let it end."""
        self.process.communicate()


def own(problem: nc.OptimalControl) -> dict[str, Any]:
    """One solve by `nc.optimise`."""
    start, busy = time.perf_counter(), time.process_time()
    found = nc.optimise(problem, progress=False)
    times = {"seconds": time.perf_counter() - start, "processor_s": time.process_time() - busy}
    missed = max(map(abs, found.missing.values()), default=0.0)
    return times | {
        "cost": float(found.cost),
        "iterations": len(found.history),
        "outcome": found.outcome.name,
        "violation": missed,
    }


def by_ipopt(problem: nc.OptimalControl) -> Callable[[], dict[str, Any]]:
    """IPOPT on our program with states."""
    program = nc.to_nlp(problem, states=True)

    def solve() -> dict[str, Any]:
        busy = time.process_time()
        answer = ipopt.solved(program, max_wall_time=200.0)
        times = {"seconds": answer.seconds, "processor_s": time.process_time() - busy}
        found = {"cost": answer.cost, "iterations": answer.iterations, "outcome": answer.status}
        values = np.asarray(program.constraints(answer.x))
        missed = np.max(np.maximum(values - program.upper, program.lower - values))
        return times | {"violation": float(missed)} | found

    return solve


def measured(name: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """All codes on one manoeuvre, in turn."""
    case = CASES[name]
    problem = case.problem()
    codes: dict[str, Callable[[], dict[str, Any]]] = {"natcoord_jax": lambda: own(problem)}
    first, peers = {}, []
    begun = time.perf_counter()
    codes["natcoord_jax"]()
    first["natcoord_jax"] = time.perf_counter() - begun
    begun = time.perf_counter()
    codes["our equations, IPOPT"] = by_ipopt(problem)
    codes["our equations, IPOPT"]()
    first["our equations, IPOPT"] = time.perf_counter() - begun
    about: dict[str, Any] = {code: {"version": nc.__version__} for code in codes}
    for peer, module, there in () if given.no_peers else case.peers:
        python = given.crocoddyl_python if module == CROCODDYL else sys.executable
        try:
            one = Waiting(python, module, there)
            seconds = one.solve()["seconds"]
        except (RuntimeError, OSError) as error:
            print(f"{name}: {peer} left out, {error}", flush=True)
            continue
        peers.append(one)
        codes[peer], about[peer] = one.solve, {"version": one.about["version"]}
        first[peer] = one.about["setup_s"] + seconds
    runs: dict[str, list[dict[str, Any]]] = {code: [] for code in codes}
    for _ in range(given.rounds):
        for code, solve in codes.items():
            runs[code].append(solve())
    for one in peers:
        one.close()
    return [
        {"problem": name, "code": code, "steps": case.steps, "first_s": first[code]}
        | about[code]
        | runs[code][-1]
        | {key: statistics.median(run[key] for run in runs[code]) for key in TIMES}
        | {f"{key}_range": [f(run[key] for run in runs[code]) for f in (min, max)] for key in TIMES}
        for code in codes
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """As plain text."""
    head = (
        "problem",
        "code",
        "cost",
        "missed",
        "iterations",
        "first s",
        "warm s",
        "ms an iteration",
        "outcome",
    )
    lines = [head]
    for r in rows:
        each = 1e3 * r["processor_s"] / max(1, r["iterations"])
        numbers = (f"{r['cost']:.7g}", f"{r['violation']:.0e}", f"{r['iterations']}", f"{r['first_s']:.1f}")
        times = (f"{r['processor_s']:.3f}", f"{each:.2f}")
        lines.append((r["problem"], r["code"], *numbers, *times, r["outcome"].replace("_", " ")))
    return common.aligned(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--problems", nargs="*", default=list(CASES), choices=list(CASES), metavar="NAME")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--crocoddyl-python", default=sys.executable, metavar="PATH")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    nc.set_effort("full")
    known = json.loads(given.json.read_text("utf-8")) if given.json and given.json.exists() else {}
    rows = known.get("rows", [])
    for name in given.problems:
        found = measured(name, given)
        print(table(found), flush=True)
        rows = [row for row in rows if row["problem"] != name] + found
        if given.json:
            now = common.circumstances("control_peers", quick=False)
            given.json.write_text(json.dumps(now | {"rows": rows}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
