"""Checks of numbers: concrete ones are refused, traced ones have no values yet and become not a number."""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.xla.tracing import at_top_level as at_top_level
from natcoord_jax.xla.tracing import is_concrete as is_concrete

NUMERIC = (int, float, np.ndarray, np.number, jax.Array)
"""Types of concrete numbers."""


def require_double(where: str) -> None:
    """Refuse single precision unasked: conservation and gradients need double.

    Raises:
        ValueError: with the line to add.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            f"{where}: natcoord_jax needs double precision, to build a scene and for all that follows. "
            'Add this line before building a scene: jax.config.update("jax_enable_x64", True)'
        )


def as_array(value: Any, dtype: Any = None) -> Array:
    """`jnp.asarray`, which compiles a program for every shape that it takes from NumPy; this does not."""
    if isinstance(value, jax.Array) and dtype in (None, float) and value.dtype == jnp.result_type(float):
        return value
    if at_top_level(value):
        known = np.asarray(value)
        if known.dtype.kind in "biuf":
            # A copy, because the array may share its memory.
            return jax.device_put(np.array(known, known.dtype if dtype is None else dtype))
    return jnp.asarray(value, dtype)


def shape_of(value: Any) -> tuple[int, ...] | None:
    """Shape of anything `jnp.asarray` takes; None for what is no array of numbers."""
    try:
        return as_array(value, float).shape
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
    return as_kind(value, Numbers(shape), what, unit)


def as_kind(value: Any, kind: Numbers, what: str, unit: str) -> Array:
    """Value as a float array of a kind; what is traced and none of it becomes not a number.

    Raises:
        ValueError: naming part, quantity, unit and remedy.
    """
    complaint = kind.complaint(value)
    if complaint is not None:
        raise ValueError(f"{what} [{unit}] {complaint}; pass {kind.wanted}")
    return kind.masked(as_array(value, float))


def check_fields(module: Any, label: str) -> None:
    """Refuse numbers of a module that are not finite; infinity passes where it is the field's default.

    Args:
        module: an effect; units are read from the list of attributes in its docstring.
        label: what it is, for the message.

    Raises:
        ValueError: naming part, quantity, unit and remedy.
    """
    for field in dataclasses.fields(module):
        leaves = [x for x in jax.tree.leaves(getattr(module, field.name)) if isinstance(x, NUMERIC)]
        values = [np.asarray(x, float) for x in leaves if is_concrete(x)]
        unbounded = isinstance(field.default, float) and np.isinf(field.default)
        fine = [~np.isnan(x) if unbounded else np.isfinite(x) for x in values]
        if not all(np.all(x) for x in fine):
            unit = re.search(rf"^\s*{field.name}:.*?(\[.+?\])", type(module).__doc__ or "", re.MULTILINE)
            what = f"{label}: {field.name}" + (f" {unit[1]}" if unit else "")
            raise ValueError(f"{what} is not finite: {getattr(module, field.name)}; pass finite numbers")


def equations(found: Any, part: Any, method: str) -> Any:
    """What a method of a part returns, if it is one number for each multiplier.

    Raises:
        ValueError: naming part, method, shape and remedy.
    """
    shape = jnp.shape(found)
    if shape != (part.multipliers,):
        count = int(np.prod(shape))
        remedy = f"; declare `multipliers = {count}`, the number of equations"
        if len(shape) != 1:
            remedy = "; make it an array of shape (multipliers,), of a single equation `value[None]`"
        raise ValueError(
            f"{type(part).__name__}.{method} has shape {shape}, and multipliers is {part.multipliers}{remedy}"
        )
    return found


def for_each(value: Any, count: int, what: str, each: str) -> Array:
    """A number, or one for each of some things, as numbers for all of them (count,).

    Raises:
        ValueError: for another number of them.
    """
    array = as_array(value, float)
    if array.shape not in ((), (count,)):
        one = f"a number, or one for each {each}: numbers of shape ({count},)"
        raise ValueError(f"{what} has shape {array.shape}; pass {one}")
    return jnp.broadcast_to(array, (count,))


def positive(value: Any, what: str, unit: str) -> Array:
    """Value as a positive finite scalar; one that is traced and is none becomes not a number.

    Raises:
        ValueError: naming part, quantity, unit and remedy.
    """
    return as_kind(value, Number("positive"), what, unit)
