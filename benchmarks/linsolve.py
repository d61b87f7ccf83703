"""Sparse linear solvers beside KLU: time to factorise and solve, compile time, residual; on one core.

usage: python -m benchmarks.linsolve [--quick] [--output FOLDER] [--redraw JSON]
                                     [--peers-python PATH] [--no-peers]

Synthetic systems with the patterns of chains, trees, loops, frames and shells (benchmarks/patterns.py). Times
are medians, in seconds of the processor, of a compiled loop that factorises and solves again and again, with
the numbers of the matrix given. The target compares with KLU's full factorisation and solution; its
refactorisation, which keeps the order of the pivots, is reported beside it. Ours are quoted without and with
one step of refinement.

The peer runs in a process of its own: `pip install klujax` for the interpreter given by --peers-python.
"""

import json
import subprocess
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common, patterns
from natcoord_jax.linsolve.blocks import BlockMatrix, block_pattern
from natcoord_jax.linsolve.sparse import Plan, choose, factorised

SYSTEMS = (
    "ring:4",
    "ring:10",
    "ladder:32",
    "chain:16",
    "chain:64",
    "chain:256",
    "chain:1024",
    "body_chain:64",
    "body_chain:256",
    "body_tree:64",
    "body_tree:256",
    "body_tree:1024",
    "frame:16,16",
    "shell:8,8",
    "shell:16,16",
    "shell:16,16,1",
    "shell:32,32",
    "chain:64,9,1e-8",
    "body_chain:64,1e-8",
)
QUICK = ("ring:10", "chain:16", "shell:8,8")
HALF = ("shell:16,16", "shell:16,16,1", "shell:32,32")  # at most half of KLU's time
NO_SLOWER = ("chain:64", "chain:256", "chain:1024", "body_chain:64", "body_chain:256")
NO_SLOWER += ("body_tree:64", "body_tree:256", "body_tree:1024")
COMPILED = "shell:32,32"
LOOP = 0.02  # seconds that one timed run of the loop takes, about
MOST_DENSE = 720  # unknowns up to which LAPACK is timed, too


def looped(solve: Any, plan: Plan, matrix: BlockMatrix, right: jax.Array, loops: int) -> Any:
    """A compiled program that solves `loops` times, and what it takes."""

    def program(plan, matrix, right):
        def body(_, carry):
            matrix, x = carry
            # Depends on the last solution, so that nothing is moved out of the loop.
            tiles = matrix.tiles * (1.0 + 1e-200 * x[0])
            return eqx.tree_at(lambda m: m.tiles, matrix, tiles), solve(plan, matrix, right)

        return jax.lax.fori_loop(0, loops, body, (matrix, right))[1]

    compiled = jax.jit(program)
    return lambda: compiled(plan, matrix, right).block_until_ready()


def plain(plan: Plan, matrix: BlockMatrix, right: jax.Array) -> jax.Array:
    """Factors and solution."""
    return factorised(plan, matrix).solve(right)


def refined(plan: Plan, matrix: BlockMatrix, right: jax.Array) -> jax.Array:
    """The same with one step of refinement."""
    factors = factorised(plan, matrix)
    x = factors.solve(right)
    return x + factors.solve(right - matrix.multiply(x))


def dense(plan: Plan, matrix: BlockMatrix, right: jax.Array) -> jax.Array:
    """LAPACK on the dense matrix, its assembly included."""
    return jnp.linalg.solve(matrix.to_dense(), right)


def measure(name: str, repeats: int, peers_python: str | None) -> dict[str, Any]:
    """Times, compile time and residual of one system, beside the peer."""
    system = patterns.named(name)
    found: dict[str, Any] = {"system": name, "title": system.name, "unknowns": system.size}
    made: Any = None

    def analyse() -> None:
        nonlocal made
        pattern, entries = block_pattern(system.nodes, list(system.elements))
        matrix = pattern.assemble(*map(jnp.asarray, system.matrices))
        plan = choose(pattern, entries, matrices=[matrix], coordinates=system.coordinates)
        made = plan, matrix, len(entries.rows)

    found["analysis_s"] = common.seconds(analyse, time.process_time)
    plan, matrix, found["entries"] = made
    right = jnp.asarray(patterns.right_hand_side(system))
    found["solver"] = plan.name
    once = looped(plain, plan, matrix, right, 1)
    once()
    loops = max(1, int(LOOP / min(common.seconds(once, time.process_time) for _ in range(5))))
    for key, solve in (("plain", plain), ("refined", refined), ("dense", dense)):
        if solve is not dense or system.size <= MOST_DENSE:
            run = looped(solve, plan, matrix, right, loops)
            found[key] = common.timed(run, loops, repeats, time.process_time)
            found[key]["residual"] = patterns.backward_error(system, np.asarray(run()))
    found["klu"] = None if peers_python is None else klu(peers_python, name, repeats, loops)
    return found


