"""A problem with another number of steps over the same time."""

import dataclasses
from typing import Any

import jax

from natcoord_jax.control import mesh
from natcoord_jax.control.goal_places import At
from natcoord_jax.control.problem import OptimalControl


def refined(problem: OptimalControl, steps: int) -> OptimalControl | None:
    """The same with so many steps: phases, intervals of inputs and waypoints stay where they are in time.

    None where they cannot.
    """
    if steps < 1 or steps % problem.inputs.every:
        return None
    found = mesh.refined(problem.phases, problem.dt, steps)
    whole = problem.steps

    def is_waypoint(part: Any) -> bool:
        return isinstance(part, At)

    def moved(part: Any) -> Any:
        return dataclasses.replace(part, step=part.step * steps // whole) if is_waypoint(part) else part

    parts = problem.goal, problem.cost, problem.bounds
    waypoints = [x.step for x in jax.tree.leaves(parts, is_leaf=is_waypoint) if is_waypoint(x)]
    if found is None or any(step * steps % whole for step in waypoints):
        return None
    goal, cost, bounds = jax.tree.map(moved, parts, is_leaf=is_waypoint)
    phases, dt = found
    return dataclasses.replace(problem, steps=phases, dt=dt, goal=goal, cost=cost, bounds=bounds)
