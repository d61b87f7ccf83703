"""Changes of values and gradients along directions, by differences.

Conditions of optimality are exact; what is differenced tells the way there, and each step takes some seven
digits off what is left of them. A program for derivatives of gradients is three times that of the gradients,
and as long to compile.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.phases import most_counted
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.transcription import Path, Unknowns, entering

ONE_SIDED = 1e-7
"""Relative size of a difference to one side, which is its error, too."""

Arrays = tuple[Array, ...]


class Point(NamedTuple):
    """What the gradients of a step are taken in: node before it as one vector, coefficients, unknowns."""

    node: Float[Array, "*k x"]
    w: Float[Array, "*k m"]
    y: Float[Array, "*k n"]


def sizes(problem: OptimalControl, path: Path, unknowns: Unknowns) -> Point:
    """Sizes of all that a step begins with, equal kinds together; 0 where nothing is known."""
    nodes, q = path.nodes, problem.state.q.size
    bounds = (0, q, 2 * q, 2 * q + most_counted(problem.systems), nodes.x.shape[1])
    pieces = [_largest(nodes.x[:, a:b]) for a, b in zip(bounds[:-1], bounds[1:])]
    others = [_largest(x) for x in jax.tree.leaves(nodes)[2:]]
    node = jnp.concatenate([*pieces, jnp.ones(nodes.free.shape[1]), *others])
    return Point(node, _largest(entering(problem, unknowns.coefficients)), _largest(unknowns.y))


def _largest(x: Array) -> Array:
    """The largest magnitude of all entries, once for every entry of a row."""
    return jnp.full(math.prod(x.shape[1:]), jnp.max(jnp.abs(x), initial=0.0))


def _ratio(direction: Arrays, sizes: Arrays) -> Array:
    """Size of a direction, relative to that of the point; where that vanishes, as it is; never zero."""
    pairs = [(jnp.abs(d), s) for d, s in zip(direction, sizes)]
    relative = [jnp.max(jnp.where(s > 0, d / jnp.where(s > 0, s, 1.0), 0.0), initial=0.0) for d, s in pairs]
    plain = jnp.max(jnp.stack([jnp.max(d, initial=0.0) for d, _ in pairs]))
    ratio = jnp.max(jnp.stack(relative))
    ratio = jnp.where(ratio > 0, ratio, plain)
    return jnp.where(ratio > 0, ratio, 1.0)


def columns(function: Callable[..., Any], point: Arrays, directions: Arrays, sizes: Arrays) -> Any:
    """Changes of a function along many directions, by differences to one side.

    Args:
        function: of arrays to vectors.
        point: these arrays.
        directions: along which, one a column.
        sizes: of their entries.

    Returns:
        What the vectors change by, one a column.
    """

    def there(*direction: Array) -> tuple[Any, Array]:
        step = ONE_SIDED / _ratio(direction, sizes)
        return function(*(x + step * d for x, d in zip(point, direction))), step

    # The point itself is a column like the others: so the function is compiled once.
    here = (jnp.pad(d, ((0, 0), (0, 1))) for d in directions)
    found, steps = jax.vmap(there, in_axes=1, out_axes=(1, 0))(*here)
    return jax.tree.map(lambda x: (x[:, :-1] - x[:, -1:]) / steps[:-1], found)
