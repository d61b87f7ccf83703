"""Notebooks are run as tests; those that compile much are slow ones."""

import pytest

SLOW = ("02", "03", "04", "05", "06", "07", "08", "10", "11", "12", "13", "14", "15", "16", "17", "18", "19")
"""Numbers of the notebooks that take long: all but the first, and the ninth, which takes longest."""


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow ones."""
    for item in items:
        # Many optima, each refined.
        if item.path.name.startswith("09"):
            item.add_marker(pytest.mark.exhaustive)
        elif item.path.suffix == ".ipynb" and item.path.name.startswith(SLOW):
            item.add_marker(pytest.mark.slow)
