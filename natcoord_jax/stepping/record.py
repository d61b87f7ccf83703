"""What the derivative of a rollout is taken at, and what goes back along it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.stepping.factors import Factors
from natcoord_jax.stepping.located import COMPLETE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.system import System


def zero_tangent(x: Array) -> Array | np.ndarray:
    """No change of an array; of integers JAX wants one of a kind of its own."""
    if jnp.issubdtype(jnp.result_type(x), jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(jnp.shape(x), jax.dtypes.float0)


def is_zero(x: Any) -> bool:
    """Whether a tangent is known to be none."""
    return isinstance(x, jax.custom_derivatives.SymbolicZero)


def instantiated(tangents: Any, primals: Any) -> Any:
    """Tangents with arrays for symbolic zeros."""
    return jax.tree.map(lambda t, p: zero_tangent(p) if is_zero(t) else t, tangents, primals, is_leaf=is_zero)


class Parameters(eqx.Module):
    """What a rollout depends on besides its first state, apart into what varies and what does not.

    Attributes:
        varied: leaves that are differentiated.
        fixed: all others.
        chosen: which leaves vary.
        structure: of (system, parameters, dt).
    """

    varied: list[Array]
    fixed: list[Array]
    chosen: tuple[int, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, numbers: tuple, tangents: tuple) -> tuple["Parameters", list[Array]]:
        """Split by the tangents, and the tangents of what varies."""
        leaves, structure = jax.tree.flatten(numbers)
        changes = jax.tree.leaves(tangents, is_leaf=is_zero)
        chosen = tuple(i for i, change in enumerate(changes) if not is_zero(change))
        fixed = [x for i, x in enumerate(leaves) if i not in chosen]
        return cls([leaves[i] for i in chosen], fixed, chosen, structure), [changes[i] for i in chosen]

    def whole(self, varied: list[Array]) -> tuple[System, Any, Array]:
        """System, parameters and step with other values of what varies."""
        some, rest = iter(varied), iter(self.fixed)
        count = len(self.varied) + len(self.fixed)
        return jax.tree.unflatten(
            self.structure, [next(some) if i in self.chosen else next(rest) for i in range(count)]
        )


class Slot(eqx.Module):
    """Where one slot began, its solution and its inputs (None where a control decides)."""

    before: State
    y: Float[Array, "*slots unknowns"]
    u: Float[Array, "*slots inputs"] | None
    step: Int[Array, "*slots"]
    fraction: Float[Array, "*slots"]
    done: Float[Array, "*slots"]
    accepted: Bool[Array, "*slots"]
    event: Int[Array, "*slots"] | None = None

    @property
    def completes(self) -> Bool[Array, "*slots"]:
        """Whether it is the last part of its step, where impacts are located."""
        return self.done + self.fraction > 1.0 - COMPLETE

    def settled(self, after: State) -> State:
        """The state at its end, where the step at hand may be the next."""
        elapsed = after.elapsed
        if self.event is None or elapsed is None:
            return after
        return replace_fields(after, elapsed=jnp.where(self.completes, 0.0, elapsed))

    def inputs(self, plan: Plan, system: System, parameters: Any, state: State) -> Float[Array, " inputs"]:
        """Its inputs, those that a control decides at a state."""
        if self.u is not None:
            return self.u
        return plan.inputs(system, parameters, self.step, state, self.done, self.fraction)


class Record(eqx.Module):
    """All that the derivative is taken at."""

    numbers: Parameters
    slots: Slot
    factors: Factors


class ParameterTangents(eqx.Module):
    """Tangents that those of all slots are linear in, or their cotangents.

    Attributes:
        varied: of `Parameters.varied`.
        u: of the slots' inputs.
        state: of the first state.
        forced: of the slots' residuals and their ends, in addition; None: there are none.
    """

    varied: list[Array]
    u: Any
    state: State
    forced: tuple[Float[Array, "slots unknowns"], State] | None = None
