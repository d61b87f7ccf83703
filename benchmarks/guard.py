"""What a step takes, beside fixed peers, and whether that is more than it was at its best.

usage: python -m benchmarks.guard [--scene NAME ...] [--steps N ...] [--all] [--minutes M] [--keep]
       [--table] [--results JSON]

Scenes, numbers of steps, value and gradient, one lane and 64 (`benchmarks.guard_scenes`): cells. All programs
are compiled from nothing with full effort, by one process on each core; then, one at a time, each runs in
turn with its scene's peer on the same core. The figure of a cell is the median ratio of processor times a
step: machines get faster and slower, and both sides of a round do so together. `best` keeps the least ratio
of each cell that a commit has reached, by peer, its version and the kind of processor.

Exit status 1, with a table, if

- a ratio is more than 1.15 of the best kept one, and is so again when it is measured anew for longer,
- a program takes more than 1.3 of the best kept processor seconds to compile, in units of a loop of Python
  that runs before and after, and does so again when it is compiled anew,
- a program fails, or a run does not reach its end.

2 if nothing was measured, else 0. Cells that the time did not suffice for are named, and are no failure. Of a
kind of processor that nothing is kept of, ratios are compared with the best of any other, which only warns.
Warned of, too, are scenes whose steps take longer where there are more of them: the best kept would hide it
if it had been so at the start.

Without `--keep` nothing is written; with it, the record of this run and what it improved, and the table in
docs/guard.md. Regressions are not kept. `--all` measures all cells, in hours.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Barrier, BrokenBarrierError, Lock, Thread
from typing import Any

from benchmarks import common
from benchmarks.guard_scenes import ALL, DEFAULT, NUMBERS, SCENES, Cell

RESULTS = common.RESULTS / "guard.json"
PAGE = common.ROOT / "docs" / "guard.md"
BEGIN, END = "<!-- table of benchmarks.guard -->\n", "<!-- end of the table -->\n"
SLOWER = 1.15
"""Ratio over the best kept one from which on a cell fails."""
DEARER = 1.3
"""The same of what compiling costs, which is measured once and on both cores at a time."""
LONGER = 1.6
"""Time a step over that in the run of the next smaller number of steps, from 100 on, that is warned of."""
SHARE = 0.72
"""Of the minutes, for compiling."""
PATIENCE = 20.0
"""How long the other core is waited for after that [s]."""
LAST = 15.0
"""How long after the last time to begin a measurement what still runs is ended [s]."""
AGAIN = 4.0
"""Span of the second measurement [s]."""
BATCH = 70
"""Cells that are compiled before any is timed: programs take memory."""
KEY = ("scene", "kind", "lanes", "steps", "peer", "processor")


class Worker:
    """A process on one core that compiles and times cells, see `benchmarks.guard_cells`."""

    def __init__(self, core: int | None):
        def pinned() -> None:
            if core is not None:
                os.sched_setaffinity(0, {core})

        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.guard_cells"],
            cwd=common.ROOT,
            env=os.environ | common.ONE_THREAD,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=pinned if sys.platform == "linux" else None,
        )

    def ask(self, do: str, cell: Cell, **options: Any) -> dict[str, Any]:
        """The answer to a request; a process that died is an error."""
        assert self.process.stdin and self.process.stdout
        try:
            print(json.dumps({"do": do, "cell": cell} | options), file=self.process.stdin, flush=True)
            line = self.process.stdout.readline()
        except OSError:
            line = ""
        return json.loads(line) if line else {"error": f"the process ended: {self.process.poll()}"}

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin
        try:
            self.process.stdin.close()
        except OSError:
            pass
        self.process.kill()
        self.process.wait()


def cores() -> list[int | None]:
    """At most two."""
    return sorted(os.sched_getaffinity(0))[:2] if sys.platform == "linux" else [None]


class Run:
    """Cells on their way: a thread for each process compiles them, and times its own, one at a time.

    Args:
        cells: what is to be measured, in this order.
        costs: what cells are known to cost to compile, see `cost`.
        until: no cell is timed later, by the monotonic clock.
        compiling_until: none is compiled that would not be done by then, as far as that is known.
        judge: faults of a record, for which it is measured again.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        costs: dict[Cell, float],
        until: float,
        compiling_until: float,
        judge: Callable[[dict[str, Any]], list[str]],
    ):
        self.queue, self.costs, self.judge = list(cells), costs, judge
        self.until, self.compiling_until = until, compiling_until
        self.records = {cell: cell._asdict() | {"missed": "no time to compile"} for cell in cells}
        self.workers = [Worker(core) for core in cores()]
        self.choosing, self.timing = Lock(), Lock()
        self.compiled = Barrier(len(self.workers))
        self.late = False

    def measured(self) -> list[dict[str, Any]]:
        """Records of all cells, of those without a time, too."""
        threads = [Thread(target=self._work, args=(worker,)) for worker in self.workers]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(_room(self.until + LAST))
            self.late = any(thread.is_alive() for thread in threads)
        finally:
            for worker in self.workers:
                worker.close()
        for thread in threads:
            thread.join()
        return list(self.records.values())

    def _next(self, seconds_per_cost: float) -> Cell | None:
        """The first cell that there is time to compile."""
        with self.choosing:
            room = self.compiling_until - time.monotonic()
            cell = next((c for c in self.queue if seconds_per_cost * self.costs.get(c, 0.0) <= room), None)
            if cell is None or room <= 0:
                return None
            self.queue.remove(cell)
            return cell

    def _work(self, worker: Worker) -> None:
        ready, pace = [], 0.0
        while cell := self._next(pace):
            begun = time.monotonic()
            answer = worker.ask("compile", cell)
            if self.late:
                return
            self.records[cell] = cell._asdict() | answer
            if "error" in answer:
                print(line(self.records[cell]), flush=True)
                if worker.process.poll() is not None:
                    break
                continue
            ready.append(cell)
            pace = (time.monotonic() - begun) / cost(answer)
            print(f"compiled {words(cell)}: {answer['compile_s']:.1f} s", flush=True)
        # Times are taken while no other core compiles, but for one that is late.
        try:
            self.compiled.wait(_room(self.compiling_until + PATIENCE))
        except BrokenBarrierError:
            pass
        for cell in ready:
            with self.timing:
                self._time(worker, cell)

    def _time(self, worker: Worker, cell: Cell) -> None:
        record = self.records[cell]
        if time.monotonic() < self.until:
            record |= worker.ask("time", cell)
            if "error" not in record and self.judge(record):
                record |= _again(worker, cell, self.judge(record))
            if self.late:  # and the process was ended
                record.pop("error", None)
        if "ratio" not in record and "error" not in record:
            record["missed"] = "no time to measure"
        print(line(record), flush=True)


