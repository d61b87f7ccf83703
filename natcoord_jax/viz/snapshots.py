"""Snapshots of a motion above diagrams over time."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.viz.motion import longest_of, runs_of, together
from natcoord_jax.viz.panels import Panel, draw, shown_once
from natcoord_jax.viz.stage import Stage

COLUMNS = 4
"""Pictures in a row."""
MOST_IN_A_ROW = 3
"""Diagrams in a row."""


def plot_snapshots(
    phases: Phases,
    times: Sequence[float],
    panels: Sequence[Panel],
    *,
    beams: Sequence[BeamHandle] = (),
    caption: str = "",
    within: Any = None,
) -> Figure:
    """Pictures of a motion at some times, with diagrams below.

    Args:
        phases: the motion; of a batch the first run with the others as ghosts.
        times: of the snapshots [s]; those after the end are left out.
        panels: the diagrams.
        beams: handles of beams, whose sections are drawn.
        caption: what there is to see, below the pictures.
        within: two corners of the box (2, 3) [m] that is looked into; None: all is seen.
    """
    end = float(longest_of(runs_of(phases))[-1])
    scenery = together(
        phases, np.array([t for t in times if t <= end + 1e-9 * (1 + end)]), beams=beams, within=within
    )
    frames = range(len(scenery.t))
    rows = -(-len(frames) // COLUMNS)
    wide = 2 if len(panels) == 4 else min(len(panels), MOST_IN_A_ROW)
    high = 3.6 * -(-len(panels) // wide)
    figure = plt.figure(figsize=(3.2 * COLUMNS, 3.2 * rows + high), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=(3.2 * rows, high))
    above, below = halves
    for frame in frames:
        axes = above.add_subplot(rows, COLUMNS, frame + 1, projection="3d")
        Stage(axes, scenery, labelled=False, zoom=1.25).show(frame, "t = {:.4g} s")
    if caption:
        below.suptitle(caption, fontsize=10, x=0.02, ha="left")
    grid = list(below.subplots(-(-len(panels) // wide), wide, squeeze=False).flat)
    for axes, panel in zip(grid, panels):
        draw(axes, panel)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    return shown_once(figure)
