"""Problems that have no solution whatever is tried, seen before anything is compiled."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from natcoord_jax.control.bounds_base import Bound
from natcoord_jax.control.cost import Cost
from natcoord_jax.control.goal_base import Goal
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.state import State
from natcoord_jax.system import System

SAME = 1e-9
"""Relative difference of numbers that are the same."""
PARTS = ("q", "v", "coordinates", "rates")
"""What a motion starts from."""


class Wish(NamedTuple):
    """A value that a goal wants.

    Attributes:
        place: when.
        what: of what, with the unit.
        value: that it is to be.
        of_motion: whether it is a velocity.
    """

    place: str
    what: str
    value: np.ndarray
    of_motion: bool

    @property
    def shown(self) -> str:
        """Its numbers in a message."""
        given = self.value
        return f"{float(given):g}" if given.ndim == 0 else str(np.round(given, 6).tolist())


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
    """Refuse goals that want two values of the same, and one that bounds forbid.

    Raises:
        ValueError: for such ones.
    """
    parts, known = list(_placed(goal, "at the end")), {}
    resting = {place for place, part in parts if part.stops}
    limits = [
        (what, pair)
        for bound in bounds.everything()
        if isinstance(bound, Bound)
        for what, pair in bound.kept().items()
    ]
    for wish in (wish for place, part in parts for wish in _wishes(place, part)):
        other = known.setdefault((wish.place, wish.what), wish)
        if np.max(np.abs(other.value - wish.value)) > SAME * (1.0 + np.max(np.abs(wish.value))):
            raise ValueError(
                f"goal: {wish.what} is to be {other.shown} and {wish.shown} {wish.place}; leave one of them "
                "out, or ask for it at a waypoint, nc.goal.At(..., step=...)"
            )
        if wish.place in resting and wish.of_motion and np.any(wish.value):
            raise ValueError(
                f"goal: {wish.what} is to be {wish.shown} {wish.place}, where nc.goal.Rest stops all motion; "
                "leave one of them out"
            )
        for what, pair in limits:
            if what == wish.what and is_concrete(*pair):
                _refuse_outside(wish, *(float(np.min(np.asarray(x))) for x in pair))


def _refuse_outside(wish: Wish, lower: float, upper: float) -> None:
    if not lower <= float(wish.value) <= upper:
        raise ValueError(
            f"goal: {wish.what} is to be {wish.shown} {wish.place}, and a bound keeps it from {lower:g} to "
            f"{upper:g}; widen the bound or ask for a value inside"
        )


def _placed(goal: Goal, place: str) -> Iterator[tuple[str, Goal]]:
    """It and what it holds, with when that counts; nothing of goals with room is wanted exactly."""
    yield place, goal
    if goal.exact:
        place = "".join(f"after step {step}" for step in goal.marks()) or place
        for part in goal.inside():
            yield from _placed(part, place) if isinstance(part, Goal) else ()


def _wishes(place: str, goal: Goal) -> Iterator[Wish]:
    for what, value in goal.wanted().items():
        if is_concrete(value):
            yield Wish(place, what, np.asarray(value, float), goal.of_motion)


def refuse_endless_haste(cost: Cost, bounds: bool, shortest: list[float]) -> None:
    """Refuse a problem of least time that nothing limits.

    Args:
        cost: the cost.
        bounds: whether there are any, of the path or of the goal.
        shortest: lower limits of the free times [s].

    Raises:
        ValueError: for such a one.
    """
    parts = [part for part in cost.everything() if isinstance(part, Cost) and not part.inside()]
    hasty = bool(parts) and all(part.hurries for part in parts)
    if hasty and shortest and not bounds and min(shortest) <= 0:
        raise ValueError(
            "free_time: the cost is the time [s] alone and nothing limits the inputs, so that it gets as "
            "short as one likes; pass bounds=nc.bounds.Input(lower, upper), a cost of the inputs as "
            "nc.cost.Effort(), or a shortest time, free_time=(lower, upper)"
        )
