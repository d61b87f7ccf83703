"""What an optimal control problem makes small: running and terminal costs, added with `+`."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.goal_base import GOAL
from natcoord_jax.control.memory import Carrier, Ending, Step, each_inside, input_rate
from natcoord_jax.control.parameters import FreeNumber
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.kinds import NAME, FunctionOf, Several, of
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.state import State
from natcoord_jax.system import System

WEIGHTS = Number("not negative") | Numbers((None,), "not negative")
BEFORE = Number() | Numbers((None,))
RUNNING = FunctionOf("(state, u, t) -> cost per second", 3)
TERMINAL = FunctionOf("(state) -> cost", 1)
PEAK = FunctionOf("(state, u, t) -> number", 3)


def _returned(value: Any, name: str) -> Any:
    """What a function returned.

    Raises:
        ValueError: for nothing.
    """
    if value is None:
        raise ValueError(f"cost.{name}: the function returned None; let it return a number")
    return value


class Cost(Carrier):
    """Base of all costs: an integral over time and a value at the end.

    The integral is taken by the trapezoidal rule over every step, with the inputs held over it. A cost of
    one's own that needs the system, for its sensors, is a subclass that overrides one of the methods.

    Attributes:
        hurries: whether it is the time that passes.
    """

    hurries: ClassVar[bool] = False

    def running(
        self, system: System, state: State, u: Float[Array, " inputs"], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Cost per second at one time."""
        return jnp.zeros(())

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Cost of the final state."""
        return jnp.zeros(())

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, ""]:
        """Cost of a step: the integral over it, with the memory at its start."""
        return step.integral(lambda state, u: self.running(system, state, u, state.t))

    def of_end(self, system: System, ending: Ending) -> Float[Array, ""]:
        """Cost of the end of a motion."""
        return self.terminal(system, ending.last)

    def parameters(self) -> tuple[FreeNumber, ...]:
        """Numbers that are free because of it."""
        costs = [cost for cost in self.inside() if isinstance(cost, Cost)]
        return tuple(number for cost in costs for number in cost.parameters())

    def excess(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """By how much bounds that come with it are exceeded at the end of a step."""
        pairs = each_inside(self, system, memory)
        costs = [(cost, numbers) for cost, numbers in pairs if isinstance(cost, Cost)]
        return jnp.concatenate(
            [jnp.zeros(0), *(cost.excess(system, numbers, step) for cost, numbers in costs)]
        )

    def labels(self) -> tuple[str, ...]:
        """Names of these bounds."""
        costs = [cost for cost in self.inside() if isinstance(cost, Cost)]
        return tuple(name for cost in costs for name in cost.labels())

    def __add__(self, other: "Cost") -> "Cost":
        if not isinstance(other, Cost):
            return NotImplemented
        return Sum((self, other))


class Sum(Cost):
    """A sum of costs."""

    terms: tuple[Cost, ...] = eqx.field(metadata=is_a(Several(of("a cost", Cost))))

    def inside(self) -> tuple[Cost, ...]:
        """The terms."""
        return self.terms

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Sum of the running costs."""
        return sum((c.running(system, state, u, t) for c in self.terms), jnp.zeros(()))

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Sum of the terminal costs."""
        return sum((c.terminal(system, state) for c in self.terms), jnp.zeros(()))

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, ""]:
        """Sum of the costs of a step."""
        pairs = each_inside(self, system, memory)
        return sum((cost.of_step(system, numbers, step) for cost, numbers in pairs), jnp.zeros(()))

    def of_end(self, system: System, ending: Ending) -> Float[Array, ""]:
        """Sum of the costs of the end."""
        pairs = each_inside(self, system, ending.memory)
        costs = (cost.of_end(system, ending._replace(memory=numbers)) for cost, numbers in pairs)
        return sum(costs, jnp.zeros(()))


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

    hurries: ClassVar[bool] = True

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
        return jnp.asarray(self.weight * _returned(self.function(state, u, t), "Running"), float)


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
        return jnp.asarray(self.weight * _returned(self.function(state), "Terminal"), float)


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

    def inside(self) -> tuple[Carrier, ...]:
        """The goal."""
        return (self.goal,)

    def running(self, system: System, state: State, u: Array, t: Array) -> Float[Array, ""]:
        """Weighted square of what is missing."""
        if self.rate is None:
            return jnp.zeros(())
        return self.rate * jnp.sum(self.goal.residual(system, state) ** 2)

    def terminal(self, system: System, state: State) -> Float[Array, ""]:
        """Weighted square of what is missing."""
        return self.weight * jnp.sum(self.goal.residual(system, state) ** 2)

    def of_end(self, system: System, ending: Ending) -> Float[Array, ""]:
        """Weighted square of what is missing at the end of a motion."""
        ((_, memory),) = each_inside(self, system, ending.memory)
        return self.weight * jnp.sum(self.goal.missing(system, ending._replace(memory=memory)) ** 2)


class InputRate(Cost):
    """Integral of weight |du/dt|^2, for inputs that must not jerk.

    Inputs are held over each step; their rate is the difference to the step before over the time between the
    middles of both. Its unit is that of weight times [N^2/s] or [N^2 m^2/s].

    Attributes:
        weight: one number, or one for each input channel.
        before: inputs before the first step [N, N m], one number or one for each; None: they may begin with
            any value at no cost.

    Example:
        >>> import natcoord_jax as nc
        >>> cost = nc.cost.Effort() + nc.cost.InputRate(0.1)
    """

    weight: Any = eqx.field(default=1.0, metadata=is_a(WEIGHTS))
    before: Any = eqx.field(default=None, kw_only=True, metadata=is_a(BEFORE))

    def looks_back(self) -> bool:
        """It does."""
        return True

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, ""]:
        """Weighted sum of squares, times the time between the middles of the steps."""
        weight = for_each(self.weight, step.u.shape[-1], "InputRate: weight", "input channel")
        return step.gap * jnp.sum(weight * input_rate(step, self.before) ** 2)


class _Level(FreeNumber):
    """The free number of a peak."""

    name: str = eqx.field(static=True)
    value: Any = None
    lower: float | None = eqx.field(default=None, static=True)
    upper: float | None = eqx.field(default=None, static=True)

    @property
    def given(self) -> bool:
        """Whether its first value is given."""
        return self.value is not None

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Its first value; zero: found from the first motion."""
        return jnp.asarray(0.0 if self.value is None else self.value, float)


