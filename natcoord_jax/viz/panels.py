"""Diagrams over time, side by side."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

LEGEND_ENTRIES = 10
"""More curves than this in one panel go without a legend."""
SAME = 5e-3
"""Curves that differ by less than this share of the panel lie on each other to the eye."""
DASH = 4.0


class Curve(NamedTuple):
    """One curve.

    Attributes:
        label: in the legend.
        t: times [s].
        values: at these times.
        dashed: sets it apart.
        band: lower and upper edge of what a batch covers, about its median; None: one run.
    """

    label: str
    t: np.ndarray
    values: np.ndarray
    dashed: bool = False
    band: tuple[np.ndarray, np.ndarray] | None = None


class Panel(NamedTuple):
    """One diagram over time.

    Attributes:
        title: above it.
        ordinate: label of the ordinate with its unit.
        curves: what is drawn.
        logarithmic: whether the ordinate is.
        abscissa: label of the abscissa.
        bounds: values that must not be passed.
        goals: points (t, value) that are to be reached.
        limits: of the ordinate; None: what the curves need.
        shaded: the part of the ordinate that is only round-off.
    """

    title: str
    ordinate: str
    curves: list[Curve]
    logarithmic: bool = False
    abscissa: str = "t [s]"
    bounds: Sequence[float] = ()
    goals: Sequence[tuple[float, float]] = ()
    limits: tuple[float, float] | None = None
    shaded: tuple[float, float] | None = None


def _sharing(panel: Panel) -> list[list[int]]:
    """Numbers of the curves that lie on each other, one list for each that is seen."""
    drawn = [np.log10(np.abs(c.values) + 1e-300) if panel.logarithmic else c.values for c in panel.curves]
    known = [values[np.isfinite(values)] for values in drawn]
    every = np.concatenate([np.zeros(0), *known])
    size = float(np.ptp(every)) if every.size else 0.0
    found: list[list[int]] = []
    for number, values in enumerate(drawn):
        for group in found:
            other = drawn[group[0]]
            if values.shape == other.shape and np.allclose(values, other, 0.0, SAME * size, equal_nan=True):
                group.append(number)
                break
        else:
            found.append([number])
    return found


def draw(axes: Axes, panel: Panel) -> None:
    """Draw one diagram; curves on each other as dashes in turn."""
    styles = {}
    for group in _sharing(panel):
        for place, number in enumerate(group):
            # The first is drawn through and wide, the others on it, in dashes that do not cover each other.
            gap = DASH * max(len(group) - 1, 1)
            styles[number] = ("-", 3.0 if len(group) > 1 else 1.2)
            if place:
                styles[number] = ((DASH * (place - 1), (DASH, gap)), 1.4)
    for number, curve in enumerate(panel.curves):
        style, width = styles[number]
        style = "--" if curve.dashed and style == "-" else style
        [line] = axes.plot(curve.t, curve.values, linestyle=style, label=curve.label, linewidth=width)
        if curve.band is not None:
            axes.fill_between(curve.t, *curve.band, color=line.get_color(), alpha=0.2, linewidth=0)
    for number, bound in enumerate(panel.bounds):
        axes.axhline(bound, color="0.4", linestyle=":", linewidth=1.0, label=None if number else "bound")
    if panel.goals:
        axes.plot(*zip(*panel.goals), "k*", markersize=9, label="goal", clip_on=False, zorder=5)
    if panel.logarithmic:
        axes.set_yscale("log")
    if panel.limits is not None:
        axes.set_ylim(*panel.limits)
    if panel.shaded is not None:
        axes.axhspan(*panel.shaded, color="0.93", zorder=0, label="round-off")
    axes.set(title=panel.title, xlabel=panel.abscissa, ylabel=panel.ordinate)
    axes.grid(alpha=0.3)
    if len(panel.curves) <= LEGEND_ENTRIES:
        for key in axes.legend(fontsize="small").legend_handles:
            # Dashes that take turns are longer than a legend is wide: some would not be seen in it.
            if isinstance(key, Line2D) and key.get_linestyle() == "--":
                key.set_linestyle("--")


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
