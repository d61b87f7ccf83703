"""Products and norms of 3-vectors that stay finite under every derivative."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def cross(a: Float[Array, "*batch 3"], b: Float[Array, "*other 3"]) -> Float[Array, "*out 3"]:
    """Cross product over the last axis, with broadcasting.

    Written out in components: it fuses with its neighbours, which `jnp.cross` does not. Components come from
    `unstack`, whose transpose puts them together at once; those of slices would be padded and added up.
    """
    a0, a1, a2 = jnp.unstack(a, axis=-1)
    b0, b1, b2 = jnp.unstack(b, axis=-1)
    return jnp.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def dot(a: Float[Array, "*batch k"], b: Float[Array, "*other k"]) -> Float[Array, "*out"]:
    """Scalar product over the last axis, with broadcasting."""
    return jnp.sum(a * b, axis=-1)


def applied(matrix: Float[Array, "*#n r c"], vector: Float[Array, "*#n 1 c"]) -> Float[Array, "*n r"]:
    """Products of matrices and vectors, as sums: cheaper than calls for small sizes."""
    return jnp.sum(matrix * vector, axis=-1)


def product(a: Float[Array, "*#n r k"], b: Float[Array, "*#n k c"]) -> Float[Array, "*n r c"]:
    """Products of matrices, as sums, which fuse with their neighbours."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def skew(a: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Matrix of the map b -> a x b."""
    a0, a1, a2 = jnp.unstack(a, axis=-1)
    zero = jnp.zeros_like(a0)
    rows = [
        jnp.stack([zero, -a2, a1], axis=-1),
        jnp.stack([a2, zero, -a0], axis=-1),
        jnp.stack([-a1, a0, zero], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root whose value and derivatives are zero where x <= 0."""
    # (Asked so that not a number stays one, as below.)
    none = x <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, x)))


def positive_part(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The number where it is positive, else zero; at zero its derivative is that of smaller ones, zero.

    `jnp.maximum` halves it, so that the second derivative of the square at zero is a quarter.
    """
    return jnp.where(x <= 0, 0.0, x)


def largest(x: Float[Array, "k *rest"]) -> Float[Array, "*rest"]:
    """Largest number along the first axis, of at least one.

    Its derivative is that of one of the numbers, also where equal ones are computed twice. `jnp.max` looks
    for those that equal the largest; a compiler that rounds the same product in two ways, once with a fused
    multiply-add, lets it find none, and divide zero by zero.
    """
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        one, other = x[:half], x[half : 2 * half]
        x = jnp.concatenate([jnp.where(one > other, one, other), x[2 * half :]])
    return x[0]


def _scaled(a: Float[Array, "*batch k"]) -> tuple[Float[Array, "*batch k"], Float[Array, "*batch"]]:
    """Vectors over their largest components, and those, of which no derivatives are taken."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(a), axis=-1, initial=0.0))
    size = jnp.where((size > 0) & jnp.isfinite(size), size, 1.0)
    return a / size[..., None], size


def safe_norm(a: Float[Array, "*batch k"]) -> Float[Array, "*batch"]:
    """Euclidean norm over the last axis; its derivative at the origin is zero, not NaN.

    The largest component is taken out before the squares: they neither underflow nor overflow.
    """
    scaled, size = _scaled(a)
    return size * safe_sqrt(jnp.sum(scaled * scaled, axis=-1))


def unit(a: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
    """Unit vectors along vectors of any length but zero, over the last axis."""
    scaled, _ = _scaled(a)
    return scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))


@jax.custom_jvp
def quotient(a: Float[Array, "*shape"], b: Float[Array, "*other"]) -> Float[Array, "*out"]:
    """Quotient a / b whose derivatives do not square b, which may be as small as 1e-300."""
    return a / b


@quotient.defjvp
def _quotient_jvp(primals: tuple, tangents: tuple) -> tuple:
    (_, b), (da, db) = primals, tangents
    found = quotient(*primals)
    # Times the reciprocal: a division would be transposed to one whose derivatives square b again.
    return found, (da - found * db) * _reciprocal(b)


@jax.custom_jvp
def _reciprocal(b: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return 1.0 / b


@_reciprocal.defjvp
def _reciprocal_jvp(primals: tuple, tangents: tuple) -> tuple:
    found = _reciprocal(*primals)
    return found, -(found * tangents[0]) * found


def safe_divide(a: Float[Array, "*shape"], b: Float[Array, "*other"]) -> Float[Array, "*out"]:
    """Quotient a / b, zero (with zero derivatives) where b == 0."""
    zero = b == 0
    return jnp.where(zero, 0.0, quotient(a, jnp.where(zero, 1.0, b)))
