"""Durations of the tests: what is kept of them, the budgets of the lanes, and the tables in CONTRIBUTING.md.

usage: python -m tests.lanes    writes the tables anew
"""

import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
DURATIONS = FOLDER / "durations.json"
EXHAUSTIVE = FOLDER / "exhaustive.json"
PAGE = FOLDER.parent / "CONTRIBUTING.md"

CORES = 2
BUSY = 0.9
"""Part of the time of the cores that tests have: workers start, and the last file keeps one of them."""
MINUTES = {"default": 5, "slow": 25}
UNMEASURED = 30.0
"""Processor seconds that a test is taken for before it has been measured."""
SHOWN = 30


def lane_of(item: Any) -> str:
    """Name of the lane that a test is in."""
    marks = ("gpu", "benchmark", "exhaustive", "slow")
    return next((mark for mark in marks if item.get_closest_marker(mark)), "default")


def seconds_by_lane() -> dict[str, dict[str, float]]:
    """Processor seconds of the tests, by lane and name, from an empty cache of programs."""
    return json.loads(DURATIONS.read_text("utf-8")) if DURATIONS.exists() else {}


def enter(measured: dict[str, dict[str, float]], all_of_lane: bool) -> None:
    """Keep the durations of tests that ran, beside those of other tests, or in place of them.

    Args:
        measured: processor seconds by lane and test.
        all_of_lane: whether these are all tests of their lanes.
    """
    kept = seconds_by_lane()
    for lane, tests in measured.items():
        kept[lane] = tests if all_of_lane else kept.get(lane, {}) | tests
    DURATIONS.write_text(json.dumps(kept, indent=0, sort_keys=True) + "\n", "utf-8")


def slowest() -> str:
    """The slowest tests as a table in Markdown."""
    lanes = seconds_by_lane()
    rows = [(s, lane, test) for lane, tests in lanes.items() for test, s in tests.items()]
    lines = [f"| {s:.0f} | {lane} | `{test}` |" for s, lane, test in sorted(rows, reverse=True)[:SHOWN]]
    return "\n".join(["| processor s | lane | test |", "|---|---|---|", *lines])


def budgets() -> str:
    """What the lanes take and may take."""
    lines = ["| lane | tests | processor s | allowed |", "|---|---|---|---|"]
    for lane, tests in sorted(seconds_by_lane().items()):
        allowed = f"{BUSY * CORES * 60 * MINUTES[lane]:.0f}" if lane in MINUTES else ""
        lines.append(f"| {lane} | {len(tests)} | {sum(tests.values()):.0f} | {allowed} |")
    return "\n".join(lines)


def shards() -> str:
    """How the shards of the exhaustive lane ended."""
    results = json.loads(EXHAUSTIVE.read_text("utf-8")) if EXHAUSTIVE.exists() else {}
    lines = ["| shard | commit | date | passed | failed | seconds |", "|---|---|---|---|---|---|"]
    for shard, r in sorted(results.items()):
        failed = ", ".join(f"`{name}`" for name in r["failed"]) or "0"
        row = (shard, r["commit"], r["date"], r["passed"], failed, r["seconds"])
        lines.append(f"| {' | '.join(map(str, row))} |")
    return "\n".join(lines)


TABLES = {"budgets": budgets, "shards": shards, "slowest": slowest}


def written(page: str) -> str:
    """The text of the page with the tables as they are now."""

    def filled(match: re.Match) -> str:
        return f"{match[1]}{TABLES[match[2]]()}\n{match[3]}"

    return re.sub(r"(<!-- (\w+) -->\n).*?(<!-- end of \2 -->)", filled, page, flags=re.DOTALL)


def write() -> None:
    """Write the tables of the page anew."""
    PAGE.write_text(written(PAGE.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    write()
