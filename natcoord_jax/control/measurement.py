"""What is compared with measurements: channels of simulated motions, and their derivatives by unknowns."""

from itertools import count
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.control.initial import begun, changed
from natcoord_jax.control.parameters import FreeNumber
from natcoord_jax.core.callables import replace_fields
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import JOINT_NAME, FunctionOf, Kind, Several, is_other, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.numeric import array_of
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.reading.sensors import joint_coordinates
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System


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
"""What arguments may be."""


class Setting(eqx.Module):
    """All of a simulated measurement but the values of the unknowns.

    Attributes:
        system: with its values before the identification.
        dt: step [s].
        numbers: unknown ones of the system, then those of the initial state.
        sensors: functions of system and trajectory, joints, points.
        control: inputs as a function of (t, state), or None.
        steps: number of steps.
        save_every: steps from sample to sample.
        scheme: of the simulation.
    """

    system: System
    dt: Float[Array, ""]
    numbers: tuple[FreeNumber, ...]
    sensors: tuple[Any, ...]
    control: Any
    steps: int = eqx.field(static=True)
    save_every: int = eqx.field(static=True)
    scheme: Scheme = eqx.field(static=True)

    def lean(self) -> "Setting":
        """Without what the program need not know, so that another value compiles nothing."""
        gone = {"lower": None, "upper": None, "value": None}
        return replace_fields(self, numbers=tuple(replace_fields(n, **gone) for n in self.numbers))

    def at(self, state: State, values: Float[Array, " n"]) -> tuple[System, State]:
        """The system and the initial state of an experiment at given values of the unknowns."""
        system = changed(self.system, self.numbers, values)
        return system, begun(system, state, self.numbers, values)

    def run(self, values: Float[Array, " n"], state: State, inputs: Any) -> tuple[list[Array], Trajectory]:
        """Channels of each sensor (samples, channels) in an experiment, and its motion."""
        system, start = self.at(state, values)
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
        found = jax.eval_shape(lambda x: self.run(x, state, inputs)[0], jnp.zeros(len(self.numbers)))
        for sensor, channels in zip(self.sensors, found):
            own = _names(self.system, sensor, channels.shape[1])
            names += [name or f"channel {k}" for name, k in zip(own, numbers)]
        return tuple(names)


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
