"""Free numbers of the initial state: joint coordinates and rates at the start of a motion."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.parameters import FreeNumber, check_room
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import JOINT_NAME
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import State
from natcoord_jax.system import System


class InitialNumber(FreeNumber):
    """Base of coordinates and rates of joints at the start.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
        value: first value; None: that of the initial state of the problem.
    """

    joint: Handle | str = eqx.field(static=True, metadata=is_a(JOINT_NAME))
    index: int = eqx.field(default=0, static=True, metadata=is_a(Whole(0)))
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


class InitialCoordinate(InitialNumber):
    """A joint coordinate that is free at the start [rad, counted on over many turns, or m].

    All that hangs on the joint is placed along with it, see `System.with_coordinate`; with loops, drives or
    couplings the state is assembled anew.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound [rad or m]; None: none.
        upper: upper bound [rad or m]; None: none.
        value: first value [rad or m]; None: that of the initial state of the problem.

    Example:
        >>> import natcoord_jax as nc
        >>> free = nc.InitialCoordinate("hinge", lower=-1.0, upper=1.0)
    """

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The coordinate."""
        return f"initial coordinate {self.index} of {named(self.joint)!r} [rad or m]"

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Value at the start of the optimisation."""
        if self.value is not None:
            return jnp.asarray(self.value, float)
        return system.coordinate(state, self.joint, index=self.index)

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another coordinate."""
        return system.with_coordinate(state, self.joint, value, index=self.index)


class InitialRate(InitialNumber):
    """The rate of a joint coordinate that is free at the start [rad/s or m/s], as of what is thrown.

    Attributes:
        joint: handle or name of a joint of the spanning tree.
        index: which coordinate of the joint.
        lower: lower bound [rad/s or m/s]; None: none.
        upper: upper bound [rad/s or m/s]; None: none.
        value: first value [rad/s or m/s]; None: that of the initial state of the problem.

    Example:
        >>> import natcoord_jax as nc
        >>> free = nc.InitialRate("rail", lower=0.0, upper=20.0, value=5.0)
    """

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The rate."""
        return f"initial rate {self.index} of {named(self.joint)!r} [rad/s or m/s]"

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Value at the start of the optimisation."""
        if self.value is not None:
            return jnp.asarray(self.value, float)
        return system.rate(state, self.joint, index=self.index)

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another rate."""
        place = system.coordinate(state, self.joint, index=self.index)
        return system.with_coordinate(state, self.joint, place, rate=value, index=self.index)
