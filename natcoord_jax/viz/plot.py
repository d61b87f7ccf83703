"""Curves over time: energies, momenta, constraint errors, work and joint coordinates of a trajectory."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from natcoord_jax.analysis.accuracy import Accuracy
from natcoord_jax.analysis.phases import Phases
from natcoord_jax.assembly.system import System
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Vector
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.viz.panels import Curve, Panel, plot_panels
from natcoord_jax.viz.snapshots import plot_snapshots
from natcoord_jax.viz.stage import BEAMS, phases_of
from natcoord_jax.viz.work_precision import plot_accuracy

AXES = "xyz"
MOST_STORES = 6
"""More stores of energy than this are summed by kind."""
ROUND_OFF = 1e-17
"""Errors below it are drawn as if they were as large, on the logarithmic scale."""


def _components(label: str, t: np.ndarray, vectors: np.ndarray) -> list[Curve]:
    return [Curve(f"{label}{AXES[k]}", t, vectors[:, k]) for k in range(3)]


def _stores(system: System, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Stored energies by name, or by kind of effect if there are many."""
    stores = {name: np.asarray(values) for name, values in system.energy(trajectory).stores.items()}
    if len(stores) <= MOST_STORES:
        return stores
    kinds: dict[str, np.ndarray] = {}
    for group in system.effects:
        for name in group.labels:
            if name in stores:
                kind = group.effect.kind
                kinds[kind] = kinds.get(kind, 0.0) + stores[name]
    return kinds


def _energies(system: System, trajectory: Trajectory, t: np.ndarray) -> Panel:
    energy, work = system.energy(trajectory), system.work(trajectory)
    curves = [Curve("kinetic", t, np.asarray(energy.kinetic))]
    curves += [Curve(name, t, values) for name, values in _stores(system, trajectory).items()]
    if energy.stores:
        curves.append(Curve("total", t, np.asarray(energy.total), dashed=True))
    if work:
        total = np.sum([np.asarray(w) for w in work.values()], axis=0)
        curves.append(Curve("work", t, total, dashed=True))
    return Panel("energy by store", "[J]", curves)


def _coordinates(system: System, trajectory: Trajectory, t: np.ndarray) -> list[Panel]:
    values, names = np.asarray(trajectory.states.coordinates), system.structure.coordinates
    units = {int(i): group.axis.unit for group in system.coordinates for i in np.asarray(group.index)}
    panels = []
    for title, unit in (("joint angles", "rad"), ("joint displacements", "m")):
        curves = [
            Curve(name if k == 0 else f"{name} [{k}]", t, values[:, i])
            for i, (name, k) in enumerate(names)
            if units[i] == unit
        ]
        panels += [Panel(title, f"[{unit}]", curves)] if curves else []
    return panels


def _held(label: str, t: np.ndarray, values: np.ndarray) -> Curve:
    """Values held over steps, as a staircase."""
    return Curve(label, np.repeat(t, 2)[1:-1], np.repeat(values, 2))


def plot_solution(solution: Solution) -> Figure:
    """Inputs, joint rates, attitudes of free bodies, angular momentum, and how the method converged."""
    system, trajectory = solution.system, solution.trajectory
    t, inputs = np.asarray(trajectory.t), np.asarray(solution.inputs)
    channels = system.structure.inputs
    panels = [Panel("inputs", "[N, N m]", [_held(name, t, inputs[:, k]) for k, name in enumerate(channels)])]
    rates: list[Curve] = []
    for name in dict.fromkeys(joint for joint, _ in system.structure.coordinates):
        sensed = np.asarray(system.sense(trajectory, name).rates)
        rates += [Curve(name, t, sensed[:, k]) for k in range(sensed.shape[1])]
    if rates:
        panels.append(Panel("joint rates", "[rad/s, m/s]", rates))
    roots = [name for k, name in enumerate(system.structure.bodies) if _is_free(system, k)]
    for name in roots[:1]:
        sensed = np.asarray(system.sense(trajectory, name).quaternion)
        curves = [Curve(f"q{k}", t, sensed[:, k]) for k in range(4)]
        panels.append(Panel(f"attitude of {name!r}, quaternion (w, x, y, z)", "[-]", curves))
        spin = np.asarray(system.sense(trajectory, name).angular_velocity)
        panels.append(Panel(f"angular velocity of {name!r}", "[rad/s]", _components("ω", t, spin)))
    if not rates and not roots:
        panels += _coordinates(system, trajectory, t)
    momentum = np.asarray(system.angular_momentum(trajectory))
    panels.append(Panel("angular momentum about the origin", "J [kg m²/s]", _components("J", t, momentum)))
    numbers = np.array([row.iteration for row in solution.history], float)
    if numbers.size:
        gradient = np.maximum([row.stationarity for row in solution.history], ROUND_OFF)
        violation = np.maximum([row.violation for row in solution.history], ROUND_OFF)
        curves = [Curve("gradient, relative", numbers, gradient), Curve("violation", numbers, violation)]
        panels.append(Panel("convergence", "", curves, logarithmic=True, abscissa="iteration"))
    return plot_panels(panels)


