"""What a goal is: conditions on the end of a motion, and on how it came there, joined with `&`."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.memory import Carrier, Ending, each_inside
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.kinds import Several, of
from natcoord_jax.core.state import State
from natcoord_jax.system import System


class Goal(Carrier):
    """Base of all goals: equations that the final state has to fulfil.

    A goal of one's own overrides `residual` and `labels`. Those that look at more than the final state
    override `missing`, and those that leave some room `excess`.

    Attributes:
        of_motion: whether values that it wants are velocities.
        stops: whether it stops all motion.
        exact: whether what it holds is to be reached as it is.
    """

    of_motion: ClassVar[bool] = False
    stops: ClassVar[bool] = False
    exact: ClassVar[bool] = True

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """What is missing; zero where the goal is reached."""
        return jnp.zeros(0)

    def labels(self, system: System) -> tuple[str, ...]:
        """Name and unit of each number of the residual."""
        return ()

    def sizes(self, system: System) -> tuple[int, int]:
        """How many numbers are missing, and how many limits there are."""
        return len(self.labels(system)), len(self.limits(system))

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """What is missing at the end of a motion: the residual of its last state."""
        return self.residual(system, ending.last)

    def excess(self, system: System, ending: Ending) -> Float[Array, " m"]:
        """By how much each limit is exceeded at the end of a motion; negative inside."""
        return jnp.zeros(0)

    def limits(self, system: System) -> tuple[str, ...]:
        """Name of each limit."""
        return ()

    def wanted(self) -> dict[str, Any]:
        """Values that it is to have, by what of, with the unit."""
        return {}

    def __and__(self, other: "Goal") -> "Goal":
        if not isinstance(other, Goal):
            return NotImplemented
        return All((self, other))


class All(Goal):
    """Several goals at once."""

    parts: tuple[Goal, ...] = eqx.field(metadata=is_a(Several(of("a goal", Goal))))

    def inside(self) -> tuple[Goal, ...]:
        """The parts."""
        return self.parts

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Residuals of all parts."""
        return jnp.concatenate([part.residual(system, state) for part in self.parts])

    def labels(self, system: System) -> tuple[str, ...]:
        """Labels of all parts."""
        return tuple(label for part in self.parts for label in part.labels(system))

    def sizes(self, system: System) -> tuple[int, int]:
        """Those of all parts together."""
        missing, limits = zip(*(part.sizes(system) for part in self.parts))
        return sum(missing), sum(limits)

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """What is missing to all parts."""
        pairs = each_inside(self, system, ending.memory)
        return jnp.concatenate([part.missing(system, ending._replace(memory=m)) for part, m in pairs])

    def excess(self, system: System, ending: Ending) -> Float[Array, " m"]:
        """Excesses over the limits of all parts."""
        pairs = each_inside(self, system, ending.memory)
        return jnp.concatenate([part.excess(system, ending._replace(memory=m)) for part, m in pairs])

    def limits(self, system: System) -> tuple[str, ...]:
        """Limits of all parts."""
        return tuple(name for part in self.parts for name in part.limits(system))


GOAL = of("a goal, as nc.goal.Rest()", Goal)
"""What an argument may be."""
