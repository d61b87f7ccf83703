"""Generalised conjugate residuals: solutions with an operator near the identity that is only applied.

An approximate inverse is part of the operator. Every direction is the last residual, made such that its image
is orthogonal to those before: the residual is the smallest in their span, as in GMRES, and no small matrix
has to be decomposed. See
S. C. Eisenstat, H. C. Elman, M. H. Schultz, Variational iterative methods for nonsymmetric systems of linear
equations, SIAM J. Numer. Anal. 20 (1983).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

LEAST_GAIN = 0.9
"""A direction that leaves more of the residual ends the iteration."""


class Reached(eqx.Module):
    """Where the iteration has ended.

    Attributes:
        solution: as `apply` takes it.
        more: what `apply` returned beside its image, for the solution.
        found: the same of what was seen first.
        left: norm of the residual over that of the first.
        there: whether no more is left than is enough.
        count: directions.
    """

    solution: Any
    more: Any
    found: Any
    left: Float[Array, ""]
    there: Bool[Array, ""]
    count: Int[Array, ""]


def conjugate_residuals(
    apply: Callable[[Any, Array, Any], tuple[Any, Any]],
    seen: Any,
    look: Bool[Array, ""],
    start: Any,
    more: Any,
    weights: Any,
    enough: Callable[[Any], Array],
    limit: int,
) -> Reached:
    """Make an affine function vanish.

    Args:
        apply: (x, level, found) -> (image like x, more), linear in x where the level is 0, and affine where
            it is 1. Found is what it returned beside the image of `seen`: what is solved may depend on it.
        seen: x whose image is found before all others.
        look: whether it is; else found is zero.
        start: x to begin with.
        more: what `apply` returns beside the image; only its structure and shapes count.
        weights: of the squares of the entries of x; 0 leaves them out of norms.
        enough: part of the first residual's norm that may be left, from that residual.
        limit: most directions.
    """
    heavy = ravel_pytree(weights)[0]
    count, dtype = heavy.shape[0], heavy.dtype
    unflat = ravel_pytree(weights)[1]
    begin, unpack = ravel_pytree((start, more))
    beside, unpack_beside = ravel_pytree(more)

    def going(carry: tuple) -> Array:
        k, _, _, _, _, _, left, before, target, _ = carry
        return (k <= 1) | ((k <= limit) & (left > target) & (left < LEAST_GAIN * before) & jnp.isfinite(left))

    def body(carry: tuple) -> tuple:
        # The first two turns find the image of what is seen and the first residual, by the same program.
        k, x, r, directions, images, whole, left, _, target, found = carry
        z = jax.tree.map(lambda z, x, y: jnp.where(k > 0, z, jnp.where(k == 0, x, y)), unflat(r), start, seen)
        image, more = apply(z, (k == 0).astype(dtype), unpack_beside(found))
        w, d = ravel_pytree(image)[0], ravel_pytree((z, more))[0]
        found = jnp.where(k < 0, ravel_pytree(more)[0], found)
        along = images @ (heavy * w)
        w1, d1 = w - along @ images, d - along @ directions
        size = jnp.sqrt(jnp.sum(heavy * w1**2))
        usable = (k > 0) & (size > 0) & jnp.isfinite(size)
        scale = jnp.where(usable, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)
        w1, d1 = (jnp.where(usable, scale * y, 0.0) for y in (w1, d1))
        step = jnp.sum(heavy * w1 * r)
        x = jnp.where(k > 0, x + step * d1, d)
        r = jnp.where(k > 0, r - step * w1, -w)
        directions, images = directions.at[k - 1].set(d1), images.at[k - 1].set(w1)
        norm = jnp.sqrt(jnp.sum(heavy * r**2))
        whole = jnp.where(k > 0, whole, norm)
        target = jnp.where(k == 1, enough(z), target)
        now = norm / jnp.where(whole > 0, whole, 1.0)
        return k + 1, x, r, directions, images, whole, now, jnp.where(k > 0, left, jnp.inf), target, found

    nothing, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    begun = (
        jnp.where(look, -1, 0),
        begin,
        jnp.zeros(count, dtype),
        jnp.zeros((limit, begin.shape[0]), dtype),
        jnp.zeros((limit, count), dtype),
        one,
        one,
        one,
        nothing,
        jnp.zeros_like(beside),
    )
    k, x, _, _, _, _, left, _, target, found = jax.lax.while_loop(going, body, begun)
    solution, more = unpack(x)
    return Reached(solution, more, unpack_beside(found), left, left <= target, k - 1)
