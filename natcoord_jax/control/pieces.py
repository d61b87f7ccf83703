"""Cost and constraints as sums of pieces that each see a few unknowns: derivatives with their structure.

What repeats, as the steps of a motion do, is one function of a short vector, evaluated for all its places
at once; derivatives are taken of it, along as few directions as its structure allows, and put where they
belong. So time and memory go with the number of pieces.

Sources: A. Griewank, Ph. L. Toint, in M. J. D. Powell (ed.), Nonlinear Optimization 1981 (1982), 301-312
(partial separability); A. R. Curtis, M. J. D. Powell, J. K. Reid, J. Inst. Maths Applics 13 (1974) 117-119
(columns taken together).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.dependence import derivative_pattern
from natcoord_jax.control.quadratic import some_together
from natcoord_jax.core.compiled import compiled

FULL = 4
"""Rows with so many times the mean number of entries are taken by themselves, each by one sweep back."""

Function = Callable[[Any, Any, Array], tuple[Array, Array]]


class Places(NamedTuple):
    """Where the pieces of one kind are.

    Attributes:
        given: what each is given besides unknowns, leading axis k.
        reads: its unknowns, by number; the number of unknowns itself stands for a zero.
        writes: its constraints, by number.
    """

    given: Any
    reads: Int[np.ndarray, "k z"]
    writes: Int[np.ndarray, "k c"]


class Recovery(NamedTuple):
    """How the entries of a sparse matrix are found from products with it.

    Attributes:
        along: directions whose products are needed (d, z).
        across: of rows that are taken by themselves, which (r, c); none for a Hessian.
        take: places of the entries in all products, one after the other, of one piece.
        keep: which of the entries of all pieces are entries of the whole.
        into: where they are added.
    """

    along: Float[np.ndarray, "d z"]
    across: Float[np.ndarray, "r c"]
    take: Int[np.ndarray, " e"]
    keep: Int[np.ndarray, " all"]
    into: Int[np.ndarray, " all"]


class Entries(NamedTuple):
    """Structure of a matrix: its entries in coordinates, and how the pieces find them."""

    rows: Int[np.ndarray, " nonzeros"]
    columns: Int[np.ndarray, " nonzeros"]
    recoveries: tuple[Recovery, ...]


class Sum(eqx.Module):
    """A sum of pieces: their functions, their places, and the structure of the derivatives.

    Attributes:
        functions: of what all pieces share, what one is given and its unknowns, to its cost and constraints.
        places: of the pieces of each function.
        size: number of unknowns.
        jacobian: of the constraints.
        hessian: lower triangle of that of the Lagrangian.
    """

    functions: tuple[Function, ...] = eqx.field(static=True)
    places: tuple[Places, ...]
    size: int = eqx.field(static=True)
    jacobian: Entries
    hessian: Entries


def sum_of(functions: tuple[Function, ...], places: tuple[Places, ...], size: int, shared: Any) -> Sum:
    """The sum of pieces with its structure, found from the programs of their derivatives.

    Args:
        functions: see `Sum`.
        places: of the pieces.
        size: number of unknowns.
        shared: what all pieces share; its numbers may be any.
    """
    first, second = [], []
    for function, at in zip(functions, places):
        example = jax.tree.map(lambda x: x[0], at.given)
        z, multipliers = jnp.zeros(at.reads.shape[1]), jnp.zeros(at.writes.shape[1])

        def constraints(others: Any, z: Array, function: Function = function) -> Array:
            shared, given = others
            return function(shared, given, z)[1]

        def slope(others: Any, z: Array, function: Function = function) -> Array:
            shared, given, weight, multipliers = others
            return _slope(function, shared, given, weight, multipliers, z)

        first.append(_jacobian_of(derivative_pattern(constraints, (shared, example), z), at, size))
        others = (shared, example, jnp.ones(()), multipliers)
        second.append(_hessian_of(derivative_pattern(slope, others, z), at, size))
    return Sum(functions, places, size, _merged(first), _merged(second))


def _slope(function: Function, shared: Any, given: Any, weight: Array, multipliers: Array, z: Array) -> Array:
    """Gradient of the Lagrangian of one piece."""

    def lagrangian(z: Array) -> Array:
        cost, constraints = function(shared, given, z)
        return weight * cost + multipliers @ constraints

    return jax.grad(lagrangian)(z)


def _colours(pattern: Bool[np.ndarray, "c z"], columns: Any) -> Int[np.ndarray, " z"]:
    """Numbers of groups of columns that share no row, -1 for columns that are not asked for."""
    found, used = np.full(pattern.shape[1], -1), list[np.ndarray]()
    for k in sorted(columns, key=lambda k: -int(pattern[:, k].sum())):
        group = next((n for n, rows in enumerate(used) if not np.any(rows & pattern[:, k])), len(used))
        if group == len(used):
            used.append(np.zeros(pattern.shape[0], bool))
        used[group] |= pattern[:, k]
        found[k] = group
    return found


def _directions(colours: Int[np.ndarray, " z"]) -> Float[np.ndarray, "d z"]:
    return (colours == np.arange(colours.max(initial=-1) + 1)[:, None]).astype(float)


def _jacobian_of(pattern: Bool[np.ndarray, "c z"], at: Places, size: int) -> tuple[Recovery, Any]:
    """Rows that are full by themselves, all others by groups of columns."""
    counts = pattern.sum(axis=1)
    full = counts > FULL * max(1.0, float(np.mean(counts)))
    rows, columns = np.nonzero(pattern)
    sparse = pattern & ~full[:, None]
    colours = _colours(sparse, np.flatnonzero(sparse.any(axis=0)))
    along, across = _directions(colours), np.eye(pattern.shape[0])[full]
    order = np.cumsum(full) - 1
    by_row = along.shape[0] * pattern.shape[0] + order[rows] * pattern.shape[1] + columns
    take = np.where(full[rows], by_row, colours[columns] * pattern.shape[0] + rows)
    keep = np.flatnonzero(at.reads[:, columns] < size)
    there = at.writes[:, rows].ravel()[keep], at.reads[:, columns].ravel()[keep]
    return Recovery(along, across, take, keep, keep), there


def _hessian_of(pattern: Bool[np.ndarray, "z z"], at: Places, size: int) -> tuple[Recovery, Any]:
    """Columns whose entries, and by symmetry rows, hold all others; groups of them."""
    pattern = pattern | pattern.T
    rest = list[int]()
    for k in np.argsort(pattern.sum(axis=0), kind="stable"):
        if not pattern[k, k] and not np.any(pattern[k, rest]):
            rest.append(int(k))
    needed = np.setdiff1d(np.flatnonzero(pattern.any(axis=0)), rest)
    colours = _colours(pattern, needed)
    rows, columns = np.nonzero(np.tril(pattern))
    swapped = colours[columns] < 0
    inner, outer = np.where(swapped, columns, rows), np.where(swapped, rows, columns)
    take = colours[outer] * pattern.shape[0] + inner
    a, b = at.reads[:, rows].ravel(), at.reads[:, columns].ravel()
    keep = np.flatnonzero((a < size) & (b < size))
    none = np.zeros((0, at.writes.shape[1]))
    there = np.maximum(a, b)[keep], np.minimum(a, b)[keep]
    return Recovery(_directions(colours), none, take, keep, keep), there


def _merged(parts: list[tuple[Recovery, Any]]) -> Entries:
    """All entries in coordinates, row by row, those of several pieces once."""
    where = np.concatenate([np.stack(there) for _, there in parts], axis=1)
    places, into = np.unique(where, axis=1, return_inverse=True)
    pieces = np.split(into.ravel(), np.cumsum([there[0].size for _, there in parts])[:-1])
    recoveries = tuple(recovery._replace(into=x) for (recovery, _), x in zip(parts, pieces))
    return Entries(places[0], places[1], recoveries)


def _each(function: Callable, at: Places, x: Array, *others: Array) -> Any:
    """A function of what each piece is given, its unknowns and its part of others, for all of them."""
    z = jnp.append(x, 0.0)[at.reads]
    given = (at.given, z, *(other[at.writes] for other in others))
    return some_together(lambda one: function(*one), given, at.reads.shape[0])


@compiled
def values(
    whole: Sum, shared: Any, x: Float[Array, " n"], weights: Float[Array, " c"]
) -> tuple[Array, Array]:
    """Cost and constraints, these times their weights."""
    cost, constraints = jnp.zeros(()), jnp.zeros_like(weights)
    for function, at in zip(whole.functions, whole.places):
        costs, found = _each(lambda given, z, f=function: f(shared, given, z), at, x)
        cost, constraints = cost + jnp.sum(costs), constraints.at[at.writes].set(found)
    return cost, weights * constraints


@compiled
def first_derivatives(
    whole: Sum, shared: Any, x: Float[Array, " n"], weights: Float[Array, " c"]
) -> tuple[Float[Array, " n"], Float[Array, " nonzeros"]]:
    """Gradient of the cost, and the entries of the Jacobian."""
    gradient, entries = jnp.zeros(whole.size + 1), jnp.zeros(whole.jacobian.rows.size)
    for function, at, recovery in zip(whole.functions, whole.places, whole.jacobian.recoveries):

        def one(given: Any, z: Array, scale: Array, function=function, recovery=recovery) -> tuple:
            def both(z: Array) -> tuple[Array, Array]:
                return function(shared, given, z)

            by_cost, by_row = _pulled(both, z, jnp.asarray(recovery.across) * scale)
            by_column = jax.vmap(lambda d: jax.jvp(lambda z: both(z)[1], (z,), (d,))[1])(
                jnp.asarray(recovery.along)
            )
            products = jnp.concatenate([(by_column * scale).ravel(), by_row.ravel()])
            return by_cost, products[recovery.take]

        slopes, found = _each(one, at, x, weights)
        gradient = gradient.at[at.reads].add(slopes)
        entries = entries.at[recovery.into].add(found.ravel()[recovery.keep])
    return gradient[:-1], entries


def _pulled(both: Callable, z: Array, across: Array) -> tuple[Array, Array]:
    """Gradient of the cost, and rows of the Jacobian."""
    cost, constraints = jax.eval_shape(both, z)
    pull = jax.vjp(both, z)[1]
    nothing = jnp.zeros(constraints.shape, z.dtype)
    rows = jax.vmap(lambda row: pull((jnp.zeros((), z.dtype), row))[0])(across)
    return pull((jnp.ones(cost.shape, z.dtype), nothing))[0], rows


@compiled
def second_derivatives(
    whole: Sum,
    shared: Any,
    x: Float[Array, " n"],
    weights: Float[Array, " c"],
    weight: Float[Array, ""],
    multipliers: Float[Array, " c"],
) -> Float[Array, " nonzeros"]:
    """Entries of the lower triangle of the Hessian of weight cost + multipliers constraints."""
    entries = jnp.zeros(whole.hessian.rows.size)
    for function, at, recovery in zip(whole.functions, whole.places, whole.hessian.recoveries):

        def one(given: Any, z: Array, own: Array, function=function, recovery=recovery) -> Array:
            def slope(z: Array) -> Array:
                return _slope(function, shared, given, weight, own, z)

            products = jax.vmap(lambda d: jax.jvp(slope, (z,), (d,))[1])(jnp.asarray(recovery.along))
            return products.ravel()[recovery.take]

        found = _each(one, at, x, weights * multipliers)
        entries = entries.at[recovery.into].add(found.ravel()[recovery.keep])
    return entries
