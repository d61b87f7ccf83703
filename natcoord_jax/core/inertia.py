"""Inertias that a body can have: others are refused, and those that are traced become not a number."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete, numbers, shape_of
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.numeric import ROUNDING, masked

PRINTED = 5e-3
"""By how much a principal inertia may exceed the sum of the other two, relative to the largest second moment:
three printed digits, as of a plate with (0.00333, 0.00333, 0.00667) kg m^2. It is taken as it is given."""


@eager_numpy
def diagonal(values: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Diagonal matrices."""
    return values[..., None] * jnp.eye(3)


@eager_numpy
def to_second_moment(inertia: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """E = tr(J)/2 1 - J, about the same point as the inertia tensor J [kg m^2]."""
    return 0.5 * jnp.trace(inertia) * jnp.eye(3) - inertia


def is_even(matrix: Any) -> Any:
    """Whether matrices are symmetric, up to round-off."""
    gap = abs(matrix - matrix.swapaxes(-1, -2)).max((-1, -2))
    return gap <= ROUNDING * abs(matrix).max((-1, -2))


def tensor(value: Any, what: str) -> Float[Array, "3 3"]:
    """A symmetric matrix, or the diagonal of one [kg m^2].

    Raises:
        ValueError: for something else.
    """
    if shape_of(value) == (3,):
        return diagonal(numbers(value, (3,), what, "kg m^2"))
    return even(numbers(value, (3, 3), what, "kg m^2"), f"{what} [kg m^2]")


def even(matrix: Array, what: str) -> Array:
    """A matrix that is symmetric up to round-off.

    Raises:
        ValueError: for another one.
    """
    if is_concrete(matrix) and not is_even(np.asarray(matrix)):
        gap = float(np.max(np.abs(np.asarray(matrix) - np.asarray(matrix).T)))
        raise ValueError(f"{what} is not symmetric (by {gap:.2e}); pass a symmetric matrix")
    return masked(matrix, is_even)


def possible(moment: Any, central: Any, about: Any, label: str, given: str) -> Any:
    """What a body has a second moment of, if it has: only if the central one is positive semidefinite.

    Args:
        moment: what to return; traced, not a number where there is no such body.
        central: second moment about the centre of mass.
        about: the same about the point that the data refers to, which says how large rounding may be.
        label: the part, for the message.
        given: "second_moment", or what an inertia was given in, whose rounding is that of print: "inertia",
            or "mass_block", which may be that of a point.

    Raises:
        ValueError: for one of no body, with the nearest possible one.
    """
    concrete = is_concrete(central, about)
    xp: Any = np if concrete else jnp
    values, axes = xp.linalg.eigh(xp.asarray(central))
    size = xp.maximum(xp.maximum(values[2], xp.linalg.eigvalsh(xp.asarray(about))[2]), 0.0)
    # An inertia about a principal axis is the sum of the other two second moments.
    least, printed = (values[0], ROUNDING) if given == "second_moment" else (values[0] + values[1], PRINTED)
    good = (values[0] >= -printed * size) & (least >= -ROUNDING * size)
    good = good & (values[2] >= 0 if given == "mass_block" else values[2] > 0)
    if not concrete:
        return masked(moment, lambda x: good)
    if good:
        return moment
    nearest = ""
    if values[2] > 0:
        closest = (axes * np.maximum(values, 0.0)) @ axes.T
        closest = np.trace(closest) * np.eye(3) - closest if given == "inertia" else closest
        uncoupled = np.max(np.abs(closest - np.diag(np.diag(closest)))) <= 1e-12 * np.max(np.abs(closest))
        shown = np.array2string(np.diag(closest) if uncoupled else closest, separator=", ", precision=6)
        shown = shown.replace("\n", "")
        nearest = f"; the nearest possible {given} about the centre of mass is {shown} kg m^2"
    raise ValueError(
        f"{label}: {given} belongs to no body: the principal second moments about the centre of mass "
        f"would be {values} kg m^2, and none may be negative (a principal inertia may not exceed the sum "
        f"of the other two, up to the rounding of three printed digits, {PRINTED:g}); check units, "
        'and whether the inertia is about the centre of mass (inertia_at="com") or the reference point '
        f'(inertia_at="reference"){nearest}'
    )
