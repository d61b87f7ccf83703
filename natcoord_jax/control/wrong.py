"""Problems that have no solution whatever is tried, seen before anything is compiled."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from natcoord_jax.control.bounds import Bound
from natcoord_jax.control.bounds import Coordinate as CoordinateBound
from natcoord_jax.control.bounds import Rate as RateBound
from natcoord_jax.control.cost import Cost, Duration, Sum
from natcoord_jax.control.goal import Attitude, Coordinate, Motion, Position, Rate, Rest
from natcoord_jax.control.goal_base import All, Goal
from natcoord_jax.control.goal_links import Turned
from natcoord_jax.control.goal_places import At
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.handles import named
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import from_quaternion
from natcoord_jax.system import System

SAME = 1e-9
"""Relative difference of numbers that are the same."""
PARTS = ("q", "v", "coordinates", "rates")
"""What a motion starts from."""


class Wish(NamedTuple):
    """A value that a goal asks for.

    Attributes:
        place: when.
        what: of what, with the unit.
        value: that it is to be.
        shown: in the message.
    """

    place: str
    what: str
    value: np.ndarray
    shown: str


def refuse_state(system: System, state: State) -> None:
    """Refuse a state that is none of a system.

    Raises:
        ValueError: for another number of bodies, and for numbers that are none.
    """
    bodies, given = len(system.structure.bodies), state.q.shape[-2] // 4
    if bodies != given or state.q.ndim != 2:
        raise ValueError(
            f"the state has the places of {given} bodies in an array of shape {state.q.shape}, and the "
            f"system has {bodies}: {list(system.structure.bodies)}; pass one state of this system, as "
            "system, state = scene.compile() returns it"
        )
    for name in PARTS:
        if not np.all(np.isfinite(np.asarray(getattr(state, name)))):
            raise ValueError(
                f"the initial state has values in `{name}` that are no finite numbers; look for a division "
                "by zero where it is made"
            )


def refuse_contradictions(goal: Goal, bounds: Bound) -> None:
    """Refuse goals that ask for two values of the same, and for one that bounds forbid.

    Raises:
        ValueError: for such ones.
    """
    known: dict[tuple[str, str], Wish] = {}
    resting = set(_resting(goal, "at the end"))
    for wish in _wishes(goal, "at the end"):
        other = known.setdefault((wish.place, wish.what), wish)
        if np.max(np.abs(other.value - wish.value)) > SAME * (1.0 + np.max(np.abs(wish.value))):
            raise ValueError(
                f"goal: {wish.what} is to be {other.shown} and {wish.shown} {wish.place}; leave one of them "
                "out, or ask for it at a waypoint, nc.goal.At(..., step=...)"
            )
        if wish.place in resting and wish.what.startswith(("rate", "velocity")) and np.any(wish.value):
            raise ValueError(
                f"goal: {wish.what} is to be {wish.shown} {wish.place}, where nc.goal.Rest stops all motion; "
                "leave one of them out"
            )
        for limit in bounds.everything():
            _refuse_outside(wish, limit)


def _refuse_outside(wish: Wish, limit: Any) -> None:
    if not isinstance(limit, CoordinateBound | RateBound) or not is_concrete(limit.lower, limit.upper):
        return
    kind = "coordinate" if isinstance(limit, CoordinateBound) else "rate"
    if not wish.what.startswith(f"{kind} {limit.index} of {named(limit.joint)!r} "):
        return
    lower, upper = (float(np.min(np.asarray(x))) for x in (limit.lower, limit.upper))
    if not lower <= float(wish.value) <= upper:
        raise ValueError(
            f"goal: {wish.what} is to be {wish.shown} {wish.place}, and nc.bounds.{type(limit).__name__} "
            f"keeps it from {lower:g} to {upper:g}; widen the bound or ask for a value inside"
        )


def _resting(goal: Goal, place: str) -> Iterator[str]:
    """Where everything is to rest."""
    if isinstance(goal, Rest):
        yield place
    elif isinstance(goal, At):
        yield from _resting(goal.goal, f"after step {goal.step}")
    elif isinstance(goal, All):
        for part in goal.parts:
            yield from _resting(part, place)


def _wishes(goal: Goal, place: str) -> Iterator[Wish]:
    """Values that a goal asks for; of goals with room and of those of one's own none is known."""
    if isinstance(goal, At):
        yield from _wishes(goal.goal, f"after step {goal.step}")
    elif isinstance(goal, All):
        for part in goal.parts:
            yield from _wishes(part, place)
    for what, value in _values(goal):
        if is_concrete(value):
            found = np.asarray(value, float)
            yield Wish(place, what, found, _shown(found))


def _values(goal: Goal) -> list[tuple[str, Any]]:
    if isinstance(goal, Coordinate | Rate):
        kind, unit = ("coordinate", "") if isinstance(goal, Coordinate) else ("rate", "/s")
        return [(f"{kind} {goal.index} of {named(goal.joint)!r} [rad{unit} or m{unit}]", goal.value)]
    if isinstance(goal, Position) and is_concrete(goal.point):
        where = _shown(np.asarray(goal.point, float))
        return [(f"position of point {where} of {named(goal.body)!r} [m]", goal.position)]
    if isinstance(goal, Attitude) and is_concrete(goal.rotation):
        given = np.asarray(goal.rotation, float)
        rotation = np.asarray(from_quaternion(jnp.asarray(given))) if given.shape == (4,) else given
        return [(f"attitude of {named(goal.body)!r} [-]", rotation)]
    if isinstance(goal, Motion):
        name = named(goal.body)
        velocities = (f"velocity of {name!r} [m/s]", goal.velocity)
        return [velocities, (f"rate of turning of {name!r} [rad/s]", goal.angular_velocity)]
    if isinstance(goal, Turned) and is_concrete(goal.axis):
        about = _shown(np.asarray(goal.axis, float))
        return [(f"angle turned by {named(goal.body)!r} about {about} [rad]", goal.angle)]
    return []


def _shown(value: np.ndarray) -> str:
    """Numbers in a message."""
    return f"{float(value):g}" if value.ndim == 0 else str(np.round(value, 6).tolist())


def refuse_endless_haste(cost: Cost, bounds: bool, shortest: list[float]) -> None:
    """Refuse a problem of least time that nothing limits.

    Args:
        cost: the cost.
        bounds: whether there are any, of the path or of the goal.
        shortest: lower limits of the free times [s].

    Raises:
        ValueError: for such a one.
    """
    parts = [part for part in cost.everything() if type(part) not in (Cost, Sum)]
    hasty = bool(parts) and all(isinstance(part, Duration) for part in parts)
    if hasty and shortest and not bounds and min(shortest) <= 0:
        raise ValueError(
            "free_time: the cost is the time [s] alone and nothing limits the inputs, so that it gets as "
            "short as one likes; pass bounds=nc.bounds.Input(lower, upper), a cost of the inputs as "
            "nc.cost.Effort(), or a shortest time, free_time=(lower, upper)"
        )
