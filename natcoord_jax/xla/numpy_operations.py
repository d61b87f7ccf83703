"""Operations of JAX by name, done by NumPy."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *operands, **given: function(*operands)


def _floating(function: Callable[..., Any]) -> Callable[..., Any]:
    """Of floating point numbers only; integers have rules of their own."""
    return lambda *x, **given: function(*x) if np.issubdtype(x[0].dtype, np.floating) else NotImplemented


def _along_axes(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda x, *, axes, **given: function(x, axis=tuple(axes))


def _of_some(function: Callable[..., Any]) -> Callable[..., Any]:
    """Of one number at least; the extremes of none are infinite, which NumPy refuses to say."""
    return lambda x, **given: function(x, **given) if x.size else NotImplemented


def _broadcast(x, *dynamic, shape, broadcast_dimensions, **given):
    if dynamic:
        return NotImplemented
    sizes = [1] * len(shape)
    for place, size in zip(broadcast_dimensions, x.shape):
        sizes[place] = size
    return np.broadcast_to(x.reshape(sizes), shape)


def _reshape(x, *dynamic, new_sizes, dimensions=None, **given):
    return NotImplemented if dynamic or dimensions is not None else x.reshape(new_sizes)


def _slice(x, *, start_indices, limit_indices, strides, **given):
    steps = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, steps))]


def _dynamic_slice(x, *starts, slice_sizes, **given):
    if len(starts) != x.ndim:
        return NotImplemented
    first = [int(np.clip(s, 0, n - k)) for s, n, k in zip(starts, x.shape, slice_sizes)]
    return x[tuple(slice(s, s + k) for s, k in zip(first, slice_sizes))]


def _dynamic_update_slice(x, piece, *starts, **given):
    first = [int(np.clip(s, 0, n - k)) for s, n, k in zip(starts, x.shape, piece.shape, strict=True)]
    result = np.array(x)
    result[tuple(slice(s, s + k) for s, k in zip(first, piece.shape))] = piece
    return result


def _select(which, *cases, **given):
    if len(cases) == 2:
        return np.where(which.astype(bool), cases[1], cases[0])
    return NotImplemented


def _in_total_order(function: Callable[..., Any]) -> Callable[..., Any]:
    """Comparisons of sorting, where NaN and the sign of zero count; without these they are the usual ones."""

    def apply(a, b, **given):
        special = any(np.any(np.isnan(x) | ((x == 0) & np.signbit(x))) for x in (a, b))
        return NotImplemented if special else function(a, b)

    return _floating(apply)


def _pad(x, filling, *, padding_config, **given):
    if any(low < 0 or high < 0 or inner for low, high, inner in padding_config):
        return NotImplemented
    return np.pad(x, [(low, high) for low, high, _ in padding_config], constant_values=filling)


def _iota(*, dtype, shape, dimension, **given):
    sizes = [shape[dimension] if k == dimension else 1 for k in range(len(shape))]
    return np.broadcast_to(np.arange(shape[dimension], dtype=dtype).reshape(sizes), shape)


def _cumulative(x, *, axis, reverse, **given):
    return np.flip(np.cumsum(np.flip(x, axis), axis), axis) if reverse else np.cumsum(x, axis)


def _extreme(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda x, *, axes, **given: (
        function(x, axis=axes[0]) if len(axes) == 1 and x.size else NotImplemented
    )


def _dot_general(a, b, *, dimension_numbers, **given):
    (over_a, over_b), (batch_a, batch_b) = dimension_numbers
    at_a, at_b = list(range(a.ndim)), list(range(a.ndim, a.ndim + b.ndim))
    for i, j in zip((*batch_a, *over_a), (*batch_b, *over_b)):
        at_b[j] = at_a[i]
    batch = [at_a[i] for i in batch_a]
    free = [at_a[i] for i in range(a.ndim) if i not in (*batch_a, *over_a)]
    free += [at_b[j] for j in range(b.ndim) if j not in (*batch_b, *over_b)]
    return np.einsum(a, at_a, b, at_b, batch + free, optimize=a.ndim + b.ndim > 3)


def _places(
    starts: np.ndarray, sizes: Sequence[int], shape: Sequence[int], window: Sequence[int], layout: Any
) -> Any:
    """Index arrays of slices of an array at given starts, shape (batch..., window...); None: beyond it.

    Args:
        starts: indices, the last axis over the indexed axes.
        sizes: of a slice along every axis.
        shape: of the array.
        window: axes that a slice keeps.
        layout: (indexed axes, axes that go along with the batch, their axes in the batch).
    """
    indexed, along, batch_axes = layout
    batch = starts.shape[:-1]
    places = []
    for axis, (size, length) in enumerate(zip(sizes, shape)):
        at = np.zeros(batch, np.int64)
        if axis in indexed:
            at = starts[..., list(indexed).index(axis)].astype(np.int64)
        elif axis in along:
            place = batch_axes[list(along).index(axis)]
            at = np.arange(batch[place]).reshape([-1 if k == place else 1 for k in range(len(batch))])
            at = np.broadcast_to(at, batch)
        if at.size and (at.min() < 0 or at.max() > length - size):
            return None
        inner = [size if k == axis else 1 for k in window]
        at = at.reshape((*batch, *(1 for _ in window)))
        places.append(at + np.arange(size).reshape(inner) if axis in window else at)
    return tuple(places)


def _gather(x, starts, *, dimension_numbers: Any, slice_sizes, **given):
    d = dimension_numbers
    dropped = (*d.collapsed_slice_dims, *d.operand_batching_dims)
    window = [k for k in range(x.ndim) if k not in dropped]
    layout = d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims
    places = _places(starts, slice_sizes, x.shape, window, layout)
    if not places:
        return NotImplemented
    taken = x[places]
    batch = starts.ndim - 1
    return np.moveaxis(taken, range(batch, taken.ndim), d.offset_dims) if window else taken


def scattering(change: Callable[..., None]) -> Callable[..., Any]:
    """An operation that scatters: `change` gets a copy of the array, the places, and what goes there."""

    def apply(x, starts, updates, *, dimension_numbers: Any, **given):
        d = dimension_numbers
        dropped = (*d.inserted_window_dims, *d.operand_batching_dims)
        window = [k for k in range(x.ndim) if k not in dropped]
        sizes = [1] * x.ndim
        for axis, place in zip(window, d.update_window_dims):
            sizes[axis] = updates.shape[place]
        layout = d.scatter_dims_to_operand_dims, d.operand_batching_dims, d.scatter_indices_batching_dims
        places = _places(starts, sizes, x.shape, window, layout)
        if not places:
            return NotImplemented
        batch = starts.ndim - 1
        if window:
            updates = np.moveaxis(updates, d.update_window_dims, range(batch, updates.ndim))
        result = np.array(x)
        change(result, places, updates)
        return result

    return apply


SAME = "abs ceil cos cosh exp expm1 floor log log1p sign sin sinh sqrt square tan tanh".split()
"""Operations that have the same name in NumPy."""

OPERATIONS: dict[str, Callable[..., Any]] = {
    **{name: _plain(getattr(np, name)) for name in SAME},
    **{
        name: _plain(function)
        for name, function in {
            "neg": np.negative,
            "asin": np.arcsin,
            "acos": np.arccos,
            "atan": np.arctan,
            "atan2": np.arctan2,
            "rsqrt": lambda x: 1.0 / np.sqrt(x),
            "is_finite": np.isfinite,
            "not": np.invert,
            "and": np.bitwise_and,
            "or": np.bitwise_or,
            "xor": np.bitwise_xor,
            "add": np.add,
            "add_any": np.add,
            "sub": np.subtract,
            "mul": np.multiply,
            "max": np.maximum,
            "min": np.minimum,
            "eq": np.equal,
            "ne": np.not_equal,
            "lt": np.less,
            "le": np.less_equal,
            "gt": np.greater,
            "ge": np.greater_equal,
            "copy": np.array,
            "copy_p": np.array,
            "stop_gradient": np.array,
            "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
        }.items()
    },
    "lt_to": _in_total_order(np.less),
    "le_to": _in_total_order(np.less_equal),
    "div": _floating(np.divide),
    "pow": _floating(np.power),
    "integer_pow": lambda x, *, y, **given: np.power(x, y) if y >= 0 else 1.0 / np.power(x, -y),
    "reduce_sum": _along_axes(np.sum),
    "reduce_prod": _along_axes(np.prod),
    "reduce_max": _of_some(_along_axes(np.max)),
    "reduce_min": _of_some(_along_axes(np.min)),
    "reduce_and": _along_axes(np.all),
    "reduce_or": _along_axes(np.any),
    "argmax": _extreme(np.argmax),
    "argmin": _extreme(np.argmin),
    "cumsum": _cumulative,
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": lambda x, *, dimensions, **given: x.squeeze(tuple(dimensions)),
    "transpose": lambda x, *, permutation, **given: x.transpose(permutation),
    "rev": lambda x, *, dimensions, **given: np.flip(x, dimensions),
    "concatenate": lambda *x, dimension, **given: np.concatenate(x, dimension),
    "stack": lambda *x, axis, **given: np.stack(x, axis),
    "tile": lambda x, *, reps, **given: np.tile(x, reps),
    "expand_dims": lambda x, *, dimensions, **given: np.expand_dims(x, tuple(dimensions)),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "select_n": _select,
    "convert_element_type": lambda x, *, new_dtype, **given: x.astype(new_dtype),
    "iota": _iota,
    "pad": _pad,
    "dot_general": _dot_general,
    "gather": _gather,
    "scatter": scattering(lambda x, at, new: x.__setitem__(at, new)),
    "scatter-add": scattering(np.add.at),
    "scatter-mul": scattering(np.multiply.at),
}
"""Operations of JAX by name, in NumPy; `NotImplemented` where the case is not treated."""
