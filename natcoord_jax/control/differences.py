"""Changes of gradients along directions, by differences.

What they serve is improved until the exact conditions hold, which needs them to a few digits; and a program
for derivatives of gradients is three times that of the gradients, and as long to compile.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import Path, Unknowns, entering

CENTRAL = 1e-4
"""Relative size of a central difference; its square is the error, and rounding over it the noise."""
ONE_SIDED = 1e-7
"""Relative size of a difference to one side, which is its error, too."""


class Point(NamedTuple):
    """What the gradients of a step are taken in: node before it as one vector, coefficients, unknowns."""

    node: Float[Array, "*k x"]
    w: Float[Array, "*k m"]
    y: Float[Array, "*k n"]


def sizes(problem: OptimalControl, path: Path, unknowns: Unknowns) -> Point:
    """Sizes of all that a step begins with, equal kinds together; 0 where nothing is known."""
    nodes, q = path.nodes, problem.state.q.size
    bounds = (0, q, 2 * q, 2 * q + problem.state.coordinates.size, nodes.x.shape[1])
    pieces = [_largest(nodes.x[:, a:b]) for a, b in zip(bounds[:-1], bounds[1:])]
    others = [_largest(x) for x in jax.tree.leaves(nodes)[2:]]
    node = jnp.concatenate([*pieces, jnp.ones(nodes.free.shape[1]), *others])
    return Point(node, _largest(entering(problem, unknowns.coefficients)), _largest(unknowns.y))


def _largest(x: Array) -> Array:
    """The largest magnitude of all entries, once for every entry of a row."""
    return jnp.full(math.prod(x.shape[1:]), jnp.max(jnp.abs(x), initial=0.0))


def _ratio(direction: Point, sizes: Point) -> Array:
    """Size of a direction, relative to that of the point; where that vanishes, as it is; never zero."""
    pairs = [(jnp.abs(d), s) for d, s in zip(direction, sizes)]
    relative = [jnp.max(jnp.where(s > 0, d / jnp.where(s > 0, s, 1.0), 0.0), initial=0.0) for d, s in pairs]
    plain = jnp.max(jnp.stack([jnp.max(d, initial=0.0) for d, _ in pairs]))
    ratio = jnp.max(jnp.stack(relative))
    ratio = jnp.where(ratio > 0, ratio, plain)
    return jnp.where(ratio > 0, ratio, 1.0)


def columns(
    slopes: Callable[..., tuple[Array, ...]], point: Point, directions: Point, sizes: Point
) -> tuple[Array, ...]:
    """Changes of gradients along many directions, by differences to one side.

    Args:
        slopes: (node, w, y) -> gradients.
        point: where.
        directions: along which, one a column.
        sizes: see `sizes`.

    Returns:
        Gradients' changes, one a column.
    """

    def there(direction: Point) -> tuple[tuple[Array, ...], Array]:
        step = ONE_SIDED / _ratio(direction, sizes)
        return slopes(*(x + step * d for x, d in zip(point, direction))), step

    # The point itself is a column like the others: so gradients are compiled once.
    here = Point(*(jnp.pad(d, ((0, 0), (0, 1))) for d in directions))
    found, steps = jax.vmap(there, in_axes=1, out_axes=(1, 0))(here)
    return tuple((x[:, :-1] - x[:, -1:]) / steps[:-1] for x in found)


def along(
    slopes: Callable[..., tuple[Array, ...]],
    point: Point,
    direction: Point,
    sizes: Point,
    linear: tuple[Array, Array],
) -> tuple[Array, ...]:
    """Changes of gradients along one direction, by a central difference.

    Args:
        slopes: (node, w, y, more) -> gradients.
        point: where.
        direction: along which.
        sizes: see `sizes`.
        linear: what the gradients are linear in, and its change.
    """
    step = CENTRAL / _ratio(direction, sizes)

    def there(sign: Array) -> tuple[Array, ...]:
        moved = [x + sign * step * d for x, d in zip(point, direction)]
        return slopes(*moved, linear[0] + sign * step * linear[1])

    both = jax.vmap(there)(jnp.array([1.0, -1.0]))
    return tuple((x[0] - x[1]) / (2.0 * step) for x in both)
