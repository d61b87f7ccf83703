"""Snapshots of a motion above its energies over time."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.viz.plot import Curve, Panel, draw
from natcoord_jax.viz.stage import Stage, pictures

COLUMNS = 4


def plot_snapshots(
    phases: Phases,
    times: Sequence[float],
    panels: Sequence[tuple[str, Sequence[Curve]]],
    *,
    beams: Sequence[BeamHandle] = (),
    view: tuple[float, float] = (15.0, 25.0),
) -> Figure:
    """Pictures of a motion at some times, with diagrams of energies below.

    Args:
        phases: the motion.
        times: of the snapshots [s]; those after the end are left out.
        panels: title and curves [J] of each diagram.
        beams: handles of beams, whose sections are drawn.
        view: elevation and azimuth of the eye [deg].
    """
    end = float(phases.t[-1])
    shown = pictures(phases, np.array([t for t in times if t <= end + 1e-9 * (1 + end)]), beams)
    frames = [(at, k) for at in shown for k in range(len(at.t))]
    rows = -(-len(frames) // COLUMNS)
    figure = plt.figure(figsize=(3.2 * COLUMNS, 3.2 * rows + 3.6), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=(3.2 * rows, 3.6))
    above, below = halves
    points = np.concatenate([at.points for at in shown])
    for number, frame in enumerate(frames):
        axes = above.add_subplot(rows, COLUMNS, number + 1, projection="3d")
        axes.view_init(*view)
        axes.set_axis_off()
        Stage(axes, shown[0], points, "t = {:g} s").show(*frame)
        axes.set_box_aspect((1, 1, 1), zoom=1.4)
    grid = below.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, curves) in zip(grid, panels):
        draw(axes, Panel(title, "[J]", list(curves)))
    return figure
