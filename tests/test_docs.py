"""What the documentation shows runs: blocks of the README, examples in docstrings."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import natcoord_jax

README = Path(__file__).resolve().parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(natcoord_jax.__path__, "natcoord_jax.")
    if not module.name.endswith("__main__")
)


@pytest.mark.slow
def test_readme_runs():
    assert len(BLOCKS) >= 3, "README.md shows no code"
    names: dict = {"__name__": "readme"}
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"README.md, block {number + 1}", "exec"), names)
    assert names["energies"].shape == (3,) and names["slower"] != 0
    assert names["gradient"].shape == names["torques"].shape


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name: str):
    failed, _ = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert not failed
