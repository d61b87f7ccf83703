"""Settings of the pages: `sphinx-build -W -b html docs docs/_build/html`."""

import re
import shutil
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).resolve().parent

project = "natcoord_jax"
author = "The natcoord_jax developers"
project_copyright = author
release = version_of("natcoord-jax")
version = release

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "natcoord_jax"
html_static_path: list[str] = []

# Notebooks are shown as they are stored: tests run them.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
suppress_warnings = [
    "mystnb.unknown_mime_type",  # what a notebook stored for other viewers
    "misc.highlighting_failure",
]

autosummary_generate = False
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Class attributes", "params_style")]
# Names in single backticks are code here.
default_role = "code"


def bring_notebooks(app) -> None:
    """Copy the notebooks to where Sphinx looks for its sources."""
    folder = HERE / "notebooks"
    folder.mkdir(exist_ok=True)
    for file in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        copy = folder / file.name
        if not copy.exists() or copy.read_bytes() != file.read_bytes():
            shutil.copyfile(file, copy)


def lead_to_copies(app, docname: str, source: list[str]) -> None:
    """Links to notebooks, which are true in the repository, lead to their copies here."""
    up = "../" * docname.count("/")
    source[0] = source[0].replace(f"]({up}../notebooks/", f"]({up}notebooks/")


def keep_signs(app, what, name, obj, options, lines: list[str]) -> None:
    """Let `|u|`, `*` and a trailing `_` in docstrings stand for themselves, as they do in plain text."""
    for k, line in enumerate(lines):
        if line.lstrip().startswith((">>>", "...")):
            continue
        parts = re.split(r"(`[^`]*`)", line)
        for i in range(0, len(parts), 2):
            parts[i] = re.sub(r"(?<!\\)([|*])", r"\\\1", parts[i])
            parts[i] = re.sub(r"(?<=\w)_(?=\W|$)", r"\\_", parts[i])
        lines[k] = "".join(parts)


def keep_types(app, what, name, obj, options, lines: list[str]) -> None:
    """Let types of attributes stand as they are written: their shapes are no markup."""
    for k, line in enumerate(lines):
        lines[k] = re.sub(r"^(:vartype [^:]+:) (.+)$", r"\1 ``\2``", line)


def setup(app) -> None:
    """Connect what is above, before and after napoleon."""
    app.connect("builder-inited", bring_notebooks)
    app.connect("source-read", lead_to_copies)
    app.connect("autodoc-process-docstring", keep_signs, priority=100)
    app.connect("autodoc-process-docstring", keep_types, priority=900)
