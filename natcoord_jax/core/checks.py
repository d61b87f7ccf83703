"""Checks of concrete numbers; traced ones pass, because they have no values yet."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def is_concrete(*values: Any) -> bool:
    """Whether none of the values is being traced."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def require_double(where: str) -> None:
    """Refuse single precision unasked: conservation and gradients need double.

    Raises:
        ValueError: with the line to add.
    """
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(
            f"{where}: natcoord_jax needs double precision. Add this line before building a scene: "
            'jax.config.update("jax_enable_x64", True)'
        )


def shape_of(value: Any) -> tuple[int, ...] | None:
    """Shape of anything `jnp.asarray` takes; None for what is no array of numbers."""
    try:
        return jnp.asarray(value, float).shape
    except (TypeError, ValueError):
        return None


def numbers(value: Any, shape: tuple[int, ...], what: str, unit: str) -> Array:
    """Value as a float array of the given shape, finite if concrete.

    Args:
        value: anything `jnp.asarray` takes.
        shape: the shape it must have.
        what: part and quantity, for the message.
        unit: its unit, for the message.

    Raises:
        ValueError: naming part, quantity, unit and remedy.
    """
    try:
        array = jnp.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} [{unit}] must be numbers of shape {shape}, not {value!r}") from error
    if array.shape != shape:
        raise ValueError(f"{what} [{unit}] has shape {array.shape}; pass shape {shape}")
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError(f"{what} [{unit}] is not finite: {np.asarray(array)}; pass finite numbers")
    return array


def positive(value: Any, what: str, unit: str) -> Array:
    """Value as a positive finite scalar.

    Raises:
        ValueError: naming part, quantity, unit and remedy.
    """
    array = numbers(value, (), what, unit)
    if is_concrete(array) and not float(array) > 0:
        raise ValueError(f"{what} [{unit}] is {float(array):g}; pass a positive number")
    return array
