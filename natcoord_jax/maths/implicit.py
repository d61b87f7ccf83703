"""Roots of equations as functions of the parameters: derivatives of every order by the implicit rule."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float

from natcoord_jax.maths.elimination import definite_solution


def implicit_root(
    residual: Callable[..., Array], search: Callable[..., Array], *parameters: Any
) -> Float[Array, "*n"]:
    """Root x of residual(x, *parameters), as `search(*parameters)` finds it.

    The rule x' = -(d residual / d x)^-1 (residual)' is applied to the root itself, so that derivatives of x'
    are exact again, in every mode. A step of Newton's method after the search is exact to first order only.

    Args:
        residual: function of the module level; as many components as x, with a quasi-definite Jacobian.
        search: function of the module level, never differentiated.
        parameters: pytrees.

    Returns:
        x, a scalar or a vector.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> from jax import numpy as jnp
        >>> from natcoord_jax.maths.implicit import implicit_root
        >>> root = lambda a: implicit_root(lambda x, a: x * x - a, jnp.sqrt, a)
        >>> print(jax.grad(root)(4.0), jax.grad(jax.grad(root))(4.0))
        0.25 -0.03125
    """
    arrays, static = eqx.partition(parameters, eqx.is_array)
    return _root(residual, search, static, arrays)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _root(residual: Callable, search: Callable, static: Any, arrays: Any) -> Array:
    return search(*eqx.combine(arrays, static))


@_root.defjvp
def _root_jvp(residual: Callable, search: Callable, static: Any, primals: tuple, tangents: tuple) -> tuple:
    def at(x: Array, arrays: Any) -> Array:
        return residual(x, *eqx.combine(arrays, static))

    x = _root(residual, search, static, *primals)
    missing = jax.jvp(lambda arrays: at(x, arrays), primals, tangents)[1]
    slope = jax.jacfwd(at)(x, *primals)
    return x, -(definite_solution(slope, missing) if x.ndim else missing / slope)
