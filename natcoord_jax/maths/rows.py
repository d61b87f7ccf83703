"""Single rows of arrays, read and changed in loops; unlike a scatter, this compiles in place."""

import jax
from jaxtyping import Array, Int, Shaped


def row(x: Shaped[Array, "n *rest"], index: Int[Array, ""]) -> Shaped[Array, "*rest"]:
    """One row of x."""
    return jax.lax.dynamic_index_in_dim(x, index, keepdims=False)


def with_row(
    x: Shaped[Array, "n *rest"], index: Int[Array, ""], value: Shaped[Array, "*rest"]
) -> Shaped[Array, "n *rest"]:
    """X with one row replaced."""
    return jax.lax.dynamic_update_index_in_dim(x, value, index, 0)


def add_at(
    x: Shaped[Array, "n *rest"], index: Int[Array, ""], change: Shaped[Array, "*rest"]
) -> Shaped[Array, "n *rest"]:
    """X with one row changed."""
    return with_row(x, index, row(x, index) + change)
