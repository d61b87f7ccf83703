"""Where a rollout ends, for any number of steps with one compiled program."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import at_top_level
from natcoord_jax.core.closures import with_callables
from natcoord_jax.core.state import State
from natcoord_jax.native.call import as_native, fits
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.rollout import run_to_the_end
from natcoord_jax.stepping.rollout_state import RolloutProblem
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.stepping.two_kernel_loop import in_parts, unknowns_of
from natcoord_jax.system import System
from natcoord_jax.xla.effort import FULL, accepted
from natcoord_jax.xla.one_kernel import apart, as_one_kernel, in_one_array, plainly

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
        channels: number of inputs.
        fractions: where in the step the stages are.
    """

    channels: int
    fractions: tuple[float, ...]

    def __call__(
        self, parameters: Any, step: Array, t: Array, state: State, fraction: Array
    ) -> Float[Array, "s inputs"]:
        """At the stages of a (sub)step that starts at t; parameters: length of the step, function of time."""
        dt, function = parameters
        if function is None:
            return jnp.zeros((len(self.fractions), self.channels), state.q.dtype)
        return jax.vmap(function)(t + fraction * dt * jnp.asarray(self.fractions))


@lru_cache(maxsize=64)
def _program(structure: Any, kinds: tuple, scheme: Scheme, tolerance: float) -> Callable:
    """The compiled program for all systems and states of one structure, their numbers in one array.

    Nothing but one kernel where that is possible: every array that goes in and every operation outside take
    longer than an evaluation of the equations of a small system.
    """
    like = jax.tree.unflatten(structure, kinds)[0]  # for what is static in it
    control = Sampled(len(like.structure.inputs), scheme.tableau.c)
    plan = Plan(MOST, 0, tolerance, control, None, scheme.tableau, recorded=False)

    def end(kernel: Callable, numbers: Array, dt: Array, steps: Array) -> Endpoint:
        system, state, inputs = jax.tree.unflatten(structure, apart(numbers, kinds))
        course = run_to_the_end(RolloutProblem(system, (dt, inputs), dt, None, plan, steps), state, kernel)
        return Endpoint(course.state, course.code, course.step, course.iterations, course.taken)

    def run(*numbers: Array) -> Endpoint:
        if in_parts(like, plan, None):
            return end(as_one_kernel, *numbers)
        whole = partial(end, plainly)
        if fits(unknowns_of(plan, like)):
            return as_native(as_one_kernel, whole, *numbers)
        return as_one_kernel(whole, *numbers)

    outermost = jax.jit(run, compiler_options=accepted(FULL))
    within = jax.jit(run)  # JAX accepts options at the outermost call only.
    return lambda *numbers: (outermost if at_top_level(numbers) else within)(*numbers)


def _number(x: Any, kind: type) -> Any:
    return x if isinstance(x, jax.Array) else kind(x)


def endpoints(
    system: System,
    state: State,
    *,
    inputs: Callable[[Array], Array] | None = None,
    scheme: Scheme,
    newton_tol: float = TOLERANCE,
) -> Callable[[Any, int], Endpoint]:
    """Runs of a system of which nothing is kept but the end; without derivatives.

    Args:
        system: compiled system.
        state: initial state.
        inputs: function of time [s] to (inputs,) [N, N m], evaluated at the stages; None: zero.
        scheme: the scheme.
        newton_tol: see `simulate`.

    Returns:
        A function of step [s] and number of steps; another number does not compile anew. Steps that fail are
        repeated in parts, as in `simulate`, without a limit.
    """
    begun: list[Callable[[Any, int], Endpoint]] = []

    def first(dt: Any, steps: Any, *numbers: Any) -> Endpoint:
        leaves, structure = jax.tree.flatten(numbers)
        kinds = tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)
        program = _program(structure, kinds, scheme, newton_tol)
        placed = jax.jit(in_one_array)(leaves)
        # Numbers of NumPy go in ten times as fast as arrays of JAX are made of them.
        begun.append(lambda dt, steps: program(placed, _number(dt, np.float64), _number(steps, np.int64)))
        return begun[0](dt, steps)

    def end(dt: Any, steps: int) -> Endpoint:
        if begun:
            return begun[0](dt, steps)
        numbers = system, scheme.started(state), Function.of(inputs, state.t)
        return with_callables((endpoints, scheme, newton_tol), partial(first, dt, steps), numbers)

    return end
