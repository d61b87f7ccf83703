"""Free numbers of the initial state, and the state at the start of a motion at given values of them."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.parameters import FreeNumber, check_room
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import JOINT_NAME, NAME, FunctionOf
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import State
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.system import System


class InitialNumber(FreeNumber):
    """Base of what is free at the start: of `nc.identify` each experiment has its own."""

    lower: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    upper: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    value: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))

    def __check_init__(self):
        """Refuse bounds without room."""
        check_room(self.name, self.lower, self.upper)

    @property
    def starts(self) -> bool:
        """It acts on the initial state."""
        return True


class JointNumber(InitialNumber):
    """Base of coordinates and rates of joints at the start.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
        value: first value; None: that of the initial state.
    """

    joint: Handle | str = eqx.field(static=True, metadata=is_a(JOINT_NAME))
    index: int = eqx.field(default=0, static=True, metadata=is_a(Whole(0)))

    def initial(self, system: System, state: State) -> Float[Array, "*t"]:
        """Value at the start of the search."""
        if self.value is not None:
            return jnp.asarray(self.value, float)
        return self.read(system, state)

    def read(self, system: System, state: State) -> Float[Array, "*t"]:
        """As the state has it."""
        raise NotImplementedError


class InitialCoordinate(JointNumber):
    """A joint coordinate that is free at the start [rad, counted on over many turns, or m].

    All that hangs on the joint is placed along with it, see `System.with_coordinate`; with loops, drives or
    couplings the state is assembled anew.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound [rad or m]; None: none.
        upper: upper bound [rad or m]; None: none.
        value: first value [rad or m]; None: that of the initial state.

    Example:
        >>> import natcoord_jax as nc
        >>> free = nc.InitialCoordinate("hinge", lower=-1.0, upper=1.0)
    """

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The coordinate."""
        return f"initial coordinate {self.index} of {named(self.joint)!r} [rad or m]"

    def read(self, system: System, state: State) -> Float[Array, "*t"]:
        """The coordinate."""
        return system.coordinate(state, self.joint, index=self.index)

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another coordinate."""
        return system.with_coordinate(state, self.joint, value, index=self.index)


class InitialRate(JointNumber):
    """The rate of a joint coordinate that is free at the start [rad/s or m/s], as of what is thrown.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound [rad/s or m/s]; None: none.
        upper: upper bound [rad/s or m/s]; None: none.
        value: first value [rad/s or m/s]; None: that of the initial state.

    Example:
        >>> import natcoord_jax as nc
        >>> free = nc.InitialRate("rail", lower=0.0, upper=20.0, value=5.0)
    """

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The rate."""
        return f"initial rate {self.index} of {named(self.joint)!r} [rad/s or m/s]"

    def read(self, system: System, state: State) -> Float[Array, "*t"]:
        """The rate."""
        return system.rate(state, self.joint, index=self.index)

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another rate."""
        place = system.coordinate(state, self.joint, index=self.index)
        return system.with_coordinate(state, self.joint, place, rate=value, index=self.index)


class InitialState(InitialNumber):
    """A number of the initial state that is no coordinate of a joint: the height of a free body, a heading.

    Afterwards the state is assembled, see `nc.assemble`: joints, loops, drives and couplings hold.

    Attributes:
        name: for reports, with its unit.
        apply: (system, state, value) -> state, the initial state with another value.
        value: first value.
        lower: lower bound; None: none.
        upper: upper bound; None: none.

    Example:
        >>> import equinox as eqx
        >>> import natcoord_jax as nc
        >>> def at_height(system, state, z):
        ...     return eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].set(z))
        >>> height = nc.InitialState("height [m]", apply=at_height, value=1.0, lower=0.0)
    """

    name: str = eqx.field(static=True, metadata=is_a(NAME))
    apply: Callable[[System, State, Array], State] = eqx.field(
        kw_only=True, converter=Function.of, metadata=is_a(FunctionOf("(system, state, value) -> state"))
    )
    value: Any = eqx.field(kw_only=True, metadata=is_a(Number()))

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Value at the start of the search."""
        return jnp.asarray(self.value, float)

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another value."""
        return self.apply(system, state, value)


def changed(system: System, numbers: Sequence[FreeNumber], values: Float[Array, " n"]) -> System:
    """The system at given values of what is free."""
    for number, value in zip(numbers, values):
        system = number.applied(system, value)
    return system


def begun(system: System, state: State, numbers: Sequence[FreeNumber], values: Float[Array, " n"]) -> State:
    """The initial state at given values of what is free, of the system at the same values."""
    if any(number.moves_geometry for number in numbers):
        state = assemble(system, state)
    for number, value in zip(numbers, values):
        state = number.started(system, state, value)
    # With loops, drives or couplings others have to follow, and a function may have taken joints apart.
    follows = system.structure.held and any(number.starts for number in numbers)
    return assemble(system, state) if follows or any(isinstance(n, InitialState) for n in numbers) else state
