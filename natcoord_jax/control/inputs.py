"""How a torque history is made of a few numbers: splines of the input channels, held over each step."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.arguments import Part, checked, is_a
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import Numbers, Whole

Parts = tuple[float, ...]
"""Times within a step, as parts of it."""
MIDDLE: Parts = (0.5,)


class Shaping(NamedTuple):
    """A spline as a linear machine with a small register, one step after the other.

    register_k+1 = shift_k register_k + load_k w_k, and u_k = read_k register_k + direct_k w_k at the stages
    of a step, for every input channel alike. New coefficients w enter where an interval of the spline begins,
    those of the first interval but one are in the register at the start.

    Attributes:
        shift: (steps, d, d).
        load: (steps, d).
        read: (steps, stages, d).
        direct: (steps, stages).
        enters: whether a coefficient enters in a step, (steps,).
        start: places of the first coefficients in the register, (d, degree).
    """

    shift: Float[np.ndarray, "steps d d"]
    load: Float[np.ndarray, "steps d"]
    read: Float[np.ndarray, "steps stages d"]
    direct: Float[np.ndarray, "steps stages"]
    enters: Bool[np.ndarray, " steps"]
    start: Float[np.ndarray, "d degree"]


def _basis(degree: int, place: float) -> np.ndarray:
    """Values of the degree + 1 uniform B-splines that are not zero at a place in [0, 1) of an interval."""
    values = np.ones(1)
    for order in range(1, degree + 1):
        before = np.arange(order)
        right = (before + 1 - place) / order * values
        left = (place + order - 1 - before) / order * values
        values = np.concatenate([right, [0.0]]) + np.concatenate([[0.0], left])
    return values


def _numbers(shared: Any) -> Any:
    """As an array; none stays none."""
    return shared if shared is None or isinstance(shared, jax.Array) else np.asarray(shared, float)


class Spline(Part):
    """Inputs as uniform B-splines over intervals of some steps, taken at the stages of each step.

    At order two that is its middle. (One that is held over each step has one value in it at any order.)

    Attributes:
        degree: 0 holds a value over each interval, 1 is piecewise linear, 3 a cubic spline.
        every: steps of an interval.
        shared: what the channels of the system get of each input that is decided (channels, decided), see
            `shared`; None: every channel has its own.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.inputs.Spline(degree=1, every=5).coefficients(100)
        21
    """

    degree: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))
    every: int = eqx.field(default=1, kw_only=True, static=True, metadata=is_a(Whole(1)))
    shared: Any = eqx.field(
        default=None, kw_only=True, converter=_numbers, metadata=is_a(Numbers((None, None)))
    )

    @checked("coefficients", steps=Whole(1))
    def coefficients(self, steps: int) -> int:
        """Number of coefficients of each input channel."""
        return -(-steps // self.every) + self.degree

    def count(self, channels: int) -> int:
        """How many inputs are decided for so many channels.

        Raises:
            ValueError: where `shared` is for another number of channels.
        """
        if self.shared is None:
            return channels
        if self.shared.shape[0] != channels:
            raise ValueError(
                f"inputs: shared has {self.shared.shape[0]} rows; pass one for each of the {channels} input "
                "channels of the system, in the order of `system.structure.inputs`"
            )
        return self.shared.shape[1]

    def driven(self, decided: Float[Array, "*steps m"], channels: int) -> Float[Array, "*steps inputs"]:
        """Inputs of so many channels from those that are decided; what is decided for none acts on none."""
        if self.shared is not None:
            return decided @ jnp.asarray(self.shared).T
        return decided if channels else decided[..., :0]

    def decided(self, inputs: Float[Array, "*steps inputs"], count: int) -> Float[Array, "*steps m"]:
        """Decided inputs, so many, nearest to inputs of the channels."""
        if self.shared is not None:
            return inputs @ jnp.linalg.pinv(jnp.asarray(self.shared)).T
        return inputs if inputs.shape[-1] else jnp.zeros((*inputs.shape[:-1], count))

    def matrix(self, steps: int, parts: Parts = MIDDLE) -> Float[np.ndarray, "times coefficients"]:
        """Inputs per coefficient, at some parts of all steps."""
        found = np.zeros((steps, len(parts), self.coefficients(steps)))
        for k in range(steps):
            interval, rest = divmod(k, self.every)
            for stage, part in enumerate(parts):
                values = _basis(self.degree, (rest + part) / self.every)
                found[k, stage, interval : interval + self.degree + 1] = values
        return found.reshape(steps * len(parts), -1)

    def fitted(self, inputs: Any, parts: Parts = MIDDLE) -> Float[Array, "coefficients m"]:
        """Coefficients nearest to the decided inputs of all steps (steps, m), or at parts of them."""
        inputs = jnp.asarray(inputs, float)
        if inputs.ndim == 2 and len(parts) > 1:
            inputs = jnp.broadcast_to(inputs[:, None], (len(inputs), len(parts), inputs.shape[1]))
        if self.degree == 0 and self.every == 1:
            return inputs if inputs.ndim == 2 else jnp.mean(inputs, axis=1)
        inverse = np.linalg.pinv(self.matrix(inputs.shape[0], parts))
        return jnp.asarray(inverse) @ inputs.reshape(-1, inputs.shape[-1])

    def shaping(self, steps: int, parts: Parts = MIDDLE) -> Shaping:
        """The spline as a machine with a register; one that holds each value over one step has none."""
        size = self.degree + (self.every > 1)
        shift, load = np.zeros((steps, size, size)), np.zeros((steps, size))
        read, direct = np.zeros((steps, len(parts), size)), np.zeros((steps, len(parts)))
        numbers = np.arange(steps)
        enters = numbers % self.every == 0
        for k in range(steps):
            values = np.stack([_basis(self.degree, (k % self.every + part) / self.every) for part in parts])
            if not size:
                direct[k] = 1.0
            elif enters[k]:
                shift[k], load[k, -1] = np.eye(size, k=1), 1.0
                read[k, :, size - self.degree :] = values[:, :-1]
                direct[k] = values[:, -1]
            else:
                shift[k], read[k] = np.eye(size), values
        start = np.eye(size)[:, size - self.degree :]
        return Shaping(shift, load, read, direct, enters, start)


SPLINE = of("nc.inputs.held(), nc.inputs.cubic(...) or another spline", Spline)
"""What an argument may be."""


@checked()
def held() -> Spline:
    """Inputs held over each step, free in every step."""
    return Spline()


@checked(every=Whole(1))
def piecewise_linear(every: int = 1) -> Spline:
    """Inputs that are linear over intervals of `every` steps and continuous."""
    return Spline(degree=1, every=every)


@checked(every=Whole(1))
def cubic(every: int = 10) -> Spline:
    """Inputs as cubic B-splines, twice continuously differentiable, over intervals of `every` steps."""
    return Spline(degree=3, every=every)


@checked(matrix=Numbers((None, None)), spline=SPLINE)
def shared(matrix: Any, spline: Spline | None = None) -> Spline:
    """Inputs that several channels share: one that drives several motors, or synergies of many.

    The channels get matrix @ w of the inputs w that are decided. With copies of a system in one scene, of
    other masses or stiffnesses, one history of inputs is found that serves all of them. Costs, bounds and
    `solution.inputs` are of the channels, so that `nc.cost.Effort()` counts each copy; a weight for each
    channel counts some.

    Args:
        matrix: what each channel gets of each decided input (channels, decided), rows in the order of
            `system.structure.inputs`.
        spline: how the decided inputs run over the steps; None: held over each.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.inputs.shared([[1.0], [1.0]], nc.inputs.cubic(5)).count(2)
        1
    """
    return dataclasses.replace(spline or Spline(), shared=matrix)
