"""What is compared with measurements: channels of simulated motions, and their derivatives by unknowns."""

from collections.abc import Callable
from itertools import count
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.control.parameters import Parameter
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.callables import Function, replace_fields
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import FLAG, JOINT_NAME, NAME, FunctionOf, Kind, Several, is_other, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.numeric import Number, Whole, array_of
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.reading.sensors import joint_coordinates
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System


class Initial(Part):
    """A number of the initial state that is not known: an angle or a rate at the start of the measurement.

    Each experiment has its own. What constraints and drives ask for beside it is assembled.

    Attributes:
        name: for reports.
        joint: handle or name of the joint whose coordinate it is; for anything else pass `apply`.
        rate: whether it is the rate of that coordinate [rad/s or m/s], not the coordinate [rad or m].
        index: which coordinate of the joint.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
        apply: (system, state, value) -> state, for what is no coordinate of a joint; needs `value`.
        value: where the search begins; None: as in the state.

    Example:
        >>> import natcoord_jax as nc
        >>> push = nc.Initial("push", "hinge", rate=True, lower=-1.0, upper=1.0)
    """

    name: str = eqx.field(static=True, metadata=is_a(NAME))
    joint: Handle | str | None = eqx.field(default=None, static=True, metadata=is_a(JOINT_NAME))
    rate: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    index: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))
    lower: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    upper: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    apply: Callable[[System, State, Array], State] | None = eqx.field(
        default=None,
        kw_only=True,
        converter=Function.of,
        metadata=is_a(FunctionOf("(system, state, value) -> state")),
    )
    value: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))

    def __check_init__(self):
        """Refuse what is nowhere, or has no room."""
        if (self.joint is None) == (self.apply is None) or (self.joint is None and self.value is None):
            raise ValueError(f"initial {self.name!r}: pass `joint`, or `apply` together with `value`")
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(
                f"initial {self.name!r}: the lower bound {self.lower:g} is not below the upper bound "
                f"{self.upper:g}; pass bounds with room between them"
            )

    def initial(self, system: System, states: State) -> Float[Array, "*t"]:
        """Where the search begins, in each of some states."""
        if self.value is not None or self.joint is None:
            return jnp.broadcast_to(jnp.asarray(self.value, float), states.t.shape)
        read = system.rate if self.rate else system.coordinate
        return read(states, self.joint, index=self.index)

    def applied(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The state with another value."""
        if self.joint is None:
            assert self.apply is not None
            return self.apply(system, state, value)
        if not self.rate:
            return system.with_coordinate(state, self.joint, value, index=self.index)
        angle = system.coordinate(state, self.joint, index=self.index)
        return system.with_coordinate(state, self.joint, angle, rate=value, index=self.index)


class MeasuredKind(Kind):
    """Measured numbers, of which some may be missing."""

    wanted = (
        "finite numbers of shape (samples, channels) or (experiments, samples, channels), of two samples or "
        "more, NaN where missing"
    )
    measured = True

    def complaint(self, value: Any) -> str | None:
        """Whether they are."""
        array = array_of(value)
        if array is None:
            return is_other(value)
        if array.ndim not in (1, 2, 3) or not array.size or array.shape[-2:][0] < 2:
            return f"has shape {array.shape}"
        return "has infinite numbers" if np.any(np.isinf(np.asarray(array))) else None


SENSOR = FunctionOf("(system, trajectory) -> (samples, channels)", 2) | JOINT_NAME | of("nc.Point", Marker)
SENSORS = SENSOR | Several(SENSOR, 1)
MEASURED = MeasuredKind()
INITIAL = Several(of("nc.Initial(...)", Initial))
"""What arguments may be."""


class Setting(eqx.Module):
    """All of a simulated measurement but the values of the unknowns.

    Attributes:
        system: with its values before the identification.
        dt: step [s].
        parameters: unknown numbers of the system.
        initial: unknown numbers of the initial state.
        sensors: functions of system and trajectory, joints, points.
        control: inputs as a function of (t, state), or None.
        steps: number of steps.
        save_every: steps from sample to sample.
        scheme: of the simulation.
    """

    system: System
    dt: Float[Array, ""]
    parameters: tuple[Parameter, ...]
    initial: tuple[Initial, ...]
    sensors: tuple[Any, ...]
    control: Any
    steps: int = eqx.field(static=True)
    save_every: int = eqx.field(static=True)
    scheme: Scheme = eqx.field(static=True)

    def lean(self) -> "Setting":
        """Without what the program need not know, so that another value compiles nothing."""
        gone = {"lower": None, "upper": None, "value": None}
        parameters = tuple(replace_fields(p, **gone) for p in self.parameters)
        return replace_fields(
            self, parameters=parameters, initial=tuple(replace_fields(i, **gone) for i in self.initial)
        )

    def system_at(self, values: Float[Array, " p"]) -> System:
        """The system with other values of its parameters."""
        system = self.system
        for parameter, value in zip(self.parameters, values):
            system = parameter.applied(system, value)
        return system

    def start_at(self, system: System, state: State, values: Float[Array, " i"]) -> State:
        """The initial state of an experiment, of the system with its values."""
        if any(parameter.moves for parameter in self.parameters):
            state = assemble(system, state)
        for unknown, value in zip(self.initial, values):
            state = unknown.applied(system, state, value)
        # (Where constraints or drives have a say as well, what was set is marked as held.)
        return state if state.held is None or not self.initial else assemble(system, state)

    def run(self, values: Float[Array, " n"], state: State, inputs: Any) -> tuple[list[Array], Trajectory]:
        """Channels of each sensor (samples, channels) in an experiment, and its motion."""
        system = self.system_at(values[: len(self.parameters)])
        start = self.start_at(system, state, values[len(self.parameters) :])
        control = self.control
        motion = simulate(
            system, start, dt=self.dt, steps=self.steps, save_every=self.save_every, scheme=self.scheme,
            inputs=inputs if control is None else lambda t, state: control(t, state), throw=False,
        )  # fmt: skip
        return [self.read(sensor, system, motion, start) for sensor in self.sensors], motion

    def read(self, sensor: Any, system: System, motion: Trajectory, start: State) -> Array:
        """Channels of one of the sensors (samples, channels).

        Raises:
            ValueError: for a function that returns something else than samples and channels.
        """
        if isinstance(sensor, Marker):
            return system.sense(motion, sensor, state=start).position
        if isinstance(sensor, Handle | str):
            return motion.states.coordinates[..., np.array(joint_coordinates(system, sensor)[1])]
        found, samples = jnp.asarray(sensor(system, motion), float), self.steps // self.save_every + 1
        if found.ndim not in (1, 2) or found.shape[0] != samples:
            raise ValueError(
                f"identify: a function of `sensors` returns shape {found.shape}; return (samples, channels), "
                f"here ({samples}, channels)"
            )
        return found[:, None] if found.ndim == 1 else found

    def labels(self, state: State, inputs: Any) -> tuple[str, ...]:
        """Names of the channels."""
        names, numbers = [], count(1)
        found = jax.eval_shape(lambda x: self.run(x, state, inputs)[0], self.unknowns())
        for sensor, channels in zip(self.sensors, found):
            own = _names(self.system, sensor, channels.shape[1])
            names += [name or f"channel {k}" for name, k in zip(own, numbers)]
        return tuple(names)

    def unknowns(self) -> Float[Array, " n"]:
        """Room for the unknowns of an experiment."""
        return jnp.zeros(len(self.parameters) + len(self.initial))


def _names(system: System, sensor: Any, channels: int) -> list[str]:
    """Names of the channels of a sensor; empty for those of a function."""
    if isinstance(sensor, Marker):
        return [f"point of {sensor.body.name!r}, {axis} [m]" for axis in "xyz"]
    if not isinstance(sensor, Handle | str):
        return [""] * channels
    name, units = sensor if isinstance(sensor, str) else sensor.name, joint_coordinates(system, sensor)[2]
    return [f"{name!r}" + f" {k + 1}" * (channels > 1) + f" [{unit}]" for k, unit in enumerate(units)]


def of_one(tree: Any, index: int) -> Any:
    """One of several, along the first axes of arrays, without a program for each shape."""
    return jax.tree.map(lambda x: as_array(np.asarray(x)[index]), tree)


class Predicted(NamedTuple):
    """Channels of experiments, in lanes: one for each start and experiment.

    Attributes:
        channels: (lanes, samples, channels).
        slopes: their derivatives by the unknowns, along a last axis.
        result: codes of the simulations (lanes,).
    """

    channels: Float[Array, "lanes samples channels"]
    slopes: Float[Array, "lanes samples channels unknowns"]
    result: Int[Array, " lanes"]


@compiled
def predicted(setting: Setting, states: State, inputs: Any, values: Float[Array, "lanes n"]) -> Predicted:
    """Channels at some values of the unknowns, all starts and experiments in one batch.

    Forward mode: channels are thousands and unknowns a few, and the linearised equations of a step, once
    solved, serve all of them.
    """

    def channels(state: State, u: Any, x: Array) -> tuple[Array, tuple[Array, Array]]:
        each, motion = setting.run(x, state, u)
        found = jnp.concatenate(each, axis=1)
        return found, (found, motion.result)

    each = jax.jacfwd(channels, argnums=2, has_aux=True)
    if len(values) == 1:  # (Half the time to compile.)
        alone = each(*jax.tree.map(lambda x: x[0], (states, inputs, values)))
        slopes, (found, result) = jax.tree.map(lambda x: x[None], alone)
    else:
        slopes, (found, result) = jax.vmap(each)(states, inputs, values)
    return Predicted(found, slopes, result)