def _is_free(system: System, body: int) -> bool:
    """Whether a body hangs on the ground with six free motions."""
    parent = int(np.asarray(system.tree.parent)[body])
    own = np.asarray(system.tree.slot_of) // 7 == body
    return parent == len(system.structure.bodies) and int(own.sum()) == 6


DRAWN = of(
    "a system, nc.Phases(...), a solution, or what nc.accuracy(...) found", System, Phases, Solution, Accuracy
)


@checked(system=DRAWN, trajectory=TRAJECTORY, times=Vector(None), beams=BEAMS)
def plot(
    system: System | Phases | Solution | Accuracy,
    trajectory: Trajectory | None = None,
    *,
    times: Sequence[float] | None = None,
    beams: Sequence[BeamHandle] = (),
) -> Figure:
    """Energies by store, momenta, constraint errors, work and joint coordinates over time.

    Args:
        system: compiled system; or a motion in phases, a solution of an optimal control problem, or what
            `accuracy` found, which need no trajectory.
        trajectory: of one lane, computed with it.
        times: of pictures of the motion above the diagrams [s]; None: no pictures.
        beams: handles of beams, whose sections are drawn in the pictures; others are round.

    Returns:
        The figure.

    Raises:
        ValueError: for a trajectory of a batch, or none; or times without a motion.

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
        return plot_solution(system)
    if isinstance(system, Accuracy):
        return plot_accuracy(system)
    phases = phases_of(system, trajectory, "plot")
    panels = _joined([_panels(*pair) for pair in phases.pairs])
    return plot_panels(panels) if times is None else plot_snapshots(phases, times, panels, beams=beams)


def _joined(phases: list[list[Panel]]) -> list[Panel]:
    """Panels with the curves of all phases, joined by title and label."""
    panels: dict[str, Panel] = {}
    for panel in (panel for phase in phases for panel in phase):
        known = panels.setdefault(panel.title, panel._replace(curves=[]))
        for curve in panel.curves:
            same = [k for k, other in enumerate(known.curves) if other.label == curve.label]
            if same:
                before = known.curves[same[0]]
                t, values = (np.concatenate(x) for x in zip(before[1:3], curve[1:3]))
                known.curves[same[0]] = before._replace(t=t, values=values)
            else:
                known.curves.append(curve)
    return list(panels.values())


def _panels(system: System, trajectory: Trajectory) -> list[Panel]:
    """What is drawn of one trajectory."""
    t = np.asarray(trajectory.t)
    errors = system.constraint_errors(trajectory)
    constraints = [
        Curve("positions [m, -]", t, np.maximum(errors.position, ROUND_OFF)),
        Curve("velocities [m/s, 1/s]", t, np.maximum(errors.velocity, ROUND_OFF)),
    ]
    panels = [
        _energies(system, trajectory, t),
        Panel("momentum", "L [kg m/s]", _components("L", t, np.asarray(system.momentum(trajectory)))),
        Panel(
            "angular momentum about the origin",
            "J [kg m²/s]",
            _components("J", t, np.asarray(system.angular_momentum(trajectory))),
        ),
        Panel("largest constraint errors", "", constraints, logarithmic=True),
        *_coordinates(system, trajectory, t),
    ]
    work = system.work(trajectory)
    if work:
        curves = [Curve(name, t, np.asarray(values)) for name, values in work.items()]
        panels.append(Panel("work of inputs, loads, dampers, drives", "[J]", curves))
    return panels
