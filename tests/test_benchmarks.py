"""The benchmarks run and write what their figures and readers need; what they measure is not judged here."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CIRCUMSTANCES = {"benchmark", "quick", "date", "commit", "machine", "versions", "targets"}
TIMES = {"us_per_step", "us_per_step_range", "repeats", "compile_s"}

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(not (ROOT / "benchmarks").is_dir(), reason="only a checkout has the benchmarks"),
]


def _results(name, folder, *options, written=None):
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--output", str(folder), *options]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    if written is None:
        assert (folder / f"{name}.png").stat().st_size > 10_000
    results = json.loads((folder / f"{written or name}.json").read_text("utf-8"))
    assert results.keys() >= CIRCUMSTANCES
    assert results["machine"].keys() >= {"processor", "cores", "cores_used"}
    for target in results["targets"]:
        assert target.keys() == {"name", "measured", "target", "unit", "reached"}
    return results, run.stdout


def test_scaling(tmp_path):
    results, text = _results("scaling", tmp_path)
    assert {run["scene"] for run in results["runs"]} == {"chain", "binary_tree"} == set(results["exponents"])
    for run in results["runs"]:
        assert run.keys() >= TIMES | {"bodies", "unknowns", "solver", "energy_balance", "build_s"}
        assert run["result"] == "successful" and run["energy_balance"] < 1e-11
    assert "exponent" in text


def test_robots(tmp_path):
    results, text = _results("robots", tmp_path)
    for run in results["runs"]:
        assert max(run[key] for key in ("mass", "gravity", "acceleration")) < 1e-9
    for run in results["torques"]:
        assert run["torque"] < 1e-9
    assert "URDF that are refused" in text


def test_effects(tmp_path):
    results, _ = _results("effects", tmp_path)
    assert [run["effect"] for run in results["runs"]][:2] == ["base", "base without gravity"]
    for run in results["runs"]:
        assert run.keys() >= TIMES | {"over_first", "unknowns", "multipliers", "program"}


def test_work_precision_of_one_scene_alone(tmp_path):
    results, text = _results("work_precision", tmp_path, "--no-peers", "--models", "double_pendulum")
    (found,) = results["models"].values()
    assert {run["code"][-1] for run in found["runs"]} == {"2", "4", "6", "8", "0"}
    for run in found["runs"]:
        assert run.keys() >= TIMES | {"steps", "error", "drift"} and run["drift"] < 1e-11
    assert "double_pendulum" in text
    again, _ = _results("work_precision", tmp_path, "--no-peers", "--models", "heavy_top", "--keep")
    assert list(again["models"]) == ["heavy_top", "double_pendulum"]
    assert again["models"]["double_pendulum"] == found
    assert again["long"] and not results["long"]


def test_batches_of_one_scene(tmp_path):
    options = "--no-peers", "--models", "heavy_top", "--lanes", "2"
    results, text = _results("batches", tmp_path, *options)
    (found,) = results["models"].values()
    assert {run["code"][-1] for run in found["runs"]} == {"2", "4"}
    for run in found["runs"]:
        assert run.keys() >= {"lanes", "steps", "error", "us_per_step"} and run["finite"]
        assert run["failed_lanes"] == run["repeated_steps"] == 0
    assert results["device"] and "heavy_top" in text


def test_gradients_alone(tmp_path):
    options = "--gradients", "--models", "heavy_top"
    results, _ = _results("work_precision", tmp_path, *options, written="gradients")
    assert [row["order"] for row in results["models"]["heavy_top"]] == [2, 4]
    for row in results["models"]["heavy_top"]:
        assert row.keys() >= TIMES | {"over_forward", "forward_us_per_step"} and row["finite"]
    assert len(results["targets"]) == 2


def test_spacecraft_alone(tmp_path):
    results, text = _results("spacecraft", tmp_path, "--no-peers", "--models", "spacecraft")
    assert set(results["models"]) == {"spacecraft"}
    for found in results["models"].values():
        errors = []
        for run in found["runs"]:
            assert run.keys() >= TIMES | {"code", "steps", "h", "error", "energy_error", "energy_balance"}
            assert run["result"] == "successful" and run["energy_balance"] < 1e-11
            errors.append(run["error"])
        assert 3 < errors[0] / errors[1] < 5  # twice the steps, order two
        for gradient in found["gradients"]:
            assert gradient.keys() >= TIMES | {"over_forward", "forward_us_per_step"} and gradient["finite"]
        assert found["batches"][0]["failed_lanes"] == 0
    assert all(r["angular_momentum_error"] < 1e-11 for r in results["models"]["spacecraft"]["runs"])
    assert "natcoord_jax" in text


def test_linsolve_alone(tmp_path):
    results, text = _results("linsolve", tmp_path, "--no-peers")
    for run in results["runs"]:
        assert run.keys() >= {"system", "unknowns", "solver", "analysis_s", "entries"}
        for key in ("plain", "refined"):
            assert run[key].keys() >= TIMES and run[key]["residual"] < 1e-12
        assert run["klu"] is None
    assert "multifrontal" in text


def test_beams_alone(tmp_path):
    results, _ = _results("beams", tmp_path, "--no-peers")
    assert {run["scene"] for run in results["runs"]} == {"rope", "cantilever"}
    for run in results["runs"]:
        assert run.keys() >= TIMES | {"elements", "solver", "us_per_step_and_element"}
        assert run["result"] == "successful" and run["energy_balance"] < 1e-11


@pytest.mark.exhaustive
def test_shells_alone(tmp_path):
    results, _ = _results("shells", tmp_path, "--no-peers", written="shells")
    for run in results["runs"]:
        assert run.keys() >= TIMES | {"elements", "unknowns", "tip_z", "gradient_ratio"}
        assert run["result"] == "successful" and run["energy_balance"] < 1e-11


@pytest.mark.exhaustive
def test_startup(tmp_path):
    results, text = _results("startup", tmp_path, "--no-peers", written="startup")
    (run,) = results["runs"]
    assert run["scene"] == "heavy top"
    assert 0 < run["value"] < run["gradient"] and run["gradient"] < run["gradient by jax.jit"]
    assert results["command_line"][1] < results["command_line"][0]
    assert "second time" in text


def test_contact(tmp_path):
    results, text = _results("contact", tmp_path, written="contact")
    mine = [run for run in results["runs"] if run["code"] == "natcoord_jax"]
    for run in mine:
        assert run.keys() >= TIMES | {"ms_per_second"}
        assert run["apex_error"] < 1e-9 and run["energy_error"] < 1e-12
    assert len(results["runs"]) > len(mine) and "exact" in text
