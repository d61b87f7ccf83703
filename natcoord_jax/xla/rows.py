"""Single rows of arrays, read and changed in loops; unlike a scatter, this compiles in place.

Indices are never negative: to allow for it would take three operations more for each.
"""

import jax
from jaxtyping import Array, Int, Shaped


def row(x: Shaped[Array, "*shape"], index: int | Int[Array, ""], axis: int = 0) -> Shaped[Array, "*rest"]:
    """One row of x."""
    return jax.lax.dynamic_index_in_dim(x, index, axis, keepdims=False, allow_negative_indices=False)


def part(
    x: Shaped[Array, "*shape"], start: int | Int[Array, ""], size: int, axis: int = 0
) -> Shaped[Array, "*rest"]:
    """Several rows of x, one after the other."""
    return jax.lax.dynamic_slice_in_dim(x, start, size, axis, allow_negative_indices=False)


def with_row(
    x: Shaped[Array, "n *rest"], index: int | Int[Array, ""], value: Shaped[Array, "*rest"]
) -> Shaped[Array, "n *rest"]:
    """X with one row replaced."""
    return with_part(x, index, value[None])


def with_part(
    x: Shaped[Array, "*shape"], start: int | Int[Array, ""], values: Shaped[Array, "*part"], axis: int = 0
) -> Shaped[Array, "*shape"]:
    """X with several rows replaced."""
    return jax.lax.dynamic_update_slice_in_dim(x, values, start, axis, allow_negative_indices=False)


def add_at(
    x: Shaped[Array, "n *rest"], index: int | Int[Array, ""], change: Shaped[Array, "*rest"]
) -> Shaped[Array, "n *rest"]:
    """X with one row changed."""
    return with_row(x, index, row(x, index) + change)
