"""What all bounds have in common, and bounds made of bounds."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.memory import Carrier, Step, each_inside
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.kinds import Several, of
from natcoord_jax.core.state import State
from natcoord_jax.system import System


class Bound(Carrier):
    """Base of all bounds."""

    def excess(
        self, system: System, state: State, u: Float[Array, " inputs"], t: Float[Array, ""]
    ) -> Float[Array, " n"]:
        """By how much each bound is exceeded; negative inside."""
        return jnp.zeros(0)

    def labels(self, system: System) -> tuple[str, ...]:
        """Name of each bound."""
        return ()

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """By how much each bound is exceeded at the end of a step; memory is that at its start."""
        return self.excess(system, step.after, step.u, step.after.t)

    def widened(self, factor: Any) -> "Bound":
        """The same with the limits of inputs so many times as wide; itself if it has none."""
        return self

    def kept(self) -> dict[str, tuple[Any, Any]]:
        """Limits of what goals want values of, by what of, as these have it."""
        return {}

    def __and__(self, other: "Bound") -> "Bound":
        if not isinstance(other, Bound):
            return NotImplemented
        return All((self, other))


class All(Bound):
    """Several bounds at once."""

    parts: tuple[Bound, ...] = eqx.field(metadata=is_a(Several(of("a bound", Bound))))

    def inside(self) -> tuple[Bound, ...]:
        """The parts."""
        return self.parts

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excesses of all parts over a step."""
        pairs = each_inside(self, system, memory)
        return jnp.concatenate([part.of_step(system, numbers, step) for part, numbers in pairs])

    def excess(self, system: System, state: State, u: Array, t: Array) -> Float[Array, " n"]:
        """Excesses of all parts."""
        return jnp.concatenate([part.excess(system, state, u, t) for part in self.parts])

    def labels(self, system: System) -> tuple[str, ...]:
        """Labels of all parts."""
        return tuple(label for part in self.parts for label in part.labels(system))

    def widened(self, factor: Any) -> Bound:
        """The same with the limits of inputs so many times as wide; itself if it has none."""
        parts = tuple(part.widened(factor) for part in self.parts)
        return self if all(a is b for a, b in zip(parts, self.parts)) else All(parts)


BOUND = of("a bound, as nc.bounds.Input(-1.0, 1.0)", Bound)
"""What an argument may be."""
