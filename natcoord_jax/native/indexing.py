"""Slices, gathers and scatters whose places are found on the way."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from natcoord_jax.native.arrays import Array, Arrays, Place, type_of
from natcoord_jax.native.graph import DTYPES, Node
from natcoord_jax.native.rules import as_nodes, rule


def _clamped(a: Arrays, node: Node, top: int) -> Place:
    """A start, moved to where a slice is inside of its array."""
    place = a.place(node)
    if isinstance(place, int):
        return min(max(place, 0), top)
    if top <= 0:
        return 0
    g = a.graph
    return a.place(g.op("min", "i64", g.op("max", "i64", place, g.integer(0)), g.integer(top)))


@rule("dynamic_slice")
def _dynamic_slice(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, sizes = operands[0], operation.params["slice_sizes"]
    starts = [_clamped(a, a.at(s, ()), n - k) for s, n, k in zip(operands[1:], x.shape, sizes)]
    if all(isinstance(s, int) for s in starts):
        index = tuple(slice(s, s + k) for s, k in zip(starts, sizes))
        return a.viewed(x, lambda x: x[index])
    x = a.stored(x)
    offset = x.offset
    for s, stride in zip(starts, x.strides):
        offset = a.plus(offset, a.times(s, stride)) if stride else offset
    found = a.view(x, sizes, x.strides, offset)
    # What is read of a row stays what it is, whatever is written later.
    return a.of_nodes(as_nodes(a, found), x.type) if found.size <= a.small else found


def changed(a: Arrays, x: Array, free: bool) -> Array:
    """An array in memory that may be written, with what is in another one: the same memory if it is free."""
    if x.owned and free and x.buffer is not None and x.offset == 0 and x.is_contiguous:
        a.graph.overwritten(x.buffer)
        made = a.view(x, x.shape, x.strides, 0)
        made.owned = True
        return made
    return a.computed(x)


def update_slice(a: Arrays, operation: Any, operands: list[Array], free: bool) -> Array:
    """An array with a slice replaced."""
    x, new = operands[:2]
    if new.size == 0:
        return x
    starts = [_clamped(a, a.at(s, ()), n - k) for s, n, k in zip(operands[2:], x.shape, new.shape)]
    if all(isinstance(s, int) for s in starts) and x.size <= a.small:
        nodes, known = as_nodes(a, x).copy(), [s for s in starts if isinstance(s, int)]
        nodes[tuple(slice(s, s + k) for s, k in zip(known, new.shape))] = as_nodes(a, new)
        return a.of_nodes(nodes, x.type)
    if x.buffer is not None and x.buffer in new.reads:
        new = a.computed(new)
    target = changed(a, x, free)
    offset: Place = 0
    for s, stride in zip(starts, target.strides):
        offset = a.plus(offset, a.times(s, stride))
    a.fill(a.view(target, new.shape, target.strides, offset), new)
    return target


def _inside(a: Arrays, node: Node, top: int) -> Node:
    g = a.graph
    low, high = (
        g.op("ge", "b", node, g.constant(0, node.type)),
        g.op("le", "b", node, g.constant(top, node.type)),
    )
    return g.op("and", "b", low, high)


def _starts(
    a: Arrays, indices: Array, batch: Sequence[Place], axes: Sequence[int], tops: Sequence[int], drop: bool
) -> tuple[dict[int, Place], Node]:
    """Where a slice starts along some axes, and whether it is inside of the array."""
    starts: dict[int, Place] = {}
    inside = a.graph.constant(True, "b")
    for k, (axis, top) in enumerate(zip(axes, tops)):
        node = a.at(indices, (*batch, k))
        if drop:
            inside = a.graph.op("and", "b", inside, _inside(a, node, top))
        starts[axis] = _clamped(a, node, top)
    return starts, inside


@rule("gather")
def _gather(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, indices = operands
    d, sizes = operation.params["dimension_numbers"], operation.params["slice_sizes"]
    fill, aval = "FILL" in str(operation.params["mode"]), operation.results[0].aval
    batch = [k for k in range(len(aval.shape)) if k not in d.offset_dims]
    window = [k for k in range(len(x.shape)) if k not in (*d.collapsed_slice_dims, *d.operand_batching_dims)]
    value = operation.params["fill_value"]
    if value is None:
        dtype = DTYPES[x.type]
        value = np.nan if dtype.kind == "f" else np.iinfo(dtype).min if dtype.kind == "i" else 1
        value = np.iinfo(dtype).max if dtype.kind == "u" else value
    absent = a.graph.constant(value, x.type)
    x = x if x.compute is None else a.stored(x)
    indices = indices if indices.compute is None else a.stored(indices)
    tops = [x.shape[k] - sizes[k] for k in d.start_index_map]

    def compute(index: Sequence[Place]) -> Node:
        places = [index[k] for k in batch]
        starts, inside = _starts(a, indices, places, d.start_index_map, tops, fill)
        full: list[Place] = [starts.get(k, 0) for k in range(len(x.shape))]
        for axis, k in zip(d.operand_batching_dims, d.start_indices_batching_dims):
            full[axis] = places[k]
        for k, axis in zip(d.offset_dims, window):
            full[axis] = a.plus(full[axis], index[k])
        if x.size == 0:
            return absent
        return a.graph.op("select", x.type, inside, a.at(x, full), absent)

    return a.made(aval.shape, x.type, compute, [x, indices])


HOW = {
    "scatter": None, "scatter-add": "add", "scatter_add": "add", "scatter-mul": "mul", "scatter_mul": "mul",
    "scatter-min": "min", "scatter_min": "min", "scatter-max": "max", "scatter_max": "max",
    "scatter-sub": "sub", "scatter_sub": "sub",
}  # fmt: skip
"""How a scatter combines what is there with what comes."""


def scatter(a: Arrays, operation: Any, operands: list[Array], free: bool) -> Array:
    """An array into which slices of another are written, or added, at places that are found on the way.

    Raises:
        UncoveredError: for other modes than clipping and dropping.
    """
    x, indices, new = operands
    d, mode = operation.params["dimension_numbers"], str(operation.params["mode"])
    if new.size == 0 or x.size == 0:
        return x
    drop, how, g = "CLIP" not in mode, HOW[operation.name], a.graph
    window = [k for k in range(len(x.shape)) if k not in (*d.inserted_window_dims, *d.operand_batching_dims)]
    batch = [k for k in range(len(new.shape)) if k not in d.update_window_dims]
    sizes = dict(zip(window, (new.shape[k] for k in d.update_window_dims)))
    axes = d.scatter_dims_to_operand_dims
    tops = [x.shape[k] - sizes.get(k, 1) for k in axes]

    def place(index: Sequence[Place]) -> tuple[list[Place], Node]:
        places = [index[k] for k in batch]
        starts, inside = _starts(a, indices, places, axes, tops, drop)
        full: list[Place] = [starts.get(k, 0) for k in range(len(x.shape))]
        for axis, k in zip(d.operand_batching_dims, d.scatter_indices_batching_dims):
            full[axis] = places[k]
        for k, axis in zip(d.update_window_dims, window):
            full[axis] = a.plus(full[axis], index[k])
        return full, inside

    def combined(old: Node, given: Node, inside: Node) -> Node:
        found = given if how is None else g.op(how, x.type, old, given)
        return g.op("select", x.type, inside, found, old)

    known = indices.nodes is not None and all(node.is_const for node in indices.nodes.flat)
    if known and x.size <= a.small and new.size <= 4 * a.small:
        nodes = as_nodes(a, x).copy()
        for index in np.ndindex(*new.shape):
            full, inside = place(index)
            nodes[tuple(full)] = combined(nodes[tuple(full)], a.at(new, index), inside)
        return a.of_nodes(nodes, x.type)
    return _in_memory(a, x, indices, new, free, place, combined)


def _in_memory(
    a: Arrays, x: Array, indices: Array, new: Array, free: bool, place: Callable, combined: Callable
) -> Array:
    """A scatter, one number after the other."""
    if x.buffer is not None and x.buffer in new.reads | indices.reads:
        new, free = a.computed(new), free and x.buffer not in indices.reads
    target = changed(a, x, free)
    buffer, g = target.buffer, a.graph
    assert buffer is not None
    home = buffer.home

    def put(index: Sequence[Place]) -> None:
        # What is there may have been written the trip before, or the statement before.
        g.overwritten(buffer)
        buffer.home = g.region
        full, inside = place(index)
        a.put(target, full, combined(a.at(target, full), a.at(new, index), inside))

    if new.size <= 16:
        for index in np.ndindex(*new.shape):
            put(index)
    else:
        a.each(new.shape, put)
    buffer.home = home
    g.overwritten(buffer)
    return target


def type_and_size(aval: Any) -> tuple[str, int]:
    """Type and number of the numbers of an array."""
    return type_of(aval), math.prod(aval.shape)
