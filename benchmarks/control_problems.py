"""Problems of optimal control that others have published or solve every day, for `control_starts`."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import natcoord_jax as nc
from benchmarks.peers.panda import END, FRAMES, LIMITS, LINKS, RATES, START


def _turn(axis: str, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]] if axis == "x" else [[c, -s, 0], [s, c, 0], [0, 0, 1]])


class Rates(nc.cost.Cost):
    """Integral of the squares of the rates of all joints, with the weight of `panda.RATES`."""

    def running(self, system: nc.System, state: nc.State, u: Array, t: Array) -> Array:
        """Their sum."""
        rates = jnp.stack([system.rate(state, f"joint {k + 1}") for k in range(len(LINKS))])
        return RATES * jnp.sum(rates**2)


def panda(steps: int = 40, t_end: float = 1.5, *, slow: bool = False) -> nc.OptimalControl:
    """Seven axes, gravity and limits of the torques, from one posture at rest to another by least effort.

    Args:
        steps: number of steps.
        t_end: [s].
        slow: whether the rates of the joints cost, too.
    """
    scene, goal = nc.Scene(), nc.goal.Rest()
    scene.add(nc.Gravity())
    place, turned, before = np.zeros(3), np.eye(3), nc.ground
    for k, ((mass, com, inertia), (length, offset, twist)) in enumerate(zip(LINKS, FRAMES)):
        place = place + turned @ (length, -math.sin(twist) * offset, math.cos(twist) * offset)
        turned = turned @ _turn("x", twist)
        axis, turned = turned[:, 2], turned @ _turn("z", START[k])
        link = scene.add(
            nc.RigidBody(
                mass=mass, inertia=inertia, com=com, position=place, orientation=turned, name=f"link {k + 1}"
            )
        )
        joint = scene.add(nc.Revolute(before, link, point=place, axis=axis, name=f"joint {k + 1}"))
        scene.add(nc.JointTorque(joint, name=f"motor {k + 1}"))
        goal, before = goal & nc.goal.Coordinate(joint, END[k] - START[k]), link
    return nc.OptimalControl(
        *scene.compile(),
        dt=t_end / steps,
        steps=steps,
        cost=nc.cost.Effort() + Rates() if slow else nc.cost.Effort(),
        goal=goal,
        bounds=nc.bounds.Input(-np.array(LIMITS), LIMITS),
    )


class Thrust(nc.cost.Cost):
    """Integral of the sum of all inputs: fuel."""

    def running(self, system: nc.System, state: nc.State, u: Array, t: Array) -> Array:
        """Sum of the inputs."""
        return jnp.sum(u)


def _pairs(state: nc.State, u: Array, t: Array) -> Array:
    return jnp.stack([u[0] + u[1] - 1.0, u[2] + u[3] - 1.0])


def flying_robot(steps: int = 40) -> nc.OptimalControl:
    """A robot on four jets in pairs, to the origin by least fuel: Y. Sakawa, Optimal Control Applications and
    Methods 20 (1999) 235-248."""
    scene, half = nc.Scene(), math.sqrt(0.5)
    robot = scene.add(
        nc.RigidBody(
            mass=1.0, inertia=(1, 1, 1), position=(-10, -10, 0), orientation=(half, 0, 0, half), name="robot"
        )
    )
    scene.add(nc.Planar(nc.ground, robot, point=(-10, -10, 0), axis=(0, 0, 1), name="plane"))
    axes = tuple(nc.Direction(robot, axis, local=True) for axis in np.eye(3))
    for k, (force, torque) in enumerate([(1, 0.2), (-1, -0.2), (1, -0.2), (-1, 0.2)]):
        points = (nc.Point(robot), *axes)
        scene.add(nc.WrenchInput(points, force=(force, 0, 0), torque=(0, 0, torque), name=f"jet {k + 1}"))
    goal = nc.goal.Position(robot, (0, 0, 0)) & nc.goal.Attitude(robot, np.eye(3)) & nc.goal.Rest()
    bounds = nc.bounds.Input(0.0, 1.0) & nc.bounds.Path(_pairs, "a pair of jets", count=2)
    fields: dict[str, Any] = {"cost": Thrust(), "goal": goal, "bounds": bounds}
    return nc.OptimalControl(*scene.compile(), dt=12 / steps, steps=steps, **fields)


def two_links(steps: int = 40) -> nc.OptimalControl:
    """Two links and a load, turned at rest in least time, 2.98335 s: R. Luus, Iterative Dynamic Programming
    (2000); the value is that of the PROPT collection."""
    scene, elbow = nc.Scene(), 0.5
    # A rod of mass 1, and a load of mass 1 at the end of the second one.
    com = (0.5 + 1.0) / 2
    inertia = 1 / 12 + (com - 0.5) ** 2 + (1 - com) ** 2
    upper = scene.add(nc.RigidBody(mass=1.0, inertia=(1e-9, 1 / 12, 1 / 12), com=(0.5, 0, 0), name="upper"))
    lower = scene.add(
        nc.RigidBody(
            mass=2.0,
            inertia=(1e-9, inertia, inertia),
            com=(com, 0, 0),
            position=(1, 0, 0),
            orientation=(math.cos(elbow / 2), 0, 0, math.sin(elbow / 2)),
            name="lower",
        )
    )
    first = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 0, 1), name="shoulder"))
    second = scene.add(nc.Revolute(upper, lower, point=(1, 0, 0), axis=(0, 0, 1), name="elbow"))
    for joint in (first, second):
        scene.add(nc.JointTorque(joint, name=f"motor of {joint.name}"))
    goal = nc.goal.Coordinate(first, 0.522) & nc.goal.Coordinate(second, 0.0) & nc.goal.Rest()
    bounds = nc.bounds.Input(-1.0, 1.0)
    fields: dict[str, Any] = {"cost": nc.cost.Duration(), "goal": goal, "bounds": bounds, "free_time": True}
    return nc.OptimalControl(*scene.compile(), dt=3.0 / steps, steps=steps, **fields)


class Throw(nc.cost.Cost):
    """How far a ball flies that the end of the lower link lets go, 3 m above the ground; negative."""

    def terminal(self, system: nc.System, state: nc.State) -> Array:
        """The distance."""
        place, speed = (rows[1, 0] - 2.0 * rows[1, 3] for rows in (state.rows, state.row_rates))
        height = speed[2] ** 2 + 2 * 9.81 * (place[2] + 3.0)
        lasting = speed[2] + jnp.sqrt(jnp.where(height > 1e-3, height, 1e-3))
        return -(place[0] + speed[0] * lasting / 9.81)


def throw(steps: int = 40, t_end: float = 1.0) -> nc.OptimalControl:
    """Two links that throw a ball as far as they can: a cost of the end alone."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = {"mass": 1.0, "inertia": (1 / 12, 1 / 12, 0.001)}
    upper = scene.add(nc.RigidBody(**rod, com=(0, 0, -0.5), name="upper"))
    lower = scene.add(nc.RigidBody(**rod, com=(0, 0, -1.5), name="lower"))
    first = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 1, 0), name="shoulder"))
    second = scene.add(nc.Revolute(upper, lower, point=(0, 0, -1), axis=(0, 1, 0), name="elbow"))
    for joint in (first, second):
        scene.add(nc.JointTorque(joint, name=f"motor of {joint.name}"))
    limits = np.array([10.0, 5.0])
    bounds = nc.bounds.Input(-limits, limits)
    return nc.OptimalControl(*scene.compile(), dt=t_end / steps, steps=steps, cost=Throw(), bounds=bounds)


def craft_with_beams(steps: int = 40, t_end: float = 6.0) -> nc.OptimalControl:
    """A hub with a beam to either side, turned by 60 degrees from rest to rest."""
    scene = nc.Scene()
    hub = scene.add(nc.RigidBody(mass=10.0, inertia=(4.0, 4.0, 6.0), name="hub"))
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=20.0, GJ=20.0, density=0.5, rotary=1e-3)
    for side, name in ((1, "right"), (-1, "left")):
        line = [(0.5 * side, 0, 0), (2.5 * side, 0, 0)]
        scene.add(nc.Beam(section, line, elements=2, second=(0, 0, 1), start=hub, name=name))
    axes = tuple(nc.Direction(hub, axis, local=True) for axis in np.eye(3))
    scene.add(nc.WrenchInput((nc.Point(hub), *axes), torque=(0, 0, 1), name="torque"))
    goal = nc.goal.Attitude(hub, _turn("z", math.pi / 3)) & nc.goal.Rest()
    fields: dict[str, Any] = {"cost": nc.cost.Effort(), "goal": goal}
    return nc.OptimalControl(*scene.compile(), dt=t_end / steps, steps=steps, **fields)
