"""A problem with another number of steps over the same time."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from natcoord_jax.control import mesh
from natcoord_jax.control.goal_places import At
from natcoord_jax.control.problem import OptimalControl


def _is_waypoint(part: Any) -> bool:
    return isinstance(part, At)


def _carriers(problem: OptimalControl) -> tuple[Any, Any, Any]:
    return problem.goal, problem.cost, problem.bounds


def waypoints(problem: OptimalControl) -> list[int]:
    """Steps after which a goal holds."""
    parts = jax.tree.leaves(_carriers(problem), is_leaf=_is_waypoint)
    return [part.step for part in parts if _is_waypoint(part)]


def with_steps(
    problem: OptimalControl, phases: tuple[int, ...], dt: Any, moved: Callable[[int], int]
) -> OptimalControl:
    """The same with other steps; `moved` tells which one a waypoint has then."""

    def placed(part: Any) -> Any:
        return dataclasses.replace(part, step=moved(part.step)) if _is_waypoint(part) else part

    goal, cost, bounds = jax.tree.map(placed, _carriers(problem), is_leaf=_is_waypoint)
    return dataclasses.replace(problem, steps=phases, dt=dt, goal=goal, cost=cost, bounds=bounds)


def refined(problem: OptimalControl, steps: int) -> OptimalControl | None:
    """The same with so many steps: phases, intervals of inputs and waypoints stay where they are in time.

    None where they cannot.
    """
    if steps < 1 or steps % problem.inputs.every:
        return None
    found = mesh.refined(problem.phases, problem.dt, steps)
    whole = problem.steps
    if found is None or any(step * steps % whole for step in waypoints(problem)):
        return None
    return with_steps(problem, *found, lambda step: step * steps // whole)
