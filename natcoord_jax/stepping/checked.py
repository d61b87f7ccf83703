"""What is given to a rollout, looked at before anything is compiled."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import System
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.state import State


def checked_step(dt: Any) -> Float[Array, ""]:
    """The step [s] as an array.

    Raises:
        ValueError: unless it is one positive number.
    """
    step = jnp.asarray(dt, float)
    if step.shape != ():
        raise ValueError(f"dt [s] must be a scalar, not of shape {step.shape}; use jax.vmap for several")
    if is_concrete(step) and not (np.isfinite(float(step)) and float(step) > 0):
        raise ValueError(f"dt [s] is {float(step)}; pass a positive finite step")
    return step


def checked_inputs(system: System, inputs: Any, steps: int | None, stages: int = 1) -> tuple[Any, int]:
    """Inputs as an array (steps, [stages,] inputs) or a callable, and the number of steps.

    Raises:
        ValueError: for a shape that does not fit, or numbers that are not finite.
    """
    names = system.structure.inputs
    if steps is not None and (not isinstance(steps, int | np.integer) or steps < 1):
        raise ValueError(f"steps is {steps!r}; pass a positive integer")
    if callable(inputs):
        if steps is None:
            raise ValueError("pass steps when inputs is a function of (t, state)")
        return inputs, int(steps)
    if inputs is None:
        if steps is None:
            raise ValueError("pass steps, or inputs of shape (steps, inputs)")
        return jnp.zeros((steps, len(names))), int(steps)
    array = jnp.asarray(inputs, float)
    if array.shape == (len(names),) and steps is not None:
        array = jnp.broadcast_to(array, (steps, len(names)))
    counted = array.shape[0] if array.ndim else 0
    shapes = (len(names),), (stages, len(names))
    if array.shape[1:] not in shapes or counted != (steps or counted) or counted == 0:
        first = steps if steps is not None else "steps"
        wanted = f"({first}, {len(names)})" + f" or ({first}, {stages}, {len(names)})" * (stages > 1)
        raise ValueError(
            f"inputs has shape {array.shape}; this system has the input channels {list(names)}: pass shape "
            f"{wanted}, or a function (t, state) -> ({len(names)},)"
        )
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError("inputs has numbers that are not finite; pass finite forces [N] and torques [N m]")
    return array, int(array.shape[0])


def check_state(system: System, state: State) -> None:
    """Look whether a state belongs to a system.

    Raises:
        ValueError: if its shape or the precision of its numbers says that it does not.
    """
    expected = 4 * len(system.structure.bodies)
    if state.q.shape != (expected, 3) or state.v.shape != (expected, 3):
        raise ValueError(
            f"state.q has shape {state.q.shape}, state.v {state.v.shape}; this system has shape "
            f"({expected}, 3); use the state that `compile` returned with the system, jax.vmap for several"
        )
    single = {str(x.dtype) for x in (system.mass, state.q, state.v) if x.dtype != jnp.float64}
    if single:
        raise ValueError(
            f"system or state has numbers of type {', '.join(sorted(single))}; natcoord_jax needs double "
            "precision: use the system and state that `compile` returned, and cast results instead"
        )
