"""What goals, costs and bounds see of a motion, and what they ask to be carried along it.

A condition on a motion may need more than the state at hand: an integral, the state at a waypoint, the inputs
of the step before. What it needs it declares as a number of its own memory, and says how that goes on from
step to step; the node that one step hands to the next carries it. What nobody asks for is not carried.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.arguments import Part
from natcoord_jax.core.state import State
from natcoord_jax.system import System


class Instant(NamedTuple):
    """A stage of a step.

    Attributes:
        part: of the step that has gone by.
        weight: of the quadrature over the step; all together are one.
        state: there.
        u: inputs there [N, N m].
    """

    part: float
    weight: float
    state: State
    u: Float[Array, " inputs"]


class Step(NamedTuple):
    """One step of a motion, or of one with several stages also its part up to a stage, for bounds.

    Inputs that are not held over the step are those of its last stage.

    Attributes:
        number: of the step, the first is 0.
        dt: its duration [s].
        before: state at its start.
        after: state at its end.
        u: inputs held over it [N, N m].
        last: inputs of the step before, zero in the first one; empty where nobody asks for them.
        gap: time from the middle of the step before to that of this one [s], or between the times of inputs
            that are not held.
        free: values of what is free besides the inputs, by name.
        stages: where inputs and motion are known within it; none for steps of one stage.
    """

    number: Int[Array, ""]
    dt: Float[Array, ""]
    before: State
    after: State
    u: Float[Array, " inputs"]
    last: Float[Array, " inputs_or_none"]
    gap: Float[Array, ""]
    free: dict[str, Float[Array, ""]]
    stages: tuple[Instant, ...] = ()

    def integral(self, density: Callable[[State, Array], Any]) -> Float[Array, ""]:
        """Integral over the step of a function of (state, u): trapezoidal, or by the stages."""
        if not self.stages:
            first, last = (density(state, self.u) for state in (self.before, self.after))
            return 0.5 * self.dt * (first + last)
        return self.dt * sum(at.weight * density(at.state, at.u) for at in self.stages)

    def up_to_stages(self) -> "tuple[Step, ...]":
        """The step up to each of its stages; of one stage the step itself."""
        found = []
        for at in self.stages:
            gap = self.gap + (at.part - self.stages[-1].part) * self.dt
            found.append(self._replace(dt=at.part * self.dt, after=at.state, u=at.u, gap=gap))
        return tuple(found) or (self,)


class Ending(NamedTuple):
    """A motion at its end.

    Attributes:
        first: state at its start; that of the problem, unless somebody asks for it.
        last: state at its end.
        memory: what was carried along for the one that is asked.
        free: values of what is free besides the inputs, by name.
    """

    first: State
    last: State
    memory: Float[Array, " memory"]
    free: dict[str, Float[Array, ""]]


class Carrier(Part):
    """Base of goals, costs and bounds: what is carried along a motion for them.

    The memory of one that holds others, as a sum, begins with theirs, one after the other; its own is last.
    It is zero at the start of a motion.
    """

    def inside(self) -> tuple["Carrier", ...]:
        """Goals, costs or bounds that it holds."""
        return ()

    def everything(self) -> Iterator["Carrier"]:
        """It, what it holds, and so on."""
        yield self
        for part in self.inside():
            yield from part.everything()

    def own(self, system: System) -> int:
        """How many numbers it needs besides those of what it holds."""
        return 0

    def remembered(
        self, system: System, own: Float[Array, " own"], inside: list[Array], step: Step
    ) -> Float[Array, " own"]:
        """Its own numbers after a step.

        Args:
            system: compiled system.
            own: before it.
            inside: memories of what it holds, after it.
            step: the step.
        """
        return own

    def furthest(self) -> int:
        """The last step after which it looks at the motion, besides its end."""
        return max((part.furthest() for part in self.inside()), default=0)

    def marks(self) -> tuple[int, ...]:
        """Numbers of steps at whose ends it begins or ceases to count, besides those of what it holds."""
        return ()

    def remarked(self, moved: Callable[[int], int]) -> "Carrier":
        """The same with these at other steps."""
        return self

    def looks_back(self) -> bool:
        """Whether it asks for the inputs of the step before."""
        return any(part.looks_back() for part in self.inside())

    def looks_at_start(self) -> bool:
        """Whether it asks for the state at the start of the motion."""
        return any(part.looks_at_start() for part in self.inside())

    def memory(self, system: System) -> int:
        """How many numbers are carried along for it and what it holds."""
        return sum(part.memory(system) for part in self.inside()) + self.own(system)

    def divided(self, system: System, memory: Array) -> tuple[list[Array], Array]:
        """Its memory as that of each of what it holds, and its own."""
        ends = np.cumsum([part.memory(system) for part in self.inside()], dtype=int)
        *inside, own = jnp.split(memory, ends) if len(ends) else [memory]
        return inside, own

    def carried(self, system: System, memory: Array, step: Step) -> Float[Array, " memory"]:
        """Its memory after a step."""
        inside, own = self.divided(system, memory)
        pairs = zip(self.inside(), inside)
        inside = [part.carried(system, numbers, step) for part, numbers in pairs]
        return jnp.concatenate([*inside, self.remembered(system, own, inside, step)])


def each_inside(whole: Any, system: System, memory: Array) -> list[tuple[Any, Array]]:
    """What a carrier holds, each with its memory."""
    return list(zip(whole.inside(), whole.divided(system, memory)[0]))


def only_where(here: Bool[Array, ""], tree: Any) -> Any:
    """The same, with derivatives where it counts only: one that is NaN elsewhere does not get out.

    Both this and a `where` on what is made of it are needed: zero times NaN is NaN.
    """
    numbers, others = eqx.partition(tree, eqx.is_inexact_array)
    numbers = jax.tree.map(lambda x: jnp.where(here, x, jax.lax.stop_gradient(x)), numbers)
    return eqx.combine(numbers, others)


def input_rate(step: Step, before: Any) -> Float[Array, " inputs"]:
    """Rate of the inputs from the step before [N/s, N m/s]; none in the first one if nothing is before."""
    given = step.u if before is None else jnp.broadcast_to(jnp.asarray(before, float), step.u.shape)
    return (step.u - jnp.where(step.number == 0, given, step.last)) / step.gap