def _room(until: float) -> float | None:
    """Seconds until then; None: as long as it takes."""
    return None if until == float("inf") else max(0.0, until - time.monotonic())


def _again(worker: Worker, cell: Cell, names: list[str]) -> dict[str, Any]:
    """The second measurement of what is too much, which is the one that counts."""
    answer: dict[str, Any] = {"again": True}
    if "compile" in names:
        answer |= worker.ask("compile", cell)
    return answer | worker.ask("time", cell, span=AGAIN)


def words(cell: Cell) -> str:
    """A cell in words."""
    lanes = "" if cell.lanes == 1 else f", {cell.lanes} lanes"
    return f"{cell.scene}, {cell.kind}{lanes}, {cell.steps} steps"


def cell_of(record: dict[str, Any]) -> Cell:
    """Which cell a record is of."""
    return Cell(*(record[name] for name in Cell._fields))


def line(record: dict[str, Any]) -> str:
    """A record in one line."""
    reason = record.get("error") or record.get("missed")
    if reason:
        return f"{words(cell_of(record))}: {reason}"
    return (
        f"{words(cell_of(record))}: {record['us_per_step']:.3g} us a step, ratio {record['ratio']:.3g} "
        f"({record['ratio_quartiles'][0]:.3g} to {record['ratio_quartiles'][1]:.3g})"
        f"{', measured twice' * record.get('again', False)}"
    )


