"""Goals that look at more than the final state: the start of the motion, integrals along it, turns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.goal_base import Goal
from natcoord_jax.control.memory import Ending, Step
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import BODY_NAME, JOINT_NAME, NAME, FunctionOf, Several
from natcoord_jax.core.numeric import Directions, Number, Whole
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import to_rotation_vector
from natcoord_jax.system import System

LINK = FunctionOf("(first state, last state) -> number or vector", 2)
DENSITY = FunctionOf("(state, u, t) -> number per second", 3)


def numbered(name: str, count: int) -> tuple[str, ...]:
    """A name, numbered if there are several of it."""
    return (name,) if count == 1 else tuple(f"{name} [{k}]" for k in range(count))


class Linked(Goal):
    """Any smooth function of the first and the last state that has to vanish.

    The first state is free as far as `nc.InitialCoordinate` and `nc.InitialRate` make it so.

    Attributes:
        function: (first state, last state) -> number or vector.
        name: for reports.
        count: how many numbers the function returns.

    Example:
        >>> import natcoord_jax as nc
        >>> def closed(first, last):
        ...     return last.coordinates - first.coordinates
        >>> goal = nc.goal.Linked(closed, "closed path", count=2)
    """

    function: Callable[[State, State], Any] = eqx.field(converter=Function.of, metadata=is_a(LINK))
    name: str = eqx.field(default="link of end and start", static=True, metadata=is_a(NAME))
    count: int = eqx.field(default=1, kw_only=True, static=True, metadata=is_a(Whole(1)))

    def looks_at_start(self) -> bool:
        """It does."""
        return True

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """Value of the function."""
        found = self.function(ending.first, ending.last)
        return jnp.atleast_1d(jnp.asarray(found, float)).reshape(self.count)

    def labels(self, system: System) -> tuple[str, ...]:
        """The name, numbered if there are several."""
        return numbered(self.name, self.count)


class Periodic(Goal):
    """A periodic motion: joint coordinates and their rates end as they began.

    Coordinates count on over many turns, and have to be the same, turns included.

    Attributes:
        joints: handles or names; None: all joints with coordinates.

    Example:
        >>> import natcoord_jax as nc
        >>> goal = nc.goal.Periodic(("hip", "knee"))
    """

    joints: Any = eqx.field(default=None, static=True, metadata=is_a(Several(JOINT_NAME, 1)))

    def looks_at_start(self) -> bool:
        """It does."""
        return True

    def _coordinates(self, system: System) -> list[tuple[str, int]]:
        """Joints, and which of their coordinates."""
        every = [name for name, _ in system.structure.coordinates]
        known = list(dict.fromkeys(every))
        names = known if self.joints is None else [named(joint) for joint in self.joints]
        for name in names:
            if name not in known:
                raise ValueError(f"goal.Periodic: joint {name!r} has no coordinate; those of {known} do")
        return [(name, k) for name in names for k in range(every.count(name))]

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """Coordinates and rates at the end less those at the start."""
        first, last = (self._read(system, state) for state in (ending.first, ending.last))
        return last - first

    def _read(self, system: System, state: State) -> Float[Array, " n"]:
        places = self._coordinates(system)
        values = [system.coordinate(state, joint, index=k) for joint, k in places]
        return jnp.stack(values + [system.rate(state, joint, index=k) for joint, k in places])

    def labels(self, system: System) -> tuple[str, ...]:
        """Coordinates, then rates."""
        places = self._coordinates(system)
        found = [f"coordinate {k} of {joint!r}, end less start [rad or m]" for joint, k in places]
        return tuple(found + [f"rate {k} of {joint!r}, end less start [rad/s or m/s]" for joint, k in places])


class Integral(Goal):
    """An integral over the motion that has a given value (an isoperimetric constraint).

    It is taken by the trapezoidal rule over every step with the inputs held, or by the quadrature of its
    stages where it has several, as those of costs are. Inside of `nc.goal.Within` it is a budget.

    Attributes:
        function: (state, u, t) -> number per second.
        value: of the integral.
        name: for reports, with the unit.

    Example:
        >>> import natcoord_jax as nc
        >>> impulse = nc.goal.Integral(lambda state, u, t: u[0], 2.0, name="impulse [N s]")
        >>> fuel = nc.goal.Within(nc.goal.Integral(lambda state, u, t: u[0] ** 2), upper=5.0)
    """

    function: Callable[[State, Array, Array], Any] = eqx.field(converter=Function.of, metadata=is_a(DENSITY))
    value: Any = eqx.field(default=0.0, metadata=is_a(Number()))
    name: str = eqx.field(default="integral", kw_only=True, static=True, metadata=is_a(NAME))

    def own(self, system: System) -> int:
        """The integral so far."""
        return 1

    def remembered(self, system: System, own: Array, inside: list[Array], step: Step) -> Array:
        """The integral after a step."""
        return own + step.integral(lambda state, u: jnp.asarray(self.function(state, u, state.t), float))

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """The integral less its value."""
        return ending.memory - self.value

    def labels(self, system: System) -> tuple[str, ...]:
        """The name."""
        return (self.name,)


class Turned(Goal):
    """Angle by which a body has turned about an axis fixed in it, counted on over many turns.

    It is the sum over the steps of the rotation vector from each attitude to the next along the axis: the
    angle where the body turns about that axis alone, and that of a gyroscope that is fixed to the body
    otherwise. `nc.goal.Attitude` knows no number of turns. A step may turn the body by less than half a turn.

    Attributes:
        body: handle or name.
        axis: in coordinates of the body [-].
        angle: [rad].

    Example:
        >>> import math
        >>> import natcoord_jax as nc
        >>> twice = nc.goal.Turned("satellite", (0, 0, 1), 4 * math.pi)
    """

    body: Handle | str = eqx.field(static=True, metadata=is_a(BODY_NAME))
    axis: Any = eqx.field(metadata=is_a(Directions()))
    angle: Any = eqx.field(metadata=is_a(Number()))

    def own(self, system: System) -> int:
        """The angle so far."""
        return 1

    def remembered(self, system: System, own: Array, inside: list[Array], step: Step) -> Array:
        """The angle after a step."""
        first = 4 * system.body_index(self.body) + 1
        # Directors are the rows: in the axes of the body a turn is before^T after with columns as directors.
        before, after = (state.q[first : first + 3] for state in (step.before, step.after))
        axis = jnp.asarray(self.axis, float)
        return own + to_rotation_vector(before @ after.T) @ (axis / jnp.linalg.norm(axis))

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """The angle less the wanted one."""
        return ending.memory - self.angle

    def labels(self, system: System) -> tuple[str, ...]:
        """The body."""
        return (f"angle turned by {named(self.body)!r} [rad]",)

    def wanted(self) -> dict[str, Any]:
        """The angle."""
        if not is_concrete(self.axis):
            return {}
        axis = np.asarray(self.axis, float).tolist()
        return {f"angle turned by {named(self.body)!r} about {axis} [rad]": self.angle}
