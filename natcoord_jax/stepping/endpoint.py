"""Where a rollout ends, for any number of steps with one compiled program."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.assembly.system import System
from natcoord_jax.core.state import State
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.rollout import Plan, run_to_the_end
from natcoord_jax.stepping.scheme import EnergyMomentum

MOST = 1 << 30
"""Steps that one program can make."""


class Endpoint(eqx.Module):
    """The end of a rollout.

    Attributes:
        state: there.
        result: code, see `Result`.
        step: steps completed.
        iterations: of Newton, in all steps.
        substeps: accepted (sub)steps.
    """

    state: State
    result: Int[Array, ""]
    step: Int[Array, ""]
    iterations: Int[Array, ""]
    substeps: Int[Array, ""]


@dataclass(frozen=True)
class Sampled:
    """Inputs that are a function of time, taken at the stages of a step.

    Attributes:
        function: of the time [s], to shape (inputs,); None: zero.
        channels: number of inputs.
        fractions: where in the step the stages are.
    """

    function: Callable[[Array], Array] | None
    channels: int
    fractions: tuple[float, ...]

    def __call__(self, parameters: Any, step: Array, t: Array, state: State) -> Float[Array, "s inputs"]:
        """At the stages of a step of length `parameters` that starts at t."""
        if self.function is None:
            return jnp.zeros((len(self.fractions), self.channels), state.q.dtype)
        return jax.vmap(self.function)(t + parameters * jnp.asarray(self.fractions))


def _endpoint(system, state, dt, steps, inputs, scheme, tolerance):
    tableau = scheme.tableau
    control = Sampled(inputs, len(system.structure.inputs), tableau.c)
    plan = Plan(MOST, 0, tolerance, control, None, tableau, recorded=False)
    course = run_to_the_end(plan, system, state, dt, dt, steps)
    return Endpoint(course.state, course.code, course.step, course.iterations, course.taken)


_compiled = eqx.filter_jit(_endpoint, compiler_options={"xla_cpu_use_fusion_emitters": False})  # pyright: ignore[reportCallIssue]


def endpoint(
    system: System,
    state: State,
    *,
    dt: Any,
    steps: Any,
    inputs: Callable[[Array], Array] | None = None,
    scheme: EnergyMomentum,
    newton_tol: float = TOLERANCE,
) -> Endpoint:
    """Run a system and keep nothing but the end; without derivatives.

    Args:
        system: compiled system.
        state: initial state.
        dt: step [s].
        steps: number of steps; another number does not compile anew.
        inputs: function of time [s] to (inputs,) [N, N m], evaluated at the stages; None: zero.
        scheme: the scheme.
        newton_tol: see `simulate`.
    """
    numbers = jnp.asarray(dt, float), jnp.asarray(steps)
    return _compiled(system, state, *numbers, inputs, scheme, newton_tol)