def klu(python: str, name: str, repeats: int, loops: int) -> dict[str, Any]:
    """The same of the peer."""
    command = [python, "-m", "benchmarks.peers.klu", name, str(repeats), str(loops)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=common.ROOT)
    if run.returncode:
        raise RuntimeError(f"KLU on {name} failed; is klujax installed for {python}?\n{run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


def targets(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The targets next to what was measured."""
    by_name = {run["system"]: run for run in runs}

    def over_klu(name: str) -> float | None:
        run = by_name.get(name)
        if run is None or run["klu"] is None:
            return None
        return run["plain"]["us_per_step"] / run["klu"]["full"]["us_per_step"]

    lines = [common.target(f"{n}: time over KLU's", over_klu(n), 0.5) for n in HALF]
    lines += [common.target(f"{n}: time over KLU's", over_klu(n), 1.0) for n in NO_SLOWER]
    compiling = by_name[COMPILED]["plain"]["compile_s"] if COMPILED in by_name else None
    lines.append(common.target(f"{COMPILED}: compile time", compiling, 15.0, "s"))
    ratios = [run["refined"]["residual"] for run in runs if "e-8" in run["system"]]
    lines.append(common.target("mass ratio 1e8: residual", max(ratios, default=None), 1e-12))
    lines.append(common.target("largest residual", max(run["refined"]["residual"] for run in runs), 1e-12))
    return lines


def show(runs: list[dict[str, Any]]) -> str:
    """Runs as plain text, times in ms."""
    heads = "system,n,solver,ms,refined,KLU full,refactor,dense,ratio,compile s,residual"
    rows: list[Sequence[str]] = [heads.split(",")]
    for run in runs:

        def ms(*keys: str, run: Any = run) -> str:
            for key in keys:
                run = run.get(key) if run else None
            return f"{run['us_per_step'] / 1e3:.3f}" if run else "-"

        peer = run["klu"]
        ratio = f"{run['plain']['us_per_step'] / peer['full']['us_per_step']:.2f}" if peer else "-"
        times = (ms("plain"), ms("refined"), ms("klu", "full"), ms("klu", "refactor"), ms("dense"))
        compiling, residual = f"{run['plain']['compile_s']:.1f}", f"{run['refined']['residual']:.0e}"
        rows.append([run["title"], str(run["unknowns"]), run["solver"], *times, ratio, compiling, residual])
    return common.aligned(rows)


def draw(results: dict[str, Any]) -> Any:
    """Time over the number of unknowns, ours and KLU's, and compile time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    speed, compiling = figure.subplots(1, 2)
    runs = [run for run in results["runs"] if "e-8" not in run["system"]]
    kinds = list(dict.fromkeys(run["system"].partition(":")[0] for run in runs))
    for number, kind in enumerate(kinds):
        own = [run for run in runs if run["system"].startswith(kind + ":")]
        x, color = [run["unknowns"] for run in own], f"C{number}"
        speed.loglog(x, [r["plain"]["us_per_step"] / 1e3 for r in own], "o-", color=color, label=kind)
        beside = [(r["unknowns"], r["klu"]["full"]["us_per_step"] / 1e3) for r in own if r["klu"]]
        if beside:
            speed.loglog(*zip(*beside), "x--", color=color)
        compiling.semilogx(x, [r["plain"]["compile_s"] for r in own], "o", color=color, label=kind)
    compiling.axhline(15.0, color="k", ls=":", lw=1, label="target")
    speed.set(title="factor and solve [ms]; dashed: KLU", xlabel="unknowns")
    compiling.set(title="compile time [s]", xlabel="unknowns", ylim=(0, None))
    for axes in (speed, compiling):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    options = common.peer_parser("Sparse linear solvers beside KLU.", "the figure").parse_args()
    if options.redraw:
        common.redraw(options.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("linsolve", quick=options.quick)
    names, repeats = (QUICK, 5) if options.quick else (SYSTEMS, 15)
    runs = []
    for name in names:
        runs.append(measure(name, repeats, None if options.no_peers else options.peers_python))
        print(f"{name}: {runs[-1]['plain']['us_per_step'] / 1e3:.3f} ms", flush=True)
    results |= {"runs": runs, "targets": targets(runs)}
    print(f"\n{common.environment_line(results)}\n\n{show(runs)}\n")
    print(common.show_targets(results["targets"]))
    common.write(results, draw, common.folder(options))


if __name__ == "__main__":
    main()
