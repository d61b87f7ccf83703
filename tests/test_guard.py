"""The guard of times a step: what it compares, what its page shows, and a run of it."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
guard = pytest.importorskip("benchmarks.guard", reason="only a checkout has the benchmarks")
scenes = pytest.importorskip("benchmarks.guard_scenes")
ALL, DEFAULT, SCENES = scenes.ALL, scenes.DEFAULT, scenes.SCENES

RECORD = {
    "scene": "heavy top", "kind": "value", "lanes": 1, "steps": 100, "peer": "Exudyn 1",
    "processor": "a chip", "us_per_step": 2.0, "peer_us_per_step": 8.0, "ratio": 0.25,
    "ratio_quartiles": [0.2, 0.3], "rounds": 9, "compile_s": 4.0, "pace_s": 0.02,
}  # fmt: skip
BEST = guard.improved([], [RECORD], "abc")


@pytest.mark.parametrize(
    ("times", "dearer", "faults"),
    [(1.0, 1.0, []), (1.1, 1.25, []), (1.2, 1.0, ["time"]), (0.5, 1.4, ["compile"])],
)
def test_what_is_worse_is_named(times, dearer, faults, capsys):
    record = RECORD | {"ratio": 0.25 * times, "compile_s": 4.0 * dearer}
    assert guard.faults(record, BEST) == faults
    assert guard.report([record], BEST) == (1 if faults else 0)
    assert ("WORSE" in capsys.readouterr().out) == bool(faults)


def test_what_it_is_compared_with(capsys):
    worse = RECORD | {"ratio": 0.5}
    for other in ({"peer": "Exudyn 2"}, {"steps": 10}, {"lanes": scenes.LANES}):
        assert guard.kept_for(worse | other, BEST) is None
    # Of another processor: it warns.
    assert guard.report([worse | {"processor": "another"}], BEST) == 0
    assert "only a warning" in capsys.readouterr().out


def test_what_was_not_measured_is_named(capsys):
    late = dict(zip(scenes.Cell._fields, scenes.Cell("rope, 64", "value", 1, 10))) | {
        "missed": "no time to compile"
    }
    assert guard.report([late], BEST) == 2
    assert guard.report([late, RECORD], BEST) == 0
    assert guard.report([late | {"error": "ValueError: it is"}, RECORD], BEST) == 1
    assert "rope, 64, value, 10 steps: no time to compile" in capsys.readouterr().out


class Stub:
    """Instead of a process: one scene compiles until it is ended, one fails."""

    def __init__(self, core):
        self.process, self.ended = self, threading.Event()

    def poll(self):
        return None

    def ask(self, do, cell, **options):
        if cell.scene == "open tree":
            self.ended.wait()
        if self.ended.is_set() or cell.scene == "rope, 64":
            return {"error": "ValueError: no"}
        return {"compile_s": 1.0, "pace_s": 1.0} if do == "compile" else RECORD

    def close(self):
        self.ended.set()


def test_what_compiles_for_too_long_is_ended_and_the_others_are_timed(monkeypatch):
    monkeypatch.setattr(guard, "Worker", Stub)
    monkeypatch.setattr(guard, "cores", lambda: [0, 1])
    monkeypatch.setattr(guard, "PATIENCE", 0.1)
    monkeypatch.setattr(guard, "LAST", 0.1)
    cells = [scenes.Cell(s, "value", 1, 10) for s in ("open tree", "rope, 64", "heavy top", "block")]
    now, dear = time.monotonic(), {cells[3]: 1e9}
    run = guard.Run(cells, dear, now + 2.0, now + 1.0, lambda record: [])
    records = {record["scene"]: record for record in run.measured()}
    assert records["open tree"]["missed"] and "error" not in records["open tree"]
    assert records["rope, 64"]["error"] and records["block"]["missed"] == "no time to compile"
    assert records["heavy top"]["ratio"] == 0.25 and "missed" not in records["heavy top"]


def test_only_what_is_better_is_kept():
    mixed = RECORD | {"ratio": 0.2, "compile_s": 8.0}
    (best,) = guard.improved(BEST, [mixed, RECORD | {"ratio": 0.3}], "def")
    assert best["ratio"] == 0.2 and best["commit"] == "def"
    assert best["compile_cost"] == 200.0 and best["compile_commit"] == "abc"


def test_steps_that_grow_with_their_number_are_named():
    longer = RECORD | {"steps": 10_000, "us_per_step": 8.0}
    assert guard.growing([RECORD, RECORD | {"steps": 10, "us_per_step": 9.0}]) == []
    (warning,) = guard.growing([RECORD, longer])
    assert "heavy top, value, 10000 steps: 4 times" in warning


def test_cells():
    assert set(DEFAULT) <= set(ALL) and len(set(DEFAULT)) == len(DEFAULT) <= guard.BATCH
    assert {cell.scene for cell in DEFAULT} == set(SCENES)
    assert {cell.steps for cell in DEFAULT} == set(scenes.NUMBERS)
    text = guard.left_out(DEFAULT)
    assert "gradient, 64 lanes, 10000 steps" in text and "humanoid" in text


def test_what_is_kept_is_consistent(tmp_path):
    results = guard.load(guard.RESULTS)
    assert json.loads(guard.dumped(results)) == results
    best = {guard.key(b): b for b in results["best"]}
    assert len(best) == len(results["best"])
    for record in results["records"]:
        assert record["commit"] and record["machine"]["processor"] and record["versions"]["jax"]
        for cell in record["cells"]:
            if "ratio" not in cell:
                continue
            assert guard.cell_of(cell) in ALL and cell["processor"] == record["machine"]["processor"]
            low, high = cell["ratio_quartiles"]
            assert 0 < low <= cell["ratio"] <= high
            assert cell["ratio"] == pytest.approx(cell["us_per_step"] / cell["peer_us_per_step"], rel=0.2)
            assert best[guard.key(cell)]["ratio"] <= cell["ratio"]
            assert best[guard.key(cell)]["compile_cost"] <= guard.cost(cell)
    assert guard.load(tmp_path / "none.json") == {"best": [], "records": []}


def test_the_table_has_the_last_of_each_cell():
    about = {"date": "2000-01-01T", "commit": "abc", "uncommitted_changes": False}
    about |= {"machine": {"processor": "a chip"}, "versions": {"jax": "1", "numpy": "2"}}
    longer = RECORD | {"steps": 1000, "us_per_step": 3.0}
    elsewhere = about | {"machine": {"processor": "another"}, "cells": [RECORD | {"processor": "another"}]}
    records = [
        about | {"cells": [RECORD, longer]},
        elsewhere,
        about | {"cells": [RECORD | {"us_per_step": 1.5}]},
    ]
    text = guard.table({"best": [], "records": records})
    assert "| heavy top; Exudyn 1 | value |  | 1.5 (0.25) | 3 (0.25) |  | 4.0 |" in text
    assert text.endswith("a chip, one core; 2000-01-01, commit abc, jax 1, numpy 2.\n")
    assert guard.table({"best": [], "records": []}) == ""


def test_the_page_shows_what_is_kept():
    page = guard.PAGE.read_text("utf-8")
    assert page == guard.with_table(page, guard.table(guard.load(guard.RESULTS)))


def _guard(*options):
    command = [sys.executable, "-m", "benchmarks.guard", *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.exhaustive
def test_guard_of_one_scene(tmp_path):
    file = tmp_path / "guard.json"
    run = _guard("--scene", "heavy top", "--results", str(file), "--keep")
    assert run.returncode == 0, run.stdout + run.stderr
    results = guard.load(file)
    assert all("ratio" in cell for cell in results["records"][0]["cells"])
    # Against a best that is half of that, every cell is worse.
    file.write_text(
        guard.dumped(results | {"best": [b | {"ratio": b["ratio"] / 2} for b in results["best"]]})
    )
    again = _guard("--scene", "heavy top", "--results", str(file))
    assert again.returncode == 1 and "WORSE" in again.stdout
    assert guard.load(file)["records"] == results["records"]


@pytest.mark.exhaustive
def test_guard():
    """No cell is worse than the best of what was kept on this kind of processor."""
    run = _guard()
    assert run.returncode == 0, run.stdout + run.stderr
