"""What an optimal control problem must respect on its way: path inequalities, joined with `&`.

Every bound says how much of it is used up: values below zero are allowed. They are taken at the end of every
step, with the inputs of the step, and measured in a natural unit of the bound (half its range).
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.bounds_base import BOUND as BOUND
from natcoord_jax.control.bounds_base import All as All
from natcoord_jax.control.bounds_base import Bound as Bound
from natcoord_jax.control.bounds_phases import During as During
from natcoord_jax.control.bounds_phases import Support as Support
from natcoord_jax.control.memory import Step, input_rate
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import for_each, is_concrete
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import BODY_NAME, JOINT_NAME, NAME, FunctionOf, HandleOf
from natcoord_jax.core.numeric import Directions, Number, Numbers, Whole
from natcoord_jax.core.state import State
from natcoord_jax.system import System

LIMIT = Number(infinite=True) | Numbers((None,), infinite=True)
EXCESS = FunctionOf("(state, u, t) -> number or vector", 3)


class Range(Bound):
    """Values between two limits; an infinite limit is none.

    Attributes:
        lower: one number or one for each value.
        upper: one number or one for each value.
        limited: which of the limits are finite.
    """

    lower: Any = eqx.field(metadata=is_a(LIMIT))
    upper: Any = eqx.field(metadata=is_a(LIMIT))
    limited: tuple[tuple[bool, ...], tuple[bool, ...]] = eqx.field(init=False, static=True)

    makes_arrays: ClassVar[bool] = True

    def __post_init__(self):
        """Convert, and refuse limits that leave no room."""
        self.lower, self.upper = (jnp.asarray(x, float) for x in (self.lower, self.upper))
        known = is_concrete(self.lower, self.upper)
        if known and not np.all(np.asarray(self.lower) < np.asarray(self.upper)):
            raise ValueError(
                f"{type(self).__name__}: the lower bound {np.asarray(self.lower)} is not below the upper "
                f"bound {np.asarray(self.upper)}; pass (lower, upper) with room between them"
            )
        # Which limits there are is structure: it stays fixed when the numbers are traced.
        limits = (np.isfinite(x) if known else np.ones(x.shape, bool) for x in (self.lower, self.upper))
        below, above = (tuple(bool(x) for x in np.ravel(limit)) for limit in limits)
        self.limited = (below, above)

    @abc.abstractmethod
    def values(self, system: System, state: State, u: Array) -> Float[Array, " n"]:
        """What is bounded."""

    @abc.abstractmethod
    def names(self, system: System) -> tuple[str, ...]:
        """Name and unit of what is bounded."""

    def excess(self, system: System, state: State, u: Array, t: Array) -> Float[Array, " n"]:
        """Excess over both limits, in units of half the range."""
        return self.over(self.values(system, state, u))

    def over(self, values: Float[Array, " n"]) -> Float[Array, " m"]:
        """Excess of values over both limits, in units of half the range."""
        below, above = self._sides(values.shape[0])
        lower, upper = (jnp.broadcast_to(x, values.shape) for x in (self.lower, self.upper))
        both = jnp.isfinite(upper - lower)
        unit = jnp.where(both, 0.5 * jnp.where(both, upper - lower, 2.0), 1.0)
        found = [((lower - values) / unit)[below], ((values - upper) / unit)[above]]
        return jnp.concatenate(found)

    def _sides(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        for name, limit in (("lower", self.lower), ("upper", self.upper)):
            for_each(limit, count, f"bounds.{type(self).__name__}: {name}", "value")
        below, above = (np.flatnonzero(np.broadcast_to(limits, count)) for limits in self.limited)
        return below, above

    def labels(self, system: System) -> tuple[str, ...]:
        """Name of what is bounded, and which limit."""
        names = self.names(system)
        below, above = self._sides(len(names))
        lower = tuple(f"{names[k]} above its lower bound" for k in below)
        return lower + tuple(f"{names[k]} below its upper bound" for k in above)


class Input(Range):
    """Limits of input channels [N, N m].

    Attributes:
        lower: one number or one for each channel.
        upper: one number or one for each channel.
        channel: name or handle of one channel; None: all.
    """

    channel: Handle | str | None = eqx.field(
        default=None, kw_only=True, static=True, metadata=is_a(HandleOf("effect") | NAME)
    )

    def values(self, system: System, state: State, u: Array) -> Float[Array, " n"]:
        """The inputs."""
        return u if self.channel is None else u[system.input_index(self.channel)][None]

    def names(self, system: System) -> tuple[str, ...]:
        """Names of the channels."""
        channels = system.structure.inputs if self.channel is None else (named(self.channel),)
        return tuple(f"input {name!r}" for name in channels)

    def widened(self, factor: Any) -> Bound:
        """The same with limits so many times as wide, about their middle."""
        both = jnp.isfinite(self.lower) & jnp.isfinite(self.upper)
        middle = jnp.where(both, 0.5 * (self.lower + self.upper), 0.0)
        sides = tuple(middle + factor * (x - middle) for x in (self.lower, self.upper))
        return eqx.tree_at(lambda b: (b.lower, b.upper), self, sides)


class InputRate(Range):
    """Limits of the rates of input channels [N/s, N m/s] (slew rate).

    The rate is the difference of the inputs held over a step and the one before, over the time between the
    middles of both.

    Attributes:
        lower: one number or one for each channel [N/s, N m/s].
        upper: one number or one for each channel [N/s, N m/s].
        channel: name or handle of one channel; None: all.
        before: inputs before the first step [N, N m], one number or one for each channel of the system; None:
            they may begin with any value.

    Example:
        >>> import natcoord_jax as nc
        >>> bounds = nc.bounds.Input(-1.0, 1.0) & nc.bounds.InputRate(-2.0, 2.0, before=0.0)
    """

    channel: Handle | str | None = eqx.field(
        default=None, kw_only=True, static=True, metadata=is_a(HandleOf("effect") | NAME)
    )
    before: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number() | Numbers((None,))))

    def looks_back(self) -> bool:
        """It does."""
        return True

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excess of the rates over both limits, in units of half the range."""
        over = self.over(self.values(system, step.after, input_rate(step, self.before)))
        # Where nothing is before the first step, there is no rate to be limited.
        return over if self.before is not None else jnp.where(step.number == 0, -1.0, over)

    def values(self, system: System, state: State, u: Array) -> Float[Array, " n"]:
        """The rates, of all channels or of one."""
        return u if self.channel is None else u[system.input_index(self.channel)][None]

    def excess(self, system: System, state: State, u: Array, t: Array) -> Float[Array, " n"]:
        """Excess of inputs that do not change."""
        return self.over(self.values(system, state, jnp.zeros_like(u)))

    def names(self, system: System) -> tuple[str, ...]:
        """Names of the channels."""
        channels = system.structure.inputs if self.channel is None else (named(self.channel),)
        return tuple(f"rate of input {name!r}" for name in channels)


