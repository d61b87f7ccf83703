"""Curves over time: energies, balances, joint coordinates, momenta and works of a motion, and solutions."""

import re
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from natcoord_jax.analysis.accuracy_table import Accuracy
from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control import bounds
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import Concrete, of
from natcoord_jax.core.numeric import Vector
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.curves import ROUND_OFF, as_bands, components, coordinates, in_turn, panels_of
from natcoord_jax.viz.motion import BEAMS, is_batch, lanes_of, longest_of, runs_of, together
from natcoord_jax.viz.panels import Curve, Panel, draw, plot_panels, shown_once
from natcoord_jax.viz.stage import Stage


def limits_of(solution: Solution) -> dict[str, set[float]]:
    """Finite limits by the kind of what they limit: "input", "coordinate" and "rate"."""
    system, given, found = solution.system, solution.problem.bounds, {}
    for bound in given.parts if isinstance(given, bounds.All) else (given,):
        if isinstance(bound, bounds.Range):
            values = np.concatenate([np.ravel(bound.lower), np.ravel(bound.upper)])
            kind = bound.names(system)[0].split(" ")[0]
            found.setdefault(kind, set()).update(float(x) for x in values if np.isfinite(x))
    return found


def goals_of(solution: Solution) -> dict[str, float]:
    """Values of joint coordinates and rates that are to be reached, by name, as "rate 0 of 'hinge'"."""
    system, last, found = solution.system, solution.trajectory[-1], {}
    for label, rest in solution.missing.items():
        # (Not those at waypoints.)
        known = re.fullmatch(r"(coordinate|rate) (\d+) of '(.*)' \[[^\[\]]*\](?: #\d+)?", label)
        if known:
            kind, index, joint = known[1], int(known[2]), known[3]
            look = system.coordinate if kind == "coordinate" else system.rate
            found[f"{kind} {index} of {joint!r}"] = float(look(last, joint, index=index)) - float(rest)
    return found


def _is_free(system: System, body: int) -> bool:
    """Whether a body hangs on the ground with six free motions."""
    parent = int(np.asarray(system.tree.parent)[body])
    own = np.asarray(system.tree.slot_of) // 7 == body
    return parent == len(system.structure.bodies) and int(own.sum()) == 6


def _joints(solution: Solution, t: np.ndarray) -> list[Panel]:
    """Joint coordinates beside their rates, with bounds and goals."""
    limits, goals, end = limits_of(solution), goals_of(solution), float(t[-1])
    goal = solution.problem.goal
    labels = () if goal is None else goal.labels(solution.system)
    rest = any(label.startswith("rest of") for label in labels)
    found = []
    for panel in coordinates(solution.system, solution.trajectory, t):
        kind = "rate" if panel.ordinate.endswith("/s]") else "coordinate"
        names = {curve.label for curve in panel.curves}
        wanted = [
            (end, value) for name, value in goals.items()
            if name.startswith(kind) and _label(name) in names
        ]  # fmt: skip
        wanted += [(end, 0.0)] if rest and kind == "rate" else []
        found.append(panel._replace(bounds=sorted(limits.get(kind, ())), goals=wanted))
    return found


def _label(name: str) -> str:
    """Label of the curve of a coordinate or rate: the joint, with a number from the second on."""
    _, index, _, joint = name.split(" ", 3)
    return joint[1:-1] if index == "0" else f"{joint[1:-1]} [{index}]"


def solution_panels(solution: Solution) -> list[Panel]:
    """Inputs, joints, attitudes of free bodies, angular momentum, and how the method converged."""
    system, trajectory = solution.system, solution.trajectory
    t, inputs = np.asarray(trajectory.t), np.asarray(solution.inputs)
    # Values are kept over steps: staircases.
    ends, names = np.repeat(t, 2)[1:-1], system.structure.inputs
    stairs = [Curve(name, ends, np.repeat(inputs[:, k], 2)) for k, name in enumerate(names)]
    panels = [Panel("inputs", "[N, N m]", stairs, bounds=sorted(limits_of(solution).get("input", ())))]
    panels += _joints(solution, t)
    roots = [name for k, name in enumerate(system.structure.bodies) if _is_free(system, k)]
    for name in roots[:1]:
        sensed = np.asarray(system.sense(trajectory, name).quaternion)
        curves = [Curve(f"q{k}", t, sensed[:, k]) for k in range(4)]
        panels.append(Panel(f"attitude of {name!r}, quaternion (w, x, y, z)", "[-]", curves))
        spin = np.asarray(system.sense(trajectory, name).angular_velocity)
        panels.append(Panel(f"angular velocity of {name!r}", "[rad/s]", components("ω", t, spin)))
    momentum = np.asarray(system.angular_momentum(trajectory))
    panels.append(Panel("angular momentum about the origin", "J [kg m²/s]", components("J", t, momentum)))
    numbers = np.array([row.iteration for row in solution.history], float)
    if numbers.size:
        gradient = np.maximum([row.stationarity for row in solution.history], ROUND_OFF)
        violation = np.maximum([row.violation for row in solution.history], ROUND_OFF)
        curves = [Curve("gradient, relative", numbers, gradient), Curve("violation", numbers, violation)]
        panels.append(Panel("convergence", "", curves, logarithmic=True, abscissa="iteration"))
    return panels


