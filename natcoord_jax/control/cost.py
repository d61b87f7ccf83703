"""What an optimal control problem makes small: running and terminal costs, added with `+`."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.goal import GOAL
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.kinds import FunctionOf, Several, of
from natcoord_jax.core.numeric import Number, Vector
from natcoord_jax.core.state import State
from natcoord_jax.system import System

WEIGHTS = Number() | Vector(None)
RUNNING = FunctionOf("(state, u, t) -> cost per second")
TERMINAL = FunctionOf("(state) -> cost")


class Cost(Part):
    """Base of all costs: an integral over time and a value at the end.

    The integral is taken by the trapezoidal rule over every step, with the inputs held over it. A cost of
    one's own that needs the system, for its sensors, is a subclass that overrides one of the methods.
    """

    def running(
        self, system: System, state: State, u: Float[Array, " inputs"], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Cost per second at one time."""
        return jnp.zeros(())

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Cost of the final state."""
        return jnp.zeros(())

    def __add__(self, other: "Cost") -> "Cost":
        if not isinstance(other, Cost):
            return NotImplemented
        return Sum((self, other))


class Sum(Cost):
    """A sum of costs."""

    terms: tuple[Cost, ...] = eqx.field(metadata=is_a(Several(of("a cost", Cost))))

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Sum of the running costs."""
        return sum((c.running(system, state, u, t) for c in self.terms), jnp.zeros(()))

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Sum of the terminal costs."""
        return sum((c.terminal(system, state) for c in self.terms), jnp.zeros(()))


class Effort(Cost):
    """Integral of weight |u|^2; its unit is that of weight times [N^2 s] or [N^2 m^2 s].

    Attributes:
        weight: one number, or one for each input channel.

    Example:
        >>> import natcoord_jax as nc
        >>> cost = nc.cost.Effort(weight=2.0) + nc.cost.Duration()
    """

    weight: Any = eqx.field(default=1.0, metadata=is_a(WEIGHTS))

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Weighted sum of squares."""
        return jnp.sum(for_each(self.weight, u.shape[-1], "Effort: weight", "input channel") * u**2)


class Duration(Cost):
    """The time that passes [s], times a weight; for problems with a free final time.

    Attributes:
        weight: [1/s].
    """

    weight: Any = eqx.field(default=1.0, metadata=is_a(Number()))

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """The weight."""
        return jnp.asarray(self.weight, float)


class Running(Cost):
    """Integral of any smooth function of (state, u, t).

    Attributes:
        function: (state, u, t) -> cost per second.
        weight: factor.
    """

    function: Callable[[State, Array, Array], Any] = eqx.field(converter=Function.of, metadata=is_a(RUNNING))
    weight: Any = eqx.field(default=1.0, metadata=is_a(Number()))

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Value of the function."""
        return jnp.asarray(self.weight * self.function(state, u, t), float)


class Terminal(Cost):
    """Any smooth function of the final state.

    Attributes:
        function: (state) -> cost.
        weight: factor.
    """

    function: Callable[[State], Any] = eqx.field(converter=Function.of, metadata=is_a(TERMINAL))
    weight: Any = eqx.field(default=1.0, metadata=is_a(Number()))

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Value of the function."""
        return jnp.asarray(self.weight * self.function(state), float)


class Missed(Cost):
    """Integral or final value of weight |residual of a goal|^2: a goal to come near to, not to reach.

    Attributes:
        goal: see `natcoord_jax.control.goal`.
        weight: at the end.
        rate: weight of the integral [1/s]; none: there is no integral, and it costs nothing.
    """

    goal: Any = eqx.field(metadata=is_a(GOAL))
    weight: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number()))
    rate: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Weighted square of what is missing."""
        if self.rate is None:
            return jnp.zeros(())
        return self.rate * jnp.sum(self.goal.residual(system, state) ** 2)

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Weighted square of what is missing."""
        return self.weight * jnp.sum(self.goal.residual(system, state) ** 2)


COST = of("a cost, as nc.cost.Effort()", Cost)
"""What an argument may be."""
