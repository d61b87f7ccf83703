"""Notebooks are run as tests: the first by default, some by value in the slow lane, others exhaustively."""

import pytest

DEFAULT = ("01",)
SLOW = ("03", "04", "05", "06", "13", "19")
"""Torques of a spacecraft, gradients, an effect of one's own, an optimum, identification, contact."""


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark them by their numbers."""
    for item in items:
        if item.path.suffix == ".ipynb" and not item.path.name.startswith(DEFAULT):
            slow = item.path.name.startswith(SLOW)
            item.add_marker(pytest.mark.slow if slow else pytest.mark.exhaustive)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """What is run once is compiled with least effort by default, too."""
    with pytest.MonkeyPatch.context() as patch:
        if item.path.suffix == ".ipynb":  # (Workers ask every `conftest.py` about every test.)
            patch.setenv("NATCOORD_JAX_EFFORT", "quick")
        return (yield)