class Peak(Cost):
    """Weight times the largest value of a function along the motion, at the ends of the steps (minimax).

    It is made smooth by a free number, which is the cost and which the function must not exceed at the end of
    any step.

    Attributes:
        function: (state, u, t) -> number.
        guess: first value of the peak; None: the largest along the first motion.
        weight: factor, positive.
        name: of the free number, for reports, with the unit.

    Example:
        >>> import natcoord_jax as nc
        >>> largest = nc.cost.Peak(lambda state, u, t: u[0] ** 2, name="largest square [N^2 m^2]")
    """

    function: Callable[[State, Array, Array], Any] = eqx.field(converter=Function.of, metadata=is_a(PEAK))
    guess: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))
    weight: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number("positive")))
    name: str = eqx.field(default="peak", kw_only=True, static=True, metadata=is_a(NAME))

    def parameters(self) -> tuple[FreeNumber, ...]:
        """The peak."""
        return (_Level(self.name, self.guess),)

    def value(self, step: Step) -> Float[Array, ""]:
        """The function at the end of a step."""
        return jnp.asarray(self.function(step.after, step.u, step.after.t), float)

    def excess(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """The function less the peak, in units of its first value."""
        unit = jnp.abs(jnp.asarray(0.0 if self.guess is None else self.guess, float))
        return ((self.value(step) - step.free[self.name]) / jnp.where(unit > 0, unit, 1.0))[None]

    def labels(self) -> tuple[str, ...]:
        """The peak."""
        return (f"{self.name}, not exceeded",)

    def of_end(self, system: System, ending: Ending) -> Float[Array, ""]:
        """The weighted peak."""
        return self.weight * ending.free[self.name]


COST = of("a cost, as nc.cost.Effort()", Cost)
"""What an argument may be."""
