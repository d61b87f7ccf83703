"""How often optimal control converges from where a user starts, beside IPOPT on the same discrete problems.

usage: python -m benchmarks.control_starts [--starts N] [--problems NAME ...] [--method METHOD]
       [--limit ITERATIONS] [--patience SECONDS] [--solvers {natcoord_jax,IPOPT} ...]
       [--effort {quick,full}] [--json FILE]

Every problem is solved from the default start and from random ones: smooth random inputs and rates about it,
see `natcoord_jax.control.guess.scattered`. IPOPT gets the functions of `nc.to_nlp` at the same unknowns and
the states that follow from them, so that equations, bounds and exact derivatives are the same and only the
solver differs; its matrices are sparse. Times of both are without compilation, of programs with the effort
that is told. A file that exists keeps what it has of other problems and solvers.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import natcoord_jax as nc
from benchmarks import common, control_problems
from natcoord_jax.control.guess import scattered, unknowns_of
from natcoord_jax.control.problem import numeric
from natcoord_jax.control.run import chosen
from natcoord_jax.control.transcription import held_inputs
from natcoord_jax.gallery import manoeuvres

SOLVERS = ("natcoord_jax", "IPOPT")


class Case(NamedTuple):
    """A problem and its random starts.

    Attributes:
        problem: makes it.
        spread: standard deviation of the inputs of random starts [N, N m].
        rates: of their rates [rad/s, m/s].
    """

    problem: Callable[[], nc.OptimalControl]
    spread: float
    rates: float


def _turned(
    inertia: tuple[float, float, float],
    axis: tuple[float, float, float],
    degrees: float,
    *,
    limit: float | None = None,
    t_end: float = 1.0,
    steps: int = 20,
    free_time: Any = False,
) -> nc.OptimalControl:
    """A free body turned from rest to rest, by least effort or, with a limit of torques, in least time."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, name="body"))
    axes = tuple(nc.Direction(body, a, local=True) for a in np.eye(3))
    scene.add(nc.BodyTorqueInput(axes, name="torque"))
    system, state = scene.compile()
    direction, half = np.asarray(axis) / np.linalg.norm(axis), math.radians(degrees) / 2
    quaternion = np.concatenate([[math.cos(half)], math.sin(half) * direction])
    goal = nc.goal.Attitude(body, quaternion) & nc.goal.Rest()
    shared: dict[str, Any] = {"dt": t_end / steps, "steps": steps, "goal": goal}
    if limit is None:
        return nc.OptimalControl(system, state, cost=nc.cost.Effort(), **shared)
    bounds = nc.bounds.Input(-limit, limit)
    return nc.OptimalControl(
        system, state, cost=nc.cost.Duration(), bounds=bounds, free_time=free_time, **shared
    )


def _pendulum(cost: nc.cost.Cost, *, free_time: Any = False, steps: int = 60) -> nc.OptimalControl:
    """A rod of 1 kg, centre at 0.5 m, swung up by at most 2 N m in 3 s or in free time."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    moments = (0.01, 1 / 12, 1 / 12)
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=moments, com=(0, 0, -0.5), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(hinge, math.pi) & nc.goal.Rest()
    bounds = nc.bounds.Input(-2.0, 2.0)
    return nc.OptimalControl(
        system, state, dt=3.0 / steps, steps=steps, cost=cost, goal=goal, bounds=bounds, free_time=free_time
    )


def _cart(
    poles: int,
    *,
    cost: nc.cost.Cost,
    limit: float,
    dt: float,
    steps: int,
    free_time: Any = False,
    masses: tuple[float, float] = (1.0, 0.1),
    length: float = 0.5,
    thin: bool = False,
) -> nc.OptimalControl:
    """Poles on a cart, one on the other, swung up to rest with the cart where it was."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cart = scene.add(nc.RigidBody(mass=masses[0], inertia=(0.1, 0.1, 0.1), name="cart"))
    slide = scene.add(nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="slide"))
    moment = 1e-9 if thin else masses[1] * length**2 / 12
    offset = length if thin else length / 2
    goal = nc.goal.Coordinate(slide, 0.0)
    before, height = cart, 0.0
    for k in range(poles):
        inertia = (moment, moment, min(1e-4, moment))
        com = (0.0, 0.0, height - offset)
        pole = scene.add(nc.RigidBody(mass=masses[1], inertia=inertia, com=com, name=f"pole {k + 1}"))
        hinge = nc.Revolute(before, pole, point=(0.0, 0.0, height), axis=(0, 1, 0), name=f"hinge {k + 1}")
        goal = goal & nc.goal.Coordinate(scene.add(hinge), math.pi if k == 0 else 0.0)
        before, height = pole, height - length
    scene.add(nc.JointForce(slide, name="force"))
    system, state = scene.compile()
    bounds = nc.bounds.Input(-limit, limit)
    goal = goal & nc.goal.Rest()
    return nc.OptimalControl(
        system, state, dt=dt, steps=steps, cost=cost, goal=goal, bounds=bounds, free_time=free_time
    )


