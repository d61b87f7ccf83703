"""The command line: what it prints, writes and returns."""

import json

import pytest

from natcoord_jax import cli, gallery

KEYS = {
    "scene",
    "steps",
    "dt",
    "t_end",
    "dofs",
    "unknowns",
    "constraints",
    "newton_iterations_mean",
    "newton_iterations_max",
    "compile_s",
    "wall_s",
    "energy_initial",
    "energy_final",
    "energy_error_max",
    "momentum_error_max",
    "angular_momentum_error_max",
    "constraint_error_max",
    "velocity_constraint_error_max",
    "result",
}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Figures go to a folder of the test."""
    monkeypatch.chdir(tmp_path)


def test_scenes_are_listed(capsys):
    assert cli.main(["scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(gallery.SCENES)


def test_run_of_the_spacecraft(tmp_path, capsys):
    assert cli.main(["run", "spacecraft", "--json", "report.json"]) == 0
    assert "wrote spacecraft.png" in capsys.readouterr().out
    assert (tmp_path / "spacecraft.png").stat().st_size > 10_000
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report.keys() >= KEYS
    assert (report["t_end"], report["dofs"], report["constraints"], report["unknowns"]) == (5, 9, 39, 9)
    assert report["result"] == "successful"
    for key in ("energy_error_max", "momentum_error_max", "angular_momentum_error_max"):
        assert 0 <= report[key] <= 1e-11, key
    assert report["constraint_error_max"] <= 1e-11
    assert report["wall_s"] < report["compile_s"]


def test_run_with_a_view(tmp_path, capsys, monkeypatch):
    """Without a display it says where the file is."""
    monkeypatch.setattr("natcoord_jax.viz.views._has_display", lambda: False)
    assert cli.main(["run", "double-pendulum", "--steps", "4", "--view"]) == 0
    file = tmp_path / "double_pendulum.html"
    assert f"wrote double_pendulum.html\nopen {file} in a browser" in capsys.readouterr().out
    assert "two rods on hinges" in file.read_text("utf-8")


def test_run_with_a_tolerance(tmp_path, capsys):
    options = ["--dt", "0.5", "--steps", "2", "--rtol", "1e-4", "--json", "report.json", "--film", "film.gif"]
    assert cli.main(["run", "double_pendulum", *options]) == 0
    out = capsys.readouterr().out
    assert "attempts repeated in shorter ones" in out and "wrote film.gif" in out
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["substeps"] > 20 and report["steps"] == 2
    assert report["energy_error_max"] <= 1e-11


@pytest.mark.slow
def test_run_of_high_order(tmp_path):
    """Could go wrong: the order is not used; at order two rates of constraints are off by 0.05 m/s."""
    options = ["--order", "6", "--steps", "15", "--dt", "0.1", "--json", "report.json"]
    assert cli.main(["run", "pendulum", *options]) == 0
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report.keys() >= KEYS
    assert (report["result"], report["steps"], report["t_end"]) == ("successful", 15, 1.5)
    for key in ("energy_error_max", "constraint_error_max", "velocity_constraint_error_max"):
        assert 0 <= report[key] <= 1e-11, key


CHOICES = [
    ([], None, None),
    (["--steps", "50"], 50, 0.1),
    (["--dt", "0.1"], 50, 0.1),
    (["--steps", "7", "--dt", "0.3"], 7, 0.3),
]


def test_steps_and_dt():
    example, wrong = gallery.load("pendulum"), []
    for options, steps, dt in CHOICES:
        parsed = cli.parser().parse_args(["run", "pendulum", *options])
        choice = cli.choose_steps(example, parsed.steps, parsed.dt)
        expected = (steps or example.steps, dt or example.dt)
        if choice != pytest.approx(expected):
            wrong.append(f"{options} give {choice}, not {expected}")
    assert not wrong, "\n".join(wrong)


BAD_OPTIONS = [
    ["run", "merry_go_round"],
    ["run", "pendulum", "--dt", "0.3"],
    ["run", "pendulum", "--dt", "-1"],
    ["run", "pendulum", "--dt", "nan"],
    ["run", "pendulum", "--steps", "0"],
    ["run", "pendulum", "--steps", "many"],
    ["run", "pendulum", "--json", "no_such_folder/report.json"],
    ["run", "pendulum", "--plot", "figure.xyz"],
    ["run", "pendulum", "--speed", "3"],
    ["run", "pendulum", "--rtol", "-1e-3"],
    ["run", "pendulum", "--atol", "1e-3"],
    ["run"],
    [],
]


def test_bad_options_give_one_line_and_code_2(capsys):
    wrong = []
    for arguments in BAD_OPTIONS:
        try:
            code = cli.main(arguments)
        except SystemExit as stop:
            code = stop.code
        captured = capsys.readouterr()
        if code != 2 or len(captured.err.splitlines()) != 1 or captured.out:
            wrong.append(f"{arguments} give code {code}, errors {captured.err!r}, output {captured.out!r}")
    assert not wrong, "\n".join(wrong)


def test_a_run_that_fails_says_why_and_writes_what_it_has(tmp_path, capsys):
    # Half a turn in one step is beyond what one step can represent.
    assert cli.main(["run", "heavy_top", "--steps", "4", "--dt", "500", "--json", "report.json"]) == 1
    error = capsys.readouterr().err
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["result"] in error and report["result"] != "successful"
    assert report.keys() >= KEYS
    assert report["steps_completed"] < 4
