"""What the documentation shows runs: blocks of the README and of the pages, examples in docstrings."""

import doctest
import importlib
import json
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import natcoord_jax as nc

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = sorted(
    page.relative_to(DOCS).as_posix()
    for page in DOCS.rglob("*.md")
    if page.relative_to(DOCS).parts[0] not in ("_build", "notebooks")
)
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(nc.__path__, "natcoord_jax.")
    if not module.name.endswith("__main__")
)
# Modules whose examples compile: for more than half a second of the processor each, 70 s in all, ...
SLOW = """
    analysis.balance analysis.contacts analysis.growth analysis.modes analysis.phases
    analysis.statics bodies.contact bodies.continuum bodies.tie control.inverse core.mixed_potential
    core.state effects.constraints.points effects.materials effects.shells.quadrilateral
    effects.shells.triangle gallery.example io.load io.saving linsolve.neighbour_couplings
    linsolve.sparse reading.set_coordinates reading.transfer stepping.assemble stepping.one_step
    stepping.room stepping.scheme stepping.simulate sweeps.run system testing viz.views
""".split()
# ... and for more than five seconds, 90 s in all. Those of all other modules take 6 s together.
EXHAUSTIVE = """
    analysis.accuracy analysis.load_path bodies.gas bodies.loads control.computed_torque
    control.continuation control.identify control.nlp control.problem control.refine
""".split()
COMPILING = {f"natcoord_jax.{name}" for name in SLOW + EXHAUSTIVE}
RUN = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
sys.path.insert(0, sys.argv[1] + "/tests")
from test_docs import blocks_of
names = {"__name__": "page"}
for number, block in enumerate(blocks_of(Path(sys.argv[2]))):
    exec(compile(block, f"{sys.argv[2]}, block {number + 1}", "exec"), names)
if sys.argv[2].endswith("README.md"):
    assert names["angles"].shape == (32,) and names["by_mass"] != 0
    assert names["gradient"].shape == names["torques"].shape
"""


def blocks_of(page: Path) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


def run_page(page: Path, folder: Path) -> None:
    """All blocks of a page, in one process of their own, with the current folder for what they write."""
    # What is run once is compiled with least effort by default, too.
    env = os.environ | {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg", "NATCOORD_JAX_EFFORT": "quick"}
    command = [sys.executable, "-c", RUN, str(ROOT), str(page)]
    run = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]


def test_readme_runs(tmp_path: Path):
    assert len(blocks_of(README)) >= 3, "README.md shows no code"
    run_page(README, tmp_path)


# A minute of the processor each, or more, as users compile them; pages that were measured take some 20 s.
LONG_PAGES = (
    "howto/control_",
    "howto/identification.md",
    "howto/moving_horizon.md",
    "howto/optimal_control.md",
    "howto/shells_solids_contact.md",
)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.exhaustive if page.startswith(LONG_PAGES) else pytest.mark.slow)
        for page in PAGES
        if blocks_of(DOCS / page)
    ],
)
def test_page_runs(page: str, tmp_path: Path):
    run_page(DOCS / page, tmp_path)


def test_readme_has_figures_of_the_pages():
    """Every figure of the README's table is on a page, with what it was measured on."""

    def figures(text: str) -> set[str]:
        return set(re.findall(r"(?<![\w.])\d[\d.]*(?:e-?\d+)?(?![\w.]*\d)", text.replace(" 000", "000")))

    table = [line for line in README.read_text("utf-8").splitlines() if line.startswith("| ")]
    pages = "".join(page.read_text("utf-8") for page in sorted((DOCS / "howto").glob("*.md")))
    assert len(table) >= 10
    missing = figures("\n".join(table)) - figures(pages)
    assert not missing, f"figures of the README that no page has: {missing}"


def test_readme_is_short():
    assert 120 <= len(README.read_text("utf-8").splitlines()) <= 160


def test_links_lead_somewhere():
    wrong = [
        f"{page.relative_to(ROOT)} links to {target}, which is not there"
        for page in (README, ROOT / "CONTRIBUTING.md", *(DOCS / page for page in PAGES))
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text("utf-8"))
        if not target.startswith(("http:", "https:", "mailto:")) and not (page.parent / target).exists()
    ]
    assert not wrong, "\n".join(wrong)


def test_the_page_of_an_index_has_no_dead_links():
    """There nothing is beside the README: pyproject.toml makes names of its links to files."""
    text = README.read_text("utf-8")
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["metadata"]["hooks"]
    for change in hook["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    dead = [x for x in re.findall(r"\]\(([^)]*)\)", text) if not x.startswith("https:")]
    assert not dead, f"links that no substitution of pyproject.toml makes a name of: {dead}"
    assert "![" not in text and "`docs/start.md`" in text and "](https://docs.jax.dev)" in text


def test_every_page_is_linked_from_the_readme():
    text = README.read_text("utf-8")
    missing = [page for page in PAGES if page.startswith("howto/") and f"docs/{page}" not in text]
    assert not missing, f"pages that README.md does not link: {missing}"


def test_notebooks_show_what_they_are_about_moving():
    """As they are stored: with a view in three dimensions, and below 1 MB."""
    wrong = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        if path.stat().st_size >= 1e6:
            wrong.append(f"{path.name} has {path.stat().st_size} bytes, 1 MB or more: show less")
        cells = json.loads(path.read_text("utf-8"))["cells"]
        outputs = [out.get("data", {}) for cell in cells for out in cell.get("outputs", [])]
        if not any("<iframe" in "".join(data.get("text/html", "")) for data in outputs):
            wrong.append(f"{path.name} is stored without a view: run it, end a cell with nc.view")
    assert not wrong, "\n".join(wrong)


def test_reference_is_complete():
    """Every public name has its entry in the reference."""
    pages = "".join((DOCS / page).read_text("utf-8") for page in PAGES if page.startswith("api/"))
    listed = set(re.findall(r"^\.\. auto(?:class|function|data):: (\w+)$", pages, re.MULTILINE))
    modules = set(re.findall(r"^## (\w+): ", pages, re.MULTILINE))
    missing = sorted(set(nc.__all__) - listed - modules)
    assert not missing, f"add to a page of docs/api, as autosummary and autoclass or autofunction: {missing}"


@pytest.mark.slow
def test_pages_build(tmp_path: Path):
    """As HTML, without a warning."""
    for package in ("sphinx", "furo", "myst_nb"):
        pytest.importorskip(package, reason='pages are built with: python -m pip install ".[docs]"')
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "-E",
        "-q",
        "-b",
        "html",
        str(DOCS),
        str(tmp_path / "html"),
    ]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]
    assert (tmp_path / "html" / "index.html").exists()


def failing_examples(name: str) -> str:
    """What doctest says of the examples of a module that fail."""
    module, lines = importlib.import_module(name), []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for example in doctest.DocTestFinder(exclude_empty=True).find(module, name):
        runner.run(example, out=lines.append)
    return "".join(lines)


def test_examples_in_docstrings():
    wrong = [text for name in MODULES if name not in COMPILING and (text := failing_examples(name))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) for name in SLOW]
    + [pytest.param(name, marks=pytest.mark.exhaustive) for name in EXHAUSTIVE],
)
def test_examples_that_compile_in_docstrings(name: str):
    text = failing_examples(f"natcoord_jax.{name}")
    assert not text, text