def _acrobot(steps: int = 80, t_end: float = 4.0) -> nc.OptimalControl:
    """Two links of 1 m and 1 kg, a motor in the elbow only, |u| <= 10 N m, swung up by least effort."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    inertia = (1 / 12, 1 / 12, 0.01)
    upper = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=(0, 0, -0.5), name="upper"))
    lower = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=(0, 0, -1.5), name="lower"))
    shoulder = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 1, 0), name="shoulder"))
    elbow = scene.add(nc.Revolute(upper, lower, point=(0, 0, -1.0), axis=(0, 1, 0), name="elbow"))
    scene.add(nc.JointTorque(elbow, name="motor"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(shoulder, math.pi) & nc.goal.Coordinate(elbow, 0.0) & nc.goal.Rest()
    return nc.OptimalControl(
        system,
        state,
        dt=t_end / steps,
        steps=steps,
        cost=nc.cost.Effort(),
        goal=goal,
        bounds=nc.bounds.Input(-10.0, 10.0),
    )


def _arm(steps: int = 40, t_end: float = 1.0) -> nc.OptimalControl:
    """An arm of three links in space, two of its joints close to their limits on the way."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    joints, before = [], nc.ground
    axes = ((0, 0, 1), (0, 1, 0), (0, 1, 0))
    for k, axis in enumerate(axes):
        inertia = (0.02, 0.02, 0.005)
        link = scene.add(
            nc.RigidBody(mass=1.0, inertia=inertia, com=(0.2 + 0.4 * k, 0, 0), name=f"link {k + 1}")
        )
        joint = nc.Revolute(before, link, point=(0.4 * k, 0, 0), axis=axis, name=f"joint {k + 1}")
        joints.append(scene.add(joint))
        scene.add(nc.JointTorque(joints[-1], name=f"motor {k + 1}"))
        before = link
    system, state = scene.compile()
    targets = (1.5, -0.8, 1.2)
    goal = nc.goal.Rest()
    for joint, target in zip(joints, targets):
        goal = goal & nc.goal.Coordinate(joint, target)
    bounds = nc.bounds.Input(-30.0, 30.0)
    bounds = bounds & nc.bounds.Coordinate(-0.85, 0.2, joint=joints[1])
    bounds = bounds & nc.bounds.Coordinate(-0.2, 1.25, joint=joints[2])
    return nc.OptimalControl(
        system, state, dt=t_end / steps, steps=steps, cost=nc.cost.Effort(), goal=goal, bounds=bounds
    )


EFFORT, DURATION = nc.cost.Effort, nc.cost.Duration
CASES: dict[str, Case] = {
    "turn 90, principal": Case(lambda: _turned((1, 2, 3), (0, 0, 1), 90), 10.0, 1.0),
    "turn 90, skew": Case(lambda: manoeuvres.turn(40), 10.0, 1.0),
    "turn 180, x": Case(lambda: _turned((1, 2, 3), (1, 0, 0), 180), 10.0, 1.0),
    "turn 180, z": Case(lambda: _turned((1, 2, 3), (0, 0, 1), 180), 10.0, 1.0),
    "turn by wheels": Case(lambda: manoeuvres.turn(40, wheels=True), 10.0, 1.0),
    "sphere 180, least time": Case(
        lambda: _turned((1, 1, 1), (0, 0, 1), 180, limit=1.0, t_end=4.0, steps=60, free_time=(1.0, 10.0)),
        0.5,
        0.5,
    ),
    "craft 150, least time": Case(
        lambda: _turned(
            (5621.0, 4547.0, 2364.0), (1, 0, 0), 150, limit=50.0, t_end=60.0, steps=60, free_time=(10, 100)
        ),
        25.0,
        0.05,
    ),
    "spacecraft by wheels": Case(lambda: manoeuvres.reorientation(60), 50.0, 0.05),
    "spacecraft, failed wheel": Case(lambda: manoeuvres.reorientation(60, working=(1, 2)), 50.0, 0.05),
    "beanie": Case(manoeuvres.beanie, 5.0, 1.0),
    "two masses, effort": Case(manoeuvres.two_masses, 0.3, 0.3),
    "two masses, time": Case(lambda: manoeuvres.two_masses(fastest=True), 0.5, 0.3),
    "point pendulum": Case(manoeuvres.point_pendulum, 2.0, 1.0),
    "pendulum, effort": Case(lambda: _pendulum(EFFORT()), 1.0, 1.0),
    "pendulum, time": Case(lambda: _pendulum(DURATION(), free_time=(0.5, 10.0)), 1.0, 1.0),
    "pendulum, effort, free time": Case(lambda: _pendulum(EFFORT(), free_time=(0.5, 6.0)), 1.0, 1.0),
    "cart-pole, 1 m": Case(lambda: manoeuvres.cart_pole(60), 5.0, 1.0),
    "cart-pole, |u| <= 3": Case(
        lambda: _cart(
            1, cost=EFFORT(), limit=3.0, dt=0.05, steps=100, masses=(1.0, 0.2), length=0.5, thin=True
        ),
        1.0,
        1.0,
    ),
    "cart-pole, least time": Case(
        lambda: _cart(1, cost=DURATION(), limit=10.0, dt=0.04, steps=50, free_time=(0.5, 6.0)), 5.0, 1.0
    ),
    "two poles, least time": Case(
        lambda: _cart(2, cost=DURATION(), limit=20.0, dt=0.04, steps=60, free_time=(0.5, 6.0)), 10.0, 1.0
    ),
    "acrobot": Case(_acrobot, 2.0, 1.0),
    "arm with joint limits": Case(_arm, 2.0, 0.5),
    "panda, seven axes": Case(control_problems.panda, 2.0, 0.5),
    "flying robot": Case(control_problems.flying_robot, 0.1, 0.3),
    "two links, least time": Case(control_problems.two_links, 0.3, 0.5),
    "throw, two links": Case(control_problems.throw, 2.0, 1.0),
    "craft with beams": Case(control_problems.craft_with_beams, 0.5, 0.05),
}


