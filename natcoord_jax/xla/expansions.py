"""Products, reductions and scatters as operations that the compiler does not hand to a library."""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.xla.rows import part, row

PRODUCT_LIMIT = 1 << 15
"""Multiplications up to which a product of matrices is written as a sum."""

SUMMED = 12
"""Terms of the sums of a product up to which it is written as one."""

PIECE = 8
"""Terms of longer ones that are summed at a time."""

LONG = 24
"""Terms of the sums of a product with a vector from which on the same is done: short ones fuse with what they
are made of."""

TERMS = 6
"""The same of products too large for that, whose terms are added one by one."""

FEW = 64
"""Length of an axis of a reduction up to which it is taken apart: programs should not grow with the number of
bodies."""

WINDOW = 32
"""Length of an axis beyond which the compiler takes a reduction apart itself, into parts that do not fuse."""

REDUCTION_LIMIT = 3000
"""Numbers from which on the compiler hands a reduction to a library (seen: 4096)."""

UNROLLED = 4
"""Windows of a scatter to known places up to which it is no loop."""

REDUCTIONS = {
    "reduce_sum": jnp.add,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": jnp.logical_and,
    "reduce_or": jnp.logical_or,
}
"""Reductions that are written as loops where they are long, and in pieces where an axis is."""


def written_out(equation: Any, given: list[Any]) -> Array | None:
    """The output of a product, a reduction or a scatter by other operations; None: it stays as it is."""
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        return _product(given, params, equation.outvars[0].aval)
    if name in ("scatter", "scatter-add"):
        return _updates(name, given, params)
    if name in REDUCTIONS:
        x, axes = given[0], params["axes"]
        if math.prod(x.shape) >= REDUCTION_LIMIT:
            return _loops(REDUCTIONS[name], x, axes)
        if WINDOW < max((x.shape[axis] for axis in axes), default=0) <= FEW:
            return _pieces(equation, x, WINDOW)
    return None


def _product(given: list[Any], params: dict[str, Any], out: Any) -> Array | None:
    """A small product of arrays as a sum; None for a large one."""
    left, right = given
    (sum_left, sum_right), (batch_left, batch_right) = params["dimension_numbers"]
    terms = math.prod(out.shape) * math.prod(left.shape[k] for k in sum_left)
    if terms > PRODUCT_LIMIT or left.dtype != out.dtype or right.dtype != out.dtype:
        return None
    free_left = [k for k in range(left.ndim) if k not in (*sum_left, *batch_left)]
    free_right = [k for k in range(right.ndim) if k not in (*sum_right, *batch_right)]
    shared, summed = len(batch_left), len(sum_left)
    rows, columns, length = (
        math.prod(x.shape[k] for k in axes)
        for x, axes in ((left, free_left), (right, free_right), (left, sum_left))
    )
    if min(rows, columns) > 1 and (length > SUMMED or terms >= REDUCTION_LIMIT):
        left = jnp.transpose(left, (*sum_left, *batch_left, *free_left)).reshape(length, -1, rows)
        right = jnp.transpose(right, (*sum_right, *batch_right, *free_right)).reshape(length, -1, columns)
        return _piece_by_piece(left, right).reshape(out.shape)
    left = jnp.transpose(left, (*batch_left, *free_left, *sum_left))
    right = jnp.transpose(right, (*batch_right, *free_right, *sum_right))
    left = jnp.expand_dims(left, range(shared + len(free_left), shared + len(free_left) + len(free_right)))
    right = jnp.expand_dims(right, range(shared, shared + len(free_left)))
    axes = tuple(range(left.ndim - summed, left.ndim))
    if terms >= REDUCTION_LIMIT:
        return _loops(jnp.add, left * right, axes)
    if summed == 1 and LONG < length <= FEW:
        pieces = [slice(k, k + PIECE) for k in range(0, length, PIECE)]
        parts = [jnp.sum(left[..., here] * right[..., here], axis=axes) for here in pieces]
        return sum(parts[1:], parts[0])
    return jnp.sum(left * right, axis=axes)


