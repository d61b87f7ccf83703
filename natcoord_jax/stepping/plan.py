"""What is static about a rollout, and the record of its slots."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.mechanics.admissible_velocities import tangent
from natcoord_jax.system import System


@dataclass(frozen=True)
class Plan:
    """What is static about a rollout.

    Attributes:
        steps: number of steps.
        extra: slots available for retries.
        tolerance: of Newton's iteration.
        control: function (parameters, step index, t, state, fraction of the step) to inputs; None: they are
            parameters[step].
        event: function (numbers, state) whose change of sign ends the run, or None.
        tableau: of the collocation method.
        recorded: whether every slot is; else only the last is kept.
        control_reads: whether the control reads velocities, from states whose velocities have to be made
            tangent for it, see `assembly.reading`.
        event_reads: the same of the event.
    """

    steps: int
    extra: int
    tolerance: float
    control: Callable[[Any, Array, Array, State, Array], Array] | None
    event: Callable[[Any, State], Array] | None = None
    tableau: Tableau = gauss(1)
    recorded: bool = True
    control_reads: bool = False
    event_reads: bool = False

    def inputs(
        self, system: System, parameters: Any, step: Array, state: State, done: Array, fraction: Array
    ) -> Float[Array, " inputs"] | Float[Array, "s inputs"]:
        """Inputs of a (sub)step that starts at a state, after a part `done` of its step.

        Raises:
            ValueError: for a function that gives another number of inputs than the system has.
        """
        if self.control is None:
            return self.within_step(parameters[step], done, fraction)
        state = tangent(system, state) if self.control_reads else state
        given, names = self.control(parameters, step, state.t, state, fraction), system.structure.inputs
        if given.shape not in ((len(names),), (self.tableau.stages, len(names))):
            raise ValueError(
                f"inputs gives shape {given.shape}; this system has the input channels {list(names)}: "
                f"let the function (t, state) give shape ({len(names)},)"
            )
        return given

    def indicator(self, system: System, numbers: Any, state: State) -> Array:
        """What ends the run when its sign changes, with the numbers of the event."""
        assert self.event is not None
        return self.event(numbers, tangent(system, state) if self.event_reads else state)

    def within_step(self, inputs: Array, done: Array, fraction: Array) -> Array:
        """Inputs of a part of a step from those of the whole one: held, or interpolated from its stages."""
        if inputs.ndim == 1:
            return inputs
        nodes = self.tableau.c
        times = done + fraction * jnp.asarray(nodes)
        columns = []
        for j, node in enumerate(nodes):
            others = [(times - other) / (node - other) for k, other in enumerate(nodes) if k != j]
            columns.append(reduce(jnp.multiply, others, jnp.ones_like(times)))
        weights = jnp.where(fraction == 1.0, jnp.eye(len(nodes)), jnp.stack(columns, axis=1))
        return weights @ inputs


A = TypeVar("A", bound="Apart")


@dataclass(frozen=True)
class Apart:
    """A callable without its numbers: hashable, as what is static about a rollout must be."""

    rest: Any

    @classmethod
    def of(cls: type[A], function: Any) -> tuple[A, Any]:
        """A callable apart into this and its numbers."""
        numbers, rest = eqx.partition(function, eqx.is_array)
        return cls(rest), numbers


class Control(Apart):
    """Inputs by a function of time and state."""

    def __call__(self, numbers: Any, step: Array, t: Array, state: State, fraction: Array) -> Array:
        """Inputs of a (sub)step that starts at t."""
        return jnp.asarray(eqx.combine(numbers, self.rest)(t, state), float)


class Event(Apart):
    """A function of the state whose change of sign ends a run."""

    def __call__(self, numbers: Any, state: State) -> Array:
        """Its value."""
        return jnp.asarray(eqx.combine(numbers, self.rest)(state), float)


class Slots(eqx.Module):
    """Record of all slots.

    Attributes:
        states: state after each slot (unchanged if the attempt failed).
        y: unknowns of each attempt.
        step: step each slot belongs to.
        fraction: its part of the step.
        done: the part of the step before it.
        accepted: whether the attempt succeeded.
        finished: steps completed after the slot.
        event: number of the contact that closes at the end of the slot, see `located`; None: of schemes that
            do not look for it.
    """

    states: State
    y: Float[Array, "*slots unknowns"]
    step: Int[Array, "*slots"]
    fraction: Float[Array, "*slots"]
    done: Float[Array, "*slots"]
    accepted: Bool[Array, "*slots"]
    finished: Int[Array, "*slots"]
    event: Int[Array, "*slots"] | None = None
