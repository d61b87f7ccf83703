"""What every peer reports: time per step, the final state, its energies; and the command line they share."""

import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.peers import (
    bricard,
    double_pendulum,
    four_bar,
    heavy_top,
    open_tree,
    spacecraft,
    spinning_spacecraft,
    stiff_chain,
)

_MODULES = (
    spacecraft,
    spinning_spacecraft,
    open_tree,
    heavy_top,
    double_pendulum,
    four_bar,
    bricard,
    stiff_chain,
)
MODELS = {module.NAME: module for module in _MODULES}


ENOUGH = 10.0
"""Calls are repeated no more than `FEW` times where that takes longer [s]."""
FEW = 3


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call [s]."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def times_per_call(call: Callable[[], object], repeats: int) -> list[float]:
    """Wall time of each of at most `repeats` calls [s], after one call that is not counted."""
    call()
    times: list[float] = []
    while len(times) < repeats and (len(times) < FEW or sum(times) < ENOUGH):
        times.append(seconds(call))
    return times


def per_step(times: list[float], steps: int) -> dict:
    """Median, smallest and largest time per step [us]."""
    us = [1e6 * t / steps for t in times]
    return {"us_per_step": statistics.median(us), "us_per_step_range": [min(us), max(us)], "repeats": len(us)}


def turning(body: dict) -> np.ndarray:
    """Angular velocity of a body at the start [rad/s]; none given: zero."""
    return np.array(body.get("angular_velocity", (0.0, 0.0, 0.0)))


def moving(body: dict) -> np.ndarray:
    """Velocity of the centre of mass at the start [m/s]; none given: everything turns about the origin."""
    return np.array(body.get("velocity", np.cross(turning(body), body["com"])))


def loops(model) -> Sequence[dict]:
    """The joints that close loops, see `four_bar`; none where the data have none."""
    return getattr(model, "LOOPS", ())


def _relative_angle(body: dict, rotation: np.ndarray, parent_rotation: np.ndarray) -> float:
    """Angle of a revolute joint [rad], in (-pi, pi]."""
    turn, axis = parent_rotation.T @ rotation, np.asarray(body["axes"][0])
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.arctan2(axis @ skew, np.trace(turn) - 1.0))


def potential_energy(model, position: np.ndarray, rotation: np.ndarray) -> float:
    """Gravity, torsional and point springs [J].

    Args:
        model: a module of data, `open_tree` or `spacecraft`.
        position: centres of mass (bodies, 3) [m].
        rotation: rotation of each body from the pose of the data (bodies, 3, 3).
    """

    def place(body, point):
        if body is None:
            return np.asarray(point)
        return position[body] + rotation[body] @ np.subtract(point, model.BODIES[body]["com"])

    energy = 0.0
    for i, body in enumerate(model.BODIES):
        energy -= body["mass"] * np.dot(model.GRAVITY, position[i])
        if body["stiffness"]:
            parent = np.eye(3) if body["parent"] is None else rotation[body["parent"]]
            energy += 0.5 * body["stiffness"] * _relative_angle(body, rotation[i], parent) ** 2
    for s in model.POINT_SPRINGS:
        length = np.linalg.norm(place(s["body_b"], s["point_b"]) - place(s["body_a"], s["point_a"]))
        energy += 0.5 * s["stiffness"] * (length - s["length"]) ** 2
    return float(energy)


def kinetic_energy(model, rotation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray) -> float:
    """Kinetic energy [J]; arguments as in `final_state`."""
    energy = 0.0
    for body, turn, v, w in zip(model.BODIES, rotation, velocity, angular_velocity, strict=True):
        energy += 0.5 * body["mass"] * (v @ v) + 0.5 * np.dot(body["inertia"], (turn.T @ w) ** 2)
    return float(energy)


def angular_momentum(
    model, position: np.ndarray, rotation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray
) -> np.ndarray:
    """Angular momentum about the origin (3,) [kg m2/s]; arguments as in `final_state`."""
    total = np.zeros(3)
    states = zip(model.BODIES, position, rotation, velocity, angular_velocity, strict=True)
    for body, x, turn, v, w in states:
        total += body["mass"] * np.cross(x, v) + turn @ (np.asarray(body["inertia"]) * (turn.T @ w))
    return total


def final_state(model, position, rotation, velocity, angular_velocity) -> dict:
    """The quantities that errors are measured in.

    Args:
        model: a module of data, `open_tree` or `spacecraft`.
        position: centres of mass (bodies, 3) [m].
        rotation: rotation of each body from the pose of the data (bodies, 3, 3).
        velocity: of the centres of mass, world axes (bodies, 3) [m/s].
        angular_velocity: world axes (bodies, 3) [rad/s].

    Returns:
        positions [m], kinetic_energy [J], energy (kinetic and potential) [J], angular_momentum [kg m2/s],
        base_rotation and base_angular_velocity [rad/s] of the first body.
    """
    x, turn, v, w = (np.asarray(a, dtype=float) for a in (position, rotation, velocity, angular_velocity))
    kinetic = kinetic_energy(model, turn, v, w)
    return {
        "positions": x.tolist(),
        "kinetic_energy": kinetic,
        "energy": kinetic + potential_energy(model, x, turn),
        "angular_momentum": angular_momentum(model, x, turn, v, w).tolist(),
        "base_rotation": turn[0].tolist(),
        "base_angular_velocity": w[0].tolist(),
    }


def energies(state: dict) -> list[float]:
    """What a record of a long run keeps of a `final_state`: kinetic energy and energy [J]."""
    return [state["kinetic_energy"], state["energy"]]


def command_line(run: Callable[..., dict]) -> None:
    """`python -m benchmarks.peers.<peer>_models MODEL STEPS [key=value ...]` prints one JSON line."""
    if len(sys.argv) < 3 or sys.argv[1] not in MODELS:
        sys.exit(f"usage: MODEL STEPS [key=value ...], MODEL one of {', '.join(MODELS)}")
    settings = {}
    for pair in sys.argv[3:]:
        key, _, value = pair.partition("=")
        try:
            settings[key] = json.loads(value)
        except json.JSONDecodeError:
            settings[key] = value
    print(json.dumps(run(sys.argv[1], int(sys.argv[2]), **settings)))