def starts(problem: nc.OptimalControl, case: Case, method: str, count: int) -> list[nc.Guess]:
    """The default start, and random ones about it."""
    middle = unknowns_of(problem, None, chosen(problem, method, None))
    width = problem.system.structure.unknowns
    found = [nc.Guess()]
    for key in jax.random.split(jax.random.key(7), count + 1)[1:]:
        unknowns = scattered(problem, middle, key, case.spread, case.rates)
        inputs = np.asarray(held_inputs(problem, unknowns.coefficients))
        reduced = problem.system.structure.solver == "reduced"
        found.append(nc.Guess(inputs, rates=np.asarray(unknowns.y)[:, :width] if reduced else None))
    return found


def solved_by_ipopt(problem: nc.OptimalControl, guess: nc.Guess, patience: float) -> dict[str, Any]:
    """One solution by the peer, or what it has after so many seconds."""
    from natcoord_jax.control import ipopt

    answer = ipopt.solved(nc.to_nlp(problem, guess, states=True), max_wall_time=patience)
    return {
        "ok": answer.ok,
        "outcome": answer.status,
        "cost": answer.cost,
        "iterations": answer.iterations,
        "seconds": answer.seconds,
    }


def solved(
    problem: nc.OptimalControl, guess: nc.Guess, method: str, limit: int, patience: float
) -> dict[str, Any]:
    """One solution by natcoord_jax."""
    start, limits = time.perf_counter(), {"max_iterations": limit, "time_limit": patience}
    found = nc.optimise(problem, guess, method=method, progress=False, **limits)
    return {
        "ok": found.ok,
        "outcome": found.outcome.name,
        "cost": float(found.cost),
        "iterations": len(found.history),
        "seconds": time.perf_counter() - start,
        "method": found.method.split()[0],
    }


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The default start, and the share, best cost, median iterations and time of the random ones."""
    rest = [run for run in runs[1:] if run["ok"]]
    every = [run["cost"] for run in runs if run["ok"]]
    return {
        "default": runs[0],
        "share": len(rest) / max(1, len(runs) - 1),
        "best": min(every, default=math.nan),
        "iterations": statistics.median([run["iterations"] for run in rest] or [math.nan]),
        "seconds": statistics.median([run["seconds"] for run in rest] or [math.nan]),
        "failures": sorted(run["outcome"] for run in runs[1:] if not run["ok"]),
    }


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--problems", nargs="*", default=list(CASES), metavar="NAME")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--limit", type=int, default=500)
    parser.add_argument("--patience", type=float, default=120.0, help="seconds of a start, at most")
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--effort", default="full", choices=("quick", "full"))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    nc.set_effort(given.effort)
    known = json.loads(given.json.read_text()) if given.json and given.json.exists() else {}
    results = known.get("problems", {})
    for name in given.problems:
        case = CASES[name]
        problem = numeric(case.problem())
        guesses = starts(problem, case, given.method, given.starts)
        here = results.setdefault(name, {})
        about = common.about(float(problem.dt), problem.steps) | {"effort": given.effort}
        if "natcoord_jax" in given.solvers:
            # Compiled before it is timed.
            solved(problem, guesses[0], given.method, 2, given.patience)
            runs = [solved(problem, guess, given.method, given.limit, given.patience) for guess in guesses]
            here["natcoord_jax"] = about | summary(runs) | {"runs": runs}
        if "IPOPT" in given.solvers:
            runs = [solved_by_ipopt(problem, guess, given.patience) for guess in guesses]
            here["IPOPT"] = about | summary(runs) | {"runs": runs}
        for who, found in here.items():
            first = found["default"]
            print(
                f"{name:28} {who:12} {first['outcome']:14} {first['cost']:12.7g} {first['iterations']:4} "
                f"{100 * found['share']:4.0f} % best {found['best']:12.8g} "
                f"median {found['iterations']:5.0f} {found['seconds']:7.2f} s  "
                f"{', '.join(found['failures'])}",
                flush=True,
            )
        if given.json:
            now = common.circumstances("control_starts", quick=False)
            given.json.write_text(json.dumps(now | {"problems": results}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
