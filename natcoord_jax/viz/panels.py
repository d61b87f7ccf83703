"""Diagrams over time, side by side."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

LEGEND_ENTRIES = 10
"""More curves than this in one panel go without a legend."""


class Curve(NamedTuple):
    """One curve: its label, times [s] and values; `dashed` sets it apart."""

    label: str
    t: np.ndarray
    values: np.ndarray
    dashed: bool = False


class Panel(NamedTuple):
    """One diagram over time: title, label of the ordinate with its unit, curves."""

    title: str
    ordinate: str
    curves: list[Curve]
    logarithmic: bool = False
    abscissa: str = "t [s]"


def draw(axes: Axes, panel: Panel) -> None:
    """Draw one diagram."""
    for curve in panel.curves:
        style = "--" if curve.dashed else "-"
        axes.plot(curve.t, curve.values, style, label=curve.label, linewidth=1.2)
    if panel.logarithmic:
        axes.set_yscale("log")
    axes.set(title=panel.title, xlabel=panel.abscissa, ylabel=panel.ordinate)
    axes.grid(alpha=0.3)
    if 1 < len(panel.curves) <= LEGEND_ENTRIES:
        axes.legend(fontsize="small")


def plot_panels(panels: Sequence[Panel], *, columns: int = 2) -> Figure:
    """Draw diagrams side by side.

    Args:
        panels: the diagrams.
        columns: how many in a row.

    Returns:
        The figure; a notebook shows it once, a script shows it with `plt.show()`.
    """
    rows = math.ceil(len(panels) / columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(5.2 * columns, 3.4 * rows), layout="constrained", squeeze=False
    )
    for axes, panel in zip(grid.flat, panels, strict=False):
        draw(axes, panel)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    return shown_once(figure)


def shown_once(figure: Figure) -> Figure:
    """A figure that a notebook shows where it is returned, and not a second time by pyplot."""
    if "inline" in matplotlib.get_backend():
        plt.close(figure)
    return figure