def key(record: dict[str, Any]) -> tuple:
    """By which ratios are compared."""
    return tuple(record[name] for name in KEY)


def cost(record: dict[str, Any]) -> float:
    """What a program costs to compile, in units of the loop of Python beside."""
    return record["compile_s"] / record["pace_s"]


def kept_for(record: dict[str, Any], best: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The best of the same cell, peer and processor; else the least of other processors; else none."""
    alike = [b for b in best if key(b)[:-1] == key(record)[:-1]]
    same = [b for b in alike if b["processor"] == record["processor"]]
    return min(same or alike, key=lambda b: b["ratio"], default=None)


def faults(record: dict[str, Any], best: Sequence[dict[str, Any]]) -> list[str]:
    """What is worse than it was: "time" and "compile", or nothing.

    Args:
        record: of a cell, with its peer and processor.
        best: the ones kept.
    """
    kept = kept_for(record, best)
    if kept is None:
        return []
    names = []
    if record["ratio"] > SLOWER * kept["ratio"]:
        names.append("time")
    if cost(record) > DEARER * kept["compile_cost"]:
        names.append("compile")
    return names


def improved(
    best: Sequence[dict[str, Any]], records: Sequence[dict[str, Any]], commit: str | None
) -> list[dict[str, Any]]:
    """The best ones after a run: of each cell the least ratio and the least cost, with their commits."""
    by_key = {key(b): dict(b) for b in best}
    for record in records:
        if "ratio" not in record:
            continue
        new = by_key.setdefault(key(record), {name: record[name] for name in KEY})
        if record["ratio"] < new.get("ratio", float("inf")):
            new |= {"ratio": record["ratio"], "commit": commit}
        if cost(record) < new.get("compile_cost", float("inf")):
            new |= {"compile_cost": cost(record), "compile_commit": commit}
    return [by_key[k] for k in sorted(by_key)]


def growing(records: Sequence[dict[str, Any]]) -> list[str]:
    """Warnings of scenes whose steps take longer where there are more of them."""
    times = {cell_of(r): r["us_per_step"] for r in records if "ratio" in r}
    warnings = []
    for cell, us in times.items():
        smaller = [n for n in NUMBERS if 100 <= n < cell.steps and cell._replace(steps=n) in times]
        before = times[cell._replace(steps=smaller[-1])] if smaller else us
        if us > LONGER * before:
            warnings.append(f"{words(cell)}: {us / before:.2g} times as long a step as with {smaller[-1]}")
    return warnings


def newest(results: dict[str, Any]) -> dict[Cell, tuple[dict[str, Any], dict[str, Any]]]:
    """Of each cell the last measurement on the processor of the last record, and the record that has it."""
    cells = {}
    for record in results["records"]:
        for cell in record["cells"]:
            if "ratio" in cell and cell["processor"] == results["records"][-1]["machine"]["processor"]:
                cells[cell_of(cell)] = cell, record
    return cells


def _about(record: dict[str, Any]) -> str:
    """Circumstances of a record, in words."""
    commit = (record["commit"] or "?")[:8] + "+" * record["uncommitted_changes"]
    versions = ", ".join(f"{name} {record['versions'][name]}" for name in ("jax", "numpy"))
    return f"{record['date'][:10]}, commit {commit}, {versions}"


def table(results: dict[str, Any]) -> str:
    """The last measurement of each cell, as a table of Markdown; nothing where there is none."""
    cells = newest(results)
    if not cells:
        return ""
    rows: dict[tuple, dict[int, dict]] = {}
    for cell, (record, _) in cells.items():
        rows.setdefault(cell[:3], {})[cell.steps] = record
    lines = [
        "| scene, peer | what | " + " | ".join(f"{n}" for n in NUMBERS) + " | compile s |",
        "|---|---|" + "---|" * (len(NUMBERS) + 1),
    ]
    before = ""
    order = list(dict.fromkeys(cell[:3] for cell in ALL))
    for scene, kind, lanes in sorted(rows, key=order.index):
        row = rows[scene, kind, lanes]
        peer = "" if scene == before else f"{scene}; {next(iter(row.values()))['peer']}"
        what = kind + ("" if lanes == 1 else f", {lanes} lanes")
        times = [f"{row[n]['us_per_step']:.3g} ({row[n]['ratio']:.2g})" if n in row else "" for n in NUMBERS]
        most = max(c["compile_s"] for c in row.values())
        lines.append(f"| {peer} | {what} | " + " | ".join(times) + f" | {most:.1f} |")
        before = scene
    processor = results["records"][-1]["machine"]["processor"]
    abouts = dict.fromkeys(_about(record) for _, record in cells.values())
    return "\n".join([*lines, "", f"{processor}, one core; {'; '.join(abouts)}."]) + "\n"


def load(file: Path) -> dict[str, Any]:
    """What is kept; nothing where there is no file."""
    return json.loads(file.read_text("utf-8")) if file.exists() else {"best": [], "records": []}


def dumped(results: dict[str, Any]) -> str:
    """JSON with a cell a line."""

    def listed(items: Sequence[Any], indent: str) -> str:
        return (
            "[\n"
            + ",\n".join(indent + json.dumps(x, allow_nan=False) for x in items)
            + "\n"
            + indent[1:]
            + "]"
        )

    records = []
    for record in results["records"]:
        cells = listed(record["cells"], "   ")
        head = json.dumps({k: v for k, v in record.items() if k != "cells"}, allow_nan=False)
        records.append(f'  {head[:-1]}, "cells": {cells}}}')
    return (
        '{\n "best": '
        + listed(results["best"], "  ")
        + ',\n "records": [\n'
        + ",\n".join(records)
        + "\n ]\n}\n"
    )


def with_table(page: str, text: str) -> str:
    """A page with this table in the place that it has for it."""
    before, _, after = page.partition(BEGIN)
    return before + BEGIN + text + END + after.partition(END)[2]


def keep(results: dict[str, Any], record: dict[str, Any], file: Path) -> None:
    """Write a record and what it improved, and the table on the page if this is the file of the checkout."""
    commit = record["commit"] and record["commit"] + "+" * record["uncommitted_changes"]
    results["best"] = improved(results["best"], record["cells"], commit)
    results["records"].append(record)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(dumped(results), "utf-8")
    if file == RESULTS:
        PAGE.write_text(with_table(PAGE.read_text("utf-8"), table(results)), "utf-8")
    print(f"wrote {file}")


def report(records: Sequence[dict[str, Any]], best: Sequence[dict[str, Any]]) -> int:
    """Print what is worse than it was, and what was not measured; the exit status."""
    measured = [r for r in records if "ratio" in r]
    rows, failed = [("cell", "ratio", "best", "compile", "best", "at")], False
    for record in measured:
        names, kept = faults(record, best), kept_for(record, best)
        if not names or kept is None:
            continue
        same = kept["processor"] == record["processor"]
        failed |= same
        numbers = record["ratio"], kept["ratio"], cost(record), kept["compile_cost"]
        at = f"{(kept['commit'] or '?')[:8]}{'' if same else ', another processor: only a warning'}"
        rows.append((words(cell_of(record)), *(f"{x:.3g}" for x in numbers), at))
    if len(rows) > 1:
        print(f"\nWORSE THAN THE BEST (times {SLOWER}, compile {DEARER}):\n{common.aligned(rows)}")
    new = [r for r in measured if kept_for(r, best) is None]
    if new:
        print(f"\n{len(new)} cells have nothing to be compared with")
    if growing(records):
        print("\nWARNING, slower with more steps:\n" + "\n".join(growing(records)))
    missed = [r for r in records if "ratio" not in r]
    if missed:
        print("\nNOT MEASURED:\n" + "\n".join(map(line, missed)))
    if not measured:
        return 2
    return int(failed or any("error" in r for r in records))


def left_out(cells: Sequence[Cell]) -> str:
    """What there is besides of the same scenes, in words."""
    rows: dict[tuple, list[str]] = {}
    chosen = {cell.scene for cell in cells}
    for cell in ALL:
        if cell not in cells and cell.scene in chosen:
            rows.setdefault((cell.kind, cell.lanes, cell.steps), []).append(cell.scene)
    return "\n".join(
        f"  {kind}, {lanes} lane{'s' * (lanes > 1)}, {steps} steps: {'; '.join(scenes)}"
        for (kind, lanes, steps), scenes in rows.items()
    )


def batches(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Cells that one set of processes measures: scene by scene, or all together."""
    if len(cells) <= BATCH:
        return [list(cells)]
    return [[c for c in cells if c.scene == scene] for scene in dict.fromkeys(c.scene for c in cells)]


def spent() -> float:
    """Processor seconds of this process and of those it has started and that have ended."""
    return sum(os.times()[:4])


def main() -> int:
    """Run; the exit status."""
    options = argparse.ArgumentParser(description="Times a step beside fixed peers, and the best kept ones.")
    options.add_argument("--scene", nargs="+", choices=tuple(SCENES), metavar="NAME", help=", ".join(SCENES))
    options.add_argument("--steps", nargs="+", type=int, choices=NUMBERS, metavar="N", help="only these")
    options.add_argument("--all", action="store_true", help="all cells, without a limit of time")
    options.add_argument("--minutes", type=float, default=10.0, help="at most; default 10")
    options.add_argument(
        "--keep", action="store_true", help="write the record, and what is better than before"
    )
    options.add_argument("--table", action="store_true", help="only print the table of what is kept")
    options.add_argument("--results", type=Path, default=RESULTS, metavar="JSON", help="what is kept")
    chosen = options.parse_args()
    results = load(chosen.results)
    if chosen.table:
        print(table(results), end="")
        return 0
    start, budget = time.monotonic(), float("inf") if chosen.all else 60 * chosen.minutes
    cells = [
        c
        for c in (ALL if chosen.all else DEFAULT)
        if c.scene in (chosen.scene or SCENES) and c.steps in (chosen.steps or NUMBERS)
    ]
    print(f"{len(cells)} cells; not among them:\n{left_out(cells)}\n", flush=True)
    record: dict[str, Any] = common.circumstances("guard", quick=False)
    processor, best = record["machine"]["processor"], results["best"]
    record["cells"] = []

    def judge(cell: dict[str, Any]) -> list[str]:
        return faults(cell | {"processor": processor}, best)

    costs = {cell_of(b): b["compile_cost"] for b in best}
    for batch in batches(cells):
        # What compiles for longest comes first, so that the cores end together.
        batch.sort(key=lambda cell: -costs.get(cell, 0.0))
        run = Run(batch, costs, start + 0.97 * budget, start + SHARE * budget, judge)
        record["cells"] += run.measured()
    order = {cell: k for k, cell in enumerate(ALL)}
    record["cells"].sort(key=lambda r: order[cell_of(r)])
    record["cells"] = [r | {"processor": processor} for r in record["cells"]]
    record |= {"wall_s": time.monotonic() - start, "processor_s": spent()}
    status = report(record["cells"], best)
    print(f"\n{record['wall_s']:.0f} s, {record['processor_s']:.0f} s of the processor; exit status {status}")
    if chosen.keep and status != 2:
        keep(results, record, chosen.results)
    return status


if __name__ == "__main__":
    sys.exit(main())