def _piece_by_piece(left: Array, right: Array) -> Array:
    """Products of matrices with long sums, a few terms at a time.

    A sum is worked through number by number, in its order. A short one is written out by the compiler, and
    then runs over several columns at once.

    Args:
        left: axes of the sums, of the products, and of their rows.
        right: the same with columns.
    """
    if left.shape[2] > right.shape[2]:
        return jnp.swapaxes(_piece_by_piece(right, left), 1, 2)
    length, count, rows = left.shape
    columns = right.shape[2]
    short = count * rows * columns * PIECE < REDUCTION_LIMIT
    size = min(PIECE if short else TERMS, length)

    def product(left: Array, right: Array) -> Array:
        terms = left[:, :, :, None] * right[:, :, None, :]
        return jnp.sum(terms, axis=0) if short else sum(jnp.unstack(terms), jnp.zeros(terms.shape[1:]))

    def add(k: Array, total: Array) -> Array:
        parts = (part(x, k * size, size) for x in (left, right))
        return total + product(*parts)

    whole, rest = length // size, length % size
    first = jnp.zeros((count, rows, columns), left.dtype)
    if rest:
        first = product(left[length - rest :], right[length - rest :])
    return jax.lax.fori_loop(0, whole, add, first)


def _pieces(equation: Any, x: Array, size: int) -> Array:
    """A reduction with long axes taken apart into pieces of some size."""
    operation, axes = REDUCTIONS[equation.primitive.name], equation.params["axes"]
    parts = [x]
    for axis in axes:
        starts = range(0, x.shape[axis], size)
        ends = [min(start + size, x.shape[axis]) for start in starts]
        parts = [jax.lax.slice_in_dim(p, a, b, axis=axis) for p in parts for a, b in zip(starts, ends)]
    found = [equation.primitive.bind(part, **equation.params) for part in parts]
    return reduce(operation, found)


def _loops(operation: Callable, x: Array, axes: Sequence[Any]) -> Array:
    """A large reduction as loops, which the compiler does not hand to a library."""
    for axis in sorted(map(int, axes), reverse=True):

        def add(k: Array, total: Array, x: Array = x, axis: int = axis) -> Array:
            return operation(total, row(x, k, axis))

        first = jax.lax.index_in_dim(x, 0, axis, keepdims=False)
        x = jax.lax.fori_loop(1, x.shape[axis], add, first)
    return x


def _updates(name: str, given: list[Any], params: dict[str, Any]) -> Array:
    """A scatter as updates of slices, one window after the other."""
    operand, indices, updates = given
    numbers = params["dimension_numbers"]
    batches, known = numbers.scatter_indices_batching_dims, isinstance(indices, np.ndarray)
    counted = [np.indices(indices.shape[:-1], indices.dtype)[k][..., None] for k in batches]
    indices = (np if known else jnp).concatenate([indices, *counted], axis=-1)
    targets = (*numbers.scatter_dims_to_operand_dims, *numbers.operand_batching_dims)
    single = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    windows = numbers.update_window_dims
    others = [k for k in range(updates.ndim) if k not in windows]
    updates = jnp.transpose(updates, (*others, *windows)).astype(operand.dtype)
    sizes = iter(updates.shape[len(others) :])
    shape = [1 if k in single else next(sizes) for k in range(operand.ndim)]
    count = math.prod(updates.shape[: len(others)])
    if 0 in updates.shape or 0 in operand.shape:
        return operand
    updates, places = updates.reshape(count, *shape), indices.reshape(count, -1)
    drops = params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    if known:
        room = np.array([operand.shape[dim] - shape[dim] for dim in targets])
        kept = np.flatnonzero(np.all((places >= 0) & (places <= room), axis=1))
        if drops and len(kept) < count:
            updates = updates.at[kept].get(mode="promise_in_bounds", wrap_negative_indices=False)
            places, count = places[kept], len(kept)
        drops = False

    def one(k: Any, total: Array) -> Array:
        window, place = row(updates, k), places[k] if isinstance(k, int) else row(jnp.asarray(places), k)
        starts = [jnp.zeros((), places.dtype)] * operand.ndim
        for n, dim in enumerate(targets):
            starts[dim] = place[n]
        now = jax.lax.dynamic_slice(total, starts, shape, allow_negative_indices=False)
        if name == "scatter-add":
            window = now + window
        if drops:
            limits = zip(starts, shape, operand.shape)
            inside = jnp.all(jnp.stack([(at >= 0) & (at + size <= end) for at, size, end in limits]))
            window = jnp.where(inside, window, now)
        return jax.lax.dynamic_update_slice(total, window, starts, allow_negative_indices=False)

    if count == 1 or (known and count <= UNROLLED):
        return reduce(lambda total, k: one(k, total), range(count), operand)
    return jax.lax.fori_loop(0, count, one, operand)
