"""Panels of a solution of an optimal control problem, with its bounds and goals."""

import re

import numpy as np

from natcoord_jax.control import bounds
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.system import System
from natcoord_jax.viz.curves import ROUND_OFF, components, coordinates
from natcoord_jax.viz.panels import Curve, Panel


def _held(label: str, t: np.ndarray, values: np.ndarray) -> Curve:
    """Values held over steps, as a staircase."""
    return Curve(label, np.repeat(t, 2)[1:-1], np.repeat(values, 2))


def limits_of(solution: Solution) -> dict[str, set[float]]:
    """Finite limits by the kind of what they limit: "input", "coordinate" and "rate"."""
    system, given, found = solution.system, solution.problem.bounds, {}
    for bound in given.parts if isinstance(given, bounds.All) else (given,):
        if isinstance(bound, bounds.Range):
            values = np.concatenate([np.ravel(bound.lower), np.ravel(bound.upper)])
            kind = bound.names(system)[0].split(" ")[0]
            found.setdefault(kind, set()).update(float(x) for x in values if np.isfinite(x))
    return found


@eager_numpy
def _missing(goal, system, state):
    return goal.residual(system, state)


def goals_of(solution: Solution) -> dict[str, float]:
    """Values of joint coordinates and rates that are to be reached, by name, as "rate 0 of 'hinge'"."""
    system, goal = solution.system, solution.problem.goal
    if goal is None:
        return {}
    last = solution.trajectory[-1]
    missing = np.asarray(_missing(goal, system, last))
    found = {}
    for label, rest in zip(goal.labels(system), missing):
        known = re.match(r"(coordinate|rate) (\d+) of '(.*)' \[", label)
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
    rest = any(label.startswith("rest of") for label in _labels(solution))
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


def _labels(solution: Solution) -> tuple[str, ...]:
    goal = solution.problem.goal
    return () if goal is None else goal.labels(solution.system)


def _label(name: str) -> str:
    """Label of the curve of a coordinate or rate: the joint, with a number from the second on."""
    _, index, _, joint = name.split(" ", 3)
    return joint[1:-1] if index == "0" else f"{joint[1:-1]} [{index}]"


def solution_panels(solution: Solution) -> list[Panel]:
    """Inputs, joints, attitudes of free bodies, angular momentum, and how the method converged."""
    system, trajectory = solution.system, solution.trajectory
    t, inputs = np.asarray(trajectory.t), np.asarray(solution.inputs)
    held = [_held(name, t, inputs[:, k]) for k, name in enumerate(system.structure.inputs)]
    panels = [Panel("inputs", "[N, N m]", held, bounds=sorted(limits_of(solution).get("input", ())))]
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