class Coordinate(Range):
    """Limits of a joint coordinate [rad, counted on over many turns, or m].

    Attributes:
        joint: handle or name.
        lower: [rad or m].
        upper: [rad or m].
        index: which coordinate of the joint.
    """

    joint: Handle | str = eqx.field(kw_only=True, static=True, metadata=is_a(JOINT_NAME))
    index: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))

    def values(self, system: System, state: State, u: Array) -> Float[Array, " n"]:
        """The coordinate."""
        return system.coordinate(state, self.joint, index=self.index)[None]

    def kept(self) -> dict[str, tuple[Any, Any]]:
        """Its limits."""
        what = f"coordinate {self.index} of {named(self.joint)!r} [rad or m]"
        return {what: (self.lower, self.upper)}

    def names(self, system: System) -> tuple[str, ...]:
        """The joint."""
        return (f"coordinate {self.index} of {named(self.joint)!r}",)


class Rate(Range):
    """Limits of the rate of a joint coordinate [rad/s or m/s].

    Attributes:
        joint: handle or name.
        lower: [rad/s or m/s].
        upper: [rad/s or m/s].
        index: which coordinate of the joint.
    """

    joint: Handle | str = eqx.field(kw_only=True, static=True, metadata=is_a(JOINT_NAME))
    index: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))

    def values(self, system: System, state: State, u: Array) -> Float[Array, " n"]:
        """The rate."""
        return system.rate(state, self.joint, index=self.index)[None]

    def kept(self) -> dict[str, tuple[Any, Any]]:
        """Its limits."""
        what = f"rate {self.index} of {named(self.joint)!r} [rad/s or m/s]"
        return {what: (self.lower, self.upper)}

    def names(self, system: System) -> tuple[str, ...]:
        """The joint."""
        return (f"rate {self.index} of {named(self.joint)!r}",)


class KeepOut(Bound):
    """A direction fixed in a body must stay out of a cone about a direction in space (a sensor and the sun).

    Attributes:
        body: handle or name.
        axis: direction in components of the body [-].
        cone: axis of the cone in space [-].
        angle: half the opening of the cone [rad].
    """

    body: Handle | str = eqx.field(static=True, metadata=is_a(BODY_NAME))
    axis: Any = eqx.field(kw_only=True, metadata=is_a(Directions()))
    cone: Any = eqx.field(kw_only=True, metadata=is_a(Directions()))
    angle: Any = eqx.field(kw_only=True, metadata=is_a(Number()))

    def excess(self, system: System, state: State, u: Array, t: Array) -> Float[Array, " n"]:
        """Cosine of the angle between the directions, less that of the cone."""
        first = 4 * system.body_index(self.body) + 1
        axis, cone = (jnp.asarray(x, float) for x in (self.axis, self.cone))
        pointing = (axis / jnp.linalg.norm(axis)) @ state.q[first : first + 3]
        return (pointing @ (cone / jnp.linalg.norm(cone)) - jnp.cos(self.angle))[None]

    def labels(self, system: System) -> tuple[str, ...]:
        """The body."""
        return (f"keep-out cone of {named(self.body)!r}",)


class Path(Bound):
    """Any smooth function of (state, u, t) that must not become positive.

    Attributes:
        function: (state, u, t) -> number or vector.
        name: for reports.
        count: how many numbers the function returns.
    """

    function: Callable[[State, Array, Array], Any] = eqx.field(converter=Function.of, metadata=is_a(EXCESS))
    name: str = eqx.field(default="own bound", static=True, metadata=is_a(NAME))
    count: int = eqx.field(default=1, kw_only=True, static=True, metadata=is_a(Whole(1)))

    def excess(self, system: System, state: State, u: Array, t: Array) -> Float[Array, " n"]:
        """Value of the function."""
        return jnp.atleast_1d(jnp.asarray(self.function(state, u, t), float)).reshape(self.count)

    def labels(self, system: System) -> tuple[str, ...]:
        """The name, numbered if there are several."""
        return (self.name,) if self.count == 1 else tuple(f"{self.name} [{k}]" for k in range(self.count))