MOST_LANES = 64
"""Of a larger batch every so many runs are drawn."""
DRAWN = of(
    "a system, nc.Phases(...), a solution, or what nc.accuracy(...) found", System, Phases, Solution, Accuracy
)


@checked(system=DRAWN, trajectory=Concrete(TRAJECTORY), times=Vector(None), beams=BEAMS)
def plot(
    system: System | Phases | Solution | Accuracy,
    trajectory: Trajectory | None = None,
    *,
    times: Sequence[float] | None = None,
    beams: Sequence[BeamHandle] = (),
) -> Figure:
    """Energies by store, errors of what is kept, joint coordinates beside their rates, momenta, works.

    What is kept is drawn as its relative error on a logarithmic scale, see `nc.balance`; momenta that change
    are drawn as they are. Curves that lie on each other are dashed in turn.

    Args:
        system: compiled system; or a motion in phases, a solution of an optimal control problem, with its
            bounds and goals, or what `accuracy` found, which need no trajectory.
        trajectory: computed with it; curves of a batch are medians in bands from the least to the largest.
        times: of pictures of the motion above the diagrams [s], of a batch of its first run with the others
            as ghosts; those that the motion has not are left out; None: no pictures.
        beams: handles of beams, whose sections are drawn in the pictures; others are round.

    Returns:
        The figure.

    Raises:
        ValueError: for no trajectory, times without a motion, or none that it has.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> figure = nc.plot(system, nc.simulate(system, state, dt=0.1, steps=10))
    """
    if isinstance(system, Solution | Accuracy) and times is not None:
        raise ValueError("plot: times [s] are for pictures of a motion; pass a system and a trajectory")
    if isinstance(system, Solution):
        return plot_panels(solution_panels(system))
    if isinstance(system, Accuracy):
        return plot_accuracy(system)
    phases = lanes_of(system, trajectory, "plot")
    drawn = [in_turn([panels_of(*pair) for pair in run.pairs]) for run in runs_of(phases, MOST_LANES)]
    panels = as_bands(drawn) if is_batch(phases) else drawn[0]
    return plot_panels(panels) if times is None else plot_snapshots(phases, times, panels, beams=beams)


def plot_accuracy(found: Accuracy) -> Figure:
    """Errors over time and over steps, one curve an order, on logarithmic scales."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    for order in sorted({row.order for row in found.rows}):
        rows = [r for r in found.rows if r.order == order and r.result == "successful" and r.error > 0]
        errors = [r.error for r in rows]
        axes[0].loglog([1e3 * r.wall_s for r in rows], errors, "o-", markersize=4, label=f"order {order}")
        axes[1].loglog([r.steps for r in rows], errors, "o-", markersize=4, label=f"order {order}")
    quantity = next(iter(found.rows[0].errors)) if found.rows else ""
    for diagram, abscissa in zip(axes, ("time [ms], without compilation", "steps")):
        if found.reference_error > 0:
            diagram.axhline(found.reference_error, color="0.6", linestyle="--", linewidth=1)
        diagram.set(xlabel=abscissa)
        diagram.grid(alpha=0.3)
    axes[0].set(ylabel=f"error of {quantity} at t = {found.t_end:g} s", title="what accuracy costs")
    axes[1].set(title="orders; dashed: error of the reference")
    axes[0].legend(fontsize="small")
    return figure


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
        times: of the snapshots [s]; those that the motion has not are left out.
        panels: the diagrams.
        beams: handles of beams, whose sections are drawn.
        caption: what there is to see, below the pictures.
        within: two corners of the box (2, 3) [m] that is looked into; None: all is seen.

    Raises:
        ValueError: if the motion has none of the times.
    """
    begin, end = float(phases.trajectories[0].t.min()), float(longest_of(runs_of(phases))[-1])
    margin = 1e-9 * (1 + abs(end))
    shown = [float(t) for t in times if begin - margin <= t <= end + margin]
    if not shown:
        raise ValueError(
            f"plot: times [s] has none of the motion, which goes from {begin:g} to {end:g} s; pass some of it"
        )
    scenery = together(phases, np.array(shown), beams=beams, within=within)
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
