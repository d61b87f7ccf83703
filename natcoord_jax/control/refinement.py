"""A problem with another number of steps over the same time."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from natcoord_jax.control import mesh
from natcoord_jax.control.memory import Carrier
from natcoord_jax.control.problem import OptimalControl


def _carriers(problem: OptimalControl) -> tuple[Any, Any, Any]:
    return problem.goal, problem.cost, problem.bounds


def marks(problem: OptimalControl) -> list[int]:
    """Steps at whose ends goals hold, and bounds begin and cease to count; neither start nor end."""
    every = [part for carrier in _carriers(problem) for part in carrier.everything()]
    return [mark for part in every for mark in part.marks() if 0 < mark < problem.steps]


def with_steps(
    problem: OptimalControl, phases: tuple[int, ...], dt: Any, moved: Callable[[int], int]
) -> OptimalControl:
    """The same with other steps; `moved` tells which one a mark is at then."""

    def placed(part: Any) -> Any:
        if not isinstance(part, Carrier):
            return part
        held = jax.tree.map(placed, part, is_leaf=lambda x: x is not part and isinstance(x, Carrier))
        return held.remarked(moved)

    goal, cost, bounds = (placed(carrier) for carrier in _carriers(problem))
    return dataclasses.replace(problem, steps=phases, dt=dt, goal=goal, cost=cost, bounds=bounds)


def refined(problem: OptimalControl, steps: int) -> OptimalControl | None:
    """The same with so many steps: phases, intervals of inputs and marks stay where they are in time.

    None where they cannot.
    """
    if steps < 1 or steps % problem.inputs.every:
        return None
    found = mesh.refined(problem.phases, problem.dt, steps)
    whole = problem.steps
    if found is None or any(step * steps % whole for step in marks(problem)):
        return None
    return with_steps(problem, *found, lambda step: step * steps // whole)
