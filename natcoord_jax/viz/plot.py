"""Curves over time: energies, balances, joint coordinates, momenta and works of a trajectory."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from natcoord_jax.analysis.accuracy_table import Accuracy
from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import Concrete, of
from natcoord_jax.core.numeric import Vector
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.curves import as_bands, in_turn, panels_of
from natcoord_jax.viz.motion import BEAMS, is_batch, lanes_of, runs_of
from natcoord_jax.viz.panels import plot_panels
from natcoord_jax.viz.snapshots import plot_snapshots
from natcoord_jax.viz.solutions import solution_panels
from natcoord_jax.viz.work_precision import plot_accuracy

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
            as ghosts; None: no pictures.
        beams: handles of beams, whose sections are drawn in the pictures; others are round.

    Returns:
        The figure.

    Raises:
        ValueError: for no trajectory, or times without a motion.

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
