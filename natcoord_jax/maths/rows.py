"""Single rows of arrays, read and changed in loops; unlike a scatter, this compiles in place."""

import jax
from jaxtyping import Array, Float, Int


def row(x: Float[Array, "n *rest"], index: Int[Array, ""]) -> Float[Array, "*rest"]:
    """One row of x."""
    return jax.lax.dynamic_index_in_dim(x, index, keepdims=False)


def with_row(
    x: Float[Array, "n *rest"], index: Int[Array, ""], value: Float[Array, "*rest"]
) -> Float[Array, "n *rest"]:
    """x with one row replaced."""
    return jax.lax.dynamic_update_index_in_dim(x, value, index, 0)


def add_at(
    x: Float[Array, "n *rest"], index: Int[Array, ""], change: Float[Array, "*rest"]
) -> Float[Array, "n *rest"]:
    """x with one row changed."""
    return with_row(x, index, row(x, index) + change)
