"""What the benchmarks share: one core, timing by median, targets, machine and versions, JSON."""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
FLAGS = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
ONE_THREAD = {
    "XLA_FLAGS": FLAGS,
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_COMPILATION_CACHE": "false",  # compile times are those of a first run
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
PACKAGES = ("natcoord-jax", "jax", "jaxlib", "equinox", "numpy")
CODE = ("natcoord_jax", "benchmarks", ":(exclude)benchmarks/results")
"""What figures depend on: those of the benchmark before are no change."""


def on_one_core() -> None:
    """Start this process again on one core and with one thread, unless it runs so already.

    Thread pools take their size when libraries are imported, so it is too late to pin a running process.
    Processes that this one starts inherit core and settings. Outside Linux the core is not pinned.
    """
    several = False
    if sys.platform == "linux":
        cores = os.sched_getaffinity(0)
        several = len(cores) > 1
        os.sched_setaffinity(0, {max(cores)})
    if several or any(os.environ.get(key) != value for key, value in ONE_THREAD.items()):
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | ONE_THREAD)


def parser(description: str, figure: str) -> argparse.ArgumentParser:
    """The options that all benchmarks have."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--quick", action="store_true", help="few sizes and repetitions, for a first look")
    options.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help=f"where JSON and figure go; default {RESULTS.relative_to(ROOT)}, with --quick: nowhere",
    )
    options.add_argument("--redraw", type=Path, metavar="JSON", help=f"only make {figure} from this file")
    return options


def peer_parser(description: str, figure: str) -> argparse.ArgumentParser:
    """The same with those of benchmarks that run other codes, too."""
    options = parser(description, figure)
    options.add_argument(
        "--peers-python",
        default=sys.executable,
        metavar="PATH",
        help="interpreter that has the peers; default this one, with the extra [benchmarks]",
    )
    options.add_argument("--no-peers", action="store_true", help="natcoord_jax alone")
    return options


def seconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Time of one call [s], wall time unless another clock is given."""
    start = clock()
    call()
    return clock() - start


def timed(
    call: Callable[[], object],
    count: int,
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Any]:
    """Time of a compiled program that makes `count` steps.

    Args:
        call: runs the program and waits for its end; the first call compiles.
        count: number of steps (or of steps times lanes) of one call.
        repeats: number of timed calls, after the one that compiles and one more.
        clock: wall time, or `time.process_time`, which what else runs on the machine disturbs less.

    Returns:
        us_per_step (the median), us_per_step_range, repeats, and compile_s: the first call less the median.
    """
    (timing,) = timed_in_turn((call,), count, repeats, clock)
    del timing["over_first"]
    return timing


def timed_in_turn(
    calls: Sequence[Callable[[], object]],
    count: int,
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> list[dict[str, Any]]:
    """Times of compiled programs that are to be compared, called one after the other, again and again.

    What slows the machine for a while then slows all of them, and leaves the ratios what they are.

    Args:
        calls: each runs a program and waits for its end.
        count: number of steps (or of steps times lanes) of one call.
        repeats: number of rounds, after the first calls, which compile, and one more of each.
        clock: see `timed`.

    Returns:
        by call what `timed` returns, and over_first: the median of its time over that of the first call in
        the same round.
    """
    first = [seconds(call, clock) for call in calls]
    for call in calls:
        call()
    rounds = [[seconds(call, clock) for call in calls] for _ in range(repeats)]
    found = []
    for k, compiling in enumerate(first):
        times = [times[k] for times in rounds]
        median = statistics.median(times)
        found.append(
            {
                "us_per_step": 1e6 * median / count,
                "us_per_step_range": [1e6 * min(times) / count, 1e6 * max(times) / count],
                "repeats": repeats,
                "compile_s": compiling - median,
                "over_first": statistics.median(times[k] / times[0] for times in rounds),
            }
        )
    return found


def about(dt: float, steps: int, order: int = 2) -> dict[str, Any]:
    """What a time a step of ours is of: scheme, step [s], number of steps, and effort to compile.

    Times are those of programs with full effort, never of the quick ones that `nc.simulate` begins with.
    """
    return {"scheme": f"energy-momentum, order {order}", "dt": dt, "steps": steps, "effort": "full"}


def target(name: str, measured: float | None, limit: float, unit: str = "") -> dict[str, Any]:
    """One line of the table of targets: reached when `measured` is at most `limit`; None: not measured."""
    reached = None if measured is None else bool(measured <= limit)
    return {"name": name, "measured": measured, "target": limit, "unit": unit, "reached": reached}


def show_targets(targets: Sequence[dict[str, Any]]) -> str:
    """The table of targets as aligned plain text."""
    words = {True: "reached", False: "NOT REACHED", None: "not measured"}
    rows = [("target", "at most", "measured", "")]
    for t in targets:
        measured = "-" if t["measured"] is None else f"{t['measured']:.3g}"
        rows.append((t["name"], f"{t['target']:.3g} {t['unit']}".strip(), measured, words[t["reached"]]))
    return aligned(rows)


def columns(runs: Sequence[dict[str, Any]], heads: dict[str, tuple[str, str]]) -> str:
    """Runs as plain text, one a line.

    Args:
        runs: with the keys of `heads`.
        heads: by key the head of its column and the format of its values.
    """
    rows = [[format(run[key], form) for key, (_, form) in heads.items()] for run in runs]
    return aligned([[head for head, _ in heads.values()], *rows])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of words in columns, the first to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            f"{word:<{width}}" if k == 0 else f"{word:>{width}}"
            for k, (word, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _git(*words: str) -> str:
    try:
        run = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return run.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def circumstances(name: str, *, quick: bool) -> dict[str, Any]:
    """What a reader must know about a run: machine, versions, commit, load at its start."""
    return {
        "benchmark": name,
        "quick": quick,
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "commit": _git("rev-parse", "HEAD") or None,
        "uncommitted_changes": bool(_git("status", "--porcelain", "--", *CODE)),
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "cores_used": len(os.sched_getaffinity(0)) if sys.platform == "linux" else None,
            "load_at_start": os.getloadavg()[0],
            "system": platform.platform(),
            "xla_flags": FLAGS,
        },
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES},
    }


def folder(options: argparse.Namespace) -> Path | None:
    """Where the results of a run go; None: nowhere."""
    return options.output or (None if options.quick else RESULTS)


def write(results: dict[str, Any], draw: Callable[[dict[str, Any]], Any] | None, where: Path | None) -> None:
    """Write the JSON, and the figure made from it if there is one."""
    if where is None:
        return
    where.mkdir(parents=True, exist_ok=True)
    file = where / f"{results['benchmark']}.json"
    file.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n", "utf-8")
    if draw is not None:
        redraw(file, draw)


def redraw(file: Path, draw: Callable[[dict[str, Any]], Any]) -> None:
    """Make the figure that belongs to a JSON file, beside it."""
    figure = draw(json.loads(file.read_text("utf-8")))
    figure.savefig(file.with_suffix(".png"), dpi=150)
    print(f"wrote {file} and {file.with_suffix('.png').name}")


def environment_line(results: dict[str, Any]) -> str:
    """Machine, commit and versions in one line, for titles."""
    v, machine = results["versions"], results["machine"]
    commit = (results["commit"] or "?")[:8] + ("+" if results["uncommitted_changes"] else "")
    return f"{machine['processor']}, one core; commit {commit}, jax {v['jax']}"
