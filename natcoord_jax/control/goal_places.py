"""Goals made of goals: at a waypoint, and with room."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.goal_base import GOAL, Goal
from natcoord_jax.control.memory import Ending, Step, only_where
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.system import System

LIMIT = Number(infinite=True) | Numbers((None,), infinite=True)


class At(Goal):
    """A goal at a waypoint: fulfilled after so many steps, not at the end.

    Of several phases (`steps=(20, 20)`) the first ends after 20 steps: with `free_time` the time of the
    waypoint is free. Limits of the goal (`nc.goal.Within`) hold there as well.

    Attributes:
        goal: what has to be fulfilled.
        step: after how many steps, 1 or more: at the state `solution.trajectory.states[step]`.

    Example:
        >>> import natcoord_jax as nc
        >>> goal = nc.goal.At(nc.goal.Position("hand", (0.3, 0.0, 0.5)), step=20) & nc.goal.Rest()
    """

    goal: Any = eqx.field(metadata=is_a(GOAL))
    step: int = eqx.field(kw_only=True, static=True, metadata=is_a(Whole(1)))

    def inside(self) -> tuple[Goal, ...]:
        """The goal."""
        return (self.goal,)

    def __check_init__(self):
        """Refuse what needs two states."""
        if self.goal.looks_at_start():
            raise ValueError(
                "goal.At: this goal compares the end with the start, which a waypoint is not; use it without "
                "`At`, or `nc.goal.Undeformed` with a reference"
            )

    def furthest(self) -> int:
        """Its step."""
        return max(self.step, self.goal.furthest())

    def marks(self) -> tuple[int, ...]:
        """Its step."""
        return (self.step,)

    def remarked(self, moved: Callable[[int], int]) -> "At":
        """The same after another step."""
        return dataclasses.replace(self, step=moved(self.step))

    def own(self, system: System) -> int:
        """What was missing, and how far limits were exceeded."""
        return sum(self.goal.sizes(system))

    def remembered(self, system: System, own: Array, inside: list[Array], step: Step) -> Array:
        """What is missing at its step; the same at all others."""
        here = step.number == self.step - 1
        at = Ending(step.before, step.after, inside[0], step.free)
        # (At all other steps it may be what has no value.)
        goal, system, at = only_where(here, (self.goal, system, at))
        found = jnp.concatenate([goal.missing(system, at), goal.excess(system, at)])
        return jnp.where(here, found, own)

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """What was missing there."""
        return self.divided(system, ending.memory)[1][: self.goal.sizes(system)[0]]

    def excess(self, system: System, ending: Ending) -> Float[Array, " m"]:
        """By how much limits were exceeded there."""
        return self.divided(system, ending.memory)[1][self.goal.sizes(system)[0] :]

    def sizes(self, system: System) -> tuple[int, int]:
        """Those of the goal."""
        return self.goal.sizes(system)

    def labels(self, system: System) -> tuple[str, ...]:
        """Those of the goal, with the step."""
        return tuple(f"{label}, after step {self.step}" for label in self.goal.labels(system))

    def limits(self, system: System) -> tuple[str, ...]:
        """Those of the goal, with the step."""
        return tuple(f"{label}, after step {self.step}" for label in self.goal.limits(system))


class Within(Goal):
    """A goal with room: what is missing to it lies between two limits (terminal inequalities).

    Attributes:
        goal: what is looked at.
        lower: least value of its residual, one number or one for each; -inf: none.
        upper: largest value of its residual, one number or one for each; inf: none.

    Raises:
        ValueError: for limits that leave no room.

    Example:
        >>> import natcoord_jax as nc
        >>> goal = nc.goal.Within(nc.goal.Coordinate("hinge", 1.0), -0.1, 0.1)
    """

    exact: ClassVar[bool] = False

    goal: Any = eqx.field(metadata=is_a(GOAL))
    lower: Any = eqx.field(default=-np.inf, metadata=is_a(LIMIT))
    upper: Any = eqx.field(default=np.inf, metadata=is_a(LIMIT))
    limited: tuple[tuple[bool, ...], tuple[bool, ...]] = eqx.field(init=False, static=True)

    def __post_init__(self):
        """Convert, and refuse limits that leave no room."""
        self.lower, self.upper = (jnp.asarray(x, float) for x in (self.lower, self.upper))
        known = is_concrete(self.lower, self.upper)
        if known and not np.all(np.asarray(self.lower) < np.asarray(self.upper)):
            raise ValueError(
                f"goal.Within: the lower limit {np.asarray(self.lower)} is not below the upper limit "
                f"{np.asarray(self.upper)}; pass limits with room between them, or the goal itself"
            )
        # Which limits there are is structure: it stays fixed when the numbers are traced.
        limits = (np.isfinite(x) if known else np.ones(x.shape, bool) for x in (self.lower, self.upper))
        below, above = (tuple(bool(x) for x in np.ravel(limit)) for limit in limits)
        self.limited = (below, above)

    def inside(self) -> tuple[Goal, ...]:
        """The goal."""
        return (self.goal,)

    def _sides(self, system: System) -> tuple[np.ndarray, np.ndarray]:
        count = self.goal.sizes(system)[0]
        below, above = (np.flatnonzero(np.broadcast_to(limits, count)) for limits in self.limited)
        return below, above

    def sizes(self, system: System) -> tuple[int, int]:
        """Nothing is missing, but for limits."""
        return 0, sum(side.size for side in self._sides(system)) + self.goal.sizes(system)[1]

    def excess(self, system: System, ending: Ending) -> Float[Array, " m"]:
        """Excess over both limits, in units of half the range."""
        inner = ending._replace(memory=self.divided(system, ending.memory)[0][0])
        values = self.goal.missing(system, inner)
        below, above = self._sides(system)
        lower, upper = (jnp.broadcast_to(x, values.shape) for x in (self.lower, self.upper))
        both = jnp.isfinite(upper - lower)
        unit = jnp.where(both, 0.5 * jnp.where(both, upper - lower, 2.0), 1.0)
        sides = [((lower - values) / unit)[below], ((values - upper) / unit)[above]]
        return jnp.concatenate([*sides, self.goal.excess(system, inner)])

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """Nothing."""
        return jnp.zeros(0)

    def limits(self, system: System) -> tuple[str, ...]:
        """The goal's labels, and which limit."""
        names = self.goal.labels(system)
        below, above = self._sides(system)
        lower = tuple(f"{names[k]} above its lower limit" for k in below)
        upper = tuple(f"{names[k]} below its upper limit" for k in above)
        return lower + upper + self.goal.limits(system)
