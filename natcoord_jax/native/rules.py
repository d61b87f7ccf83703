"""What operations of JAX make of arrays, besides loops and branches."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from natcoord_jax.native.arrays import CHEAP, UNROLLED, Array, Arrays, Place, type_of
from natcoord_jax.native.graph import COMPARISONS, DTYPES, Node
from natcoord_jax.native.program import UncoveredError

Rule = Callable[[Arrays, Any, list[Array]], Any]

RULES: dict[str, Rule] = {}
"""By name of the operation: what makes an array (or a list of them) of operands."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Enter a function under these names."""

    def entered(function: Rule) -> Rule:
        for name in names:
            RULES[name] = function
        return function

    return entered


# Elementwise

Number = Callable[..., Node]

FUNCTIONS = (
    "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p sqrt cbrt erf erfc "
    "floor ceil atan2 nextafter neg not"
).split()
"""Operations with a name of their own in machine code, or a function of the C library."""


def _power(g: Any, x: Node, exponent: int) -> Node:
    """By squaring."""
    one = g.constant(1, x.type)
    if exponent < 0:
        return g.op("div", x.type, one, _power(g, x, -exponent))
    result, square = None, x
    while exponent:
        if exponent & 1:
            result = square if result is None else g.op("mul", x.type, result, square)
        exponent >>= 1
        square = g.op("mul", x.type, square, square) if exponent else square
    return one if result is None else result


def _sign(g: Any, x: Node) -> Node:
    """Zero and NaN are their own."""
    zero, one = g.constant(0, x.type), g.constant(1, x.type)
    if x.type in ("f64", "f32"):
        less = g.op("select", x.type, g.op("lt", "b", x, zero), g.constant(-1, x.type), x)
    else:
        less = g.op("select", x.type, g.op("lt", "b", x, zero), g.op("neg", x.type, one), zero)
    return g.op("select", x.type, g.op("gt", "b", x, zero), one, less)


def _clamp(g: Any, low: Node, x: Node, high: Node) -> Node:
    return g.op("min", x.type, g.op("max", x.type, x, low), high)


def _logistic(g: Any, x: Node) -> Node:
    one = g.constant(1, x.type)
    return g.op("div", x.type, one, g.op("add", x.type, one, g.op("exp", x.type, g.op("neg", x.type, x))))


def _select(g: Any, which: Node, *cases: Node) -> Node:
    if which.type == "b":
        return g.op("select", cases[0].type, which, cases[-1], cases[0])
    chosen = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        chosen = g.op(
            "select", chosen.type, g.op("le", "b", which, g.constant(k, which.type)), cases[k], chosen
        )
    return chosen


def _pow(g: Any, x: Node, y: Node) -> Node:
    return g.op("pow", x.type, x, g.convert(y, x.type))


def _named(name: str, type: str, g: Any, *args: Node) -> Node:
    return g.op(name, type, *args)


def _ordered(name: str, g: Any, a: Node, b: Node) -> Node:
    """In the order of all numbers: -NaN, -inf, ..., -0, 0, ..., NaN."""
    return g.op(name, "b", *(_rank(g, x) for x in (a, b)))


def _rank(g: Any, x: Node) -> Node:
    """An integer that has the place of a float in the order of all of them."""
    if x.type not in ("f64", "f32"):
        return x
    type, last = ("i64", 63) if x.type == "f64" else ("i32", 31)
    bits = g.op("bitcast", type, x)
    sign = g.op("shra", type, bits, g.constant(last, type))
    return g.op("xor", type, bits, g.op("and", type, sign, g.constant(2**last - 1, type)))


def _of(name: str, params: dict[str, Any], type: str) -> Number | None:
    """The function of numbers of an elementwise operation; None if it is another one."""
    if name in COMPARISONS:
        return partial(_named, name, "b")
    same = {"add_any": "add", "is_finite": "isfinite", "shift_left": "shl", "rem": "rem"}
    same |= {"shift_right_arithmetic": "shra", "shift_right_logical": "shrl"}
    if name in same or name in FUNCTIONS or name in "add sub mul div max min and or xor abs".split():
        return partial(_named, same.get(name, name), "b" if name == "is_finite" else type)
    if name == "integer_pow":
        return lambda g, x: _power(g, x, params["y"])
    if name == "round":
        return partial(_named, "round" if int(params["rounding_method"]) == 0 else "roundeven", type)
    if name in ("convert_element_type", "bitcast_convert_type"):
        if name == "bitcast_convert_type":
            return partial(_named, "bitcast", type)
        return lambda g, x: g.convert(x, type)
    others: dict[str, Number] = {
        "square": lambda g, x: g.op("mul", type, x, x),
        "rsqrt": lambda g, x: g.op("div", type, g.constant(1, type), g.op("sqrt", type, x)),
        "sign": _sign,
        "clamp": _clamp,
        "logistic": _logistic,
        "select_n": _select,
        "pow": _pow,
        "lt_to": partial(_ordered, "lt"),
        "le_to": partial(_ordered, "le"),
    }
    return others.get(name)


def has_rule(operation: Any) -> bool:
    """Whether there is a rule for an operation without programs in it."""
    if operation.name in RULES:
        return True
    return _of(operation.name, operation.params, "f64") is not None


def elementwise(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    """An array whose numbers are functions of those at the same place of the operands.

    Raises:
        UncoveredError: for an operation that there is no rule of.
    """
    aval = operation.results[0].aval
    type = type_of(aval)
    function = _of(operation.name, operation.params, type)
    if function is None:
        raise UncoveredError(f"the operation {operation.name}")
    if operation.name == "bitcast_convert_type" and operands[0].shape != tuple(aval.shape):
        raise UncoveredError("a change of type that changes the shape")
    singles = [x.same for x in operands]
    if math.prod(aval.shape) > 1 and all(x is not None for x in singles):
        return a.filled(function(a.graph, *singles), aval.shape)

    # Predicates and bounds may be scalars, and axes of one stand for longer ones.
    size = math.prod(aval.shape)
    operands = [a.stored(x) if x.compute and x.size < size and x.cost > CHEAP else x for x in operands]
    whole = [x.shape == tuple(aval.shape) for x in operands]

    def compute(index: Sequence[Place]) -> Node:
        given = [
            a.at(x, index if same else [0 if n == 1 else k for k, n in zip(index, x.shape)])
            for x, same in zip(operands, whole)
        ]
        return function(a.graph, *given)

    return a.made(aval.shape, type, compute, operands)


# Shapes


@rule("reshape", "squeeze", "expand_dims")
def _reshape(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    if operation.params.get("dimensions") is not None and operation.name == "reshape":
        raise UncoveredError("a reshape that transposes")
    return a.reshaped(operands[0], operation.results[0].aval.shape)


@rule("transpose")
def _transpose(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    return a.viewed(operands[0], lambda x: x.transpose(operation.params["permutation"]))


@rule("broadcast_in_dim")
def _broadcast(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    shape = operation.params["shape"]
    narrow = [1] * len(shape)
    for axis, n in zip(operation.params["broadcast_dimensions"], operands[0].shape):
        narrow[axis] = n
    x = a.reshaped(operands[0], narrow)
    return a.viewed(x, lambda x: np.broadcast_to(x, shape))


@rule("slice")
def _slice(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    p = operation.params
    steps = p["strides"] or (1,) * len(p["start_indices"])
    index = tuple(map(slice, p["start_indices"], p["limit_indices"], steps))
    return a.viewed(operands[0], lambda x: x[index])


@rule("rev")
def _rev(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    return a.viewed(operands[0], lambda x: np.flip(x, operation.params["dimensions"]))


def _along(axis: int, index: Any) -> tuple:
    return (*[slice(None)] * axis, index)


@rule("split")
def _split(a: Arrays, operation: Any, operands: list[Array]) -> list[Array]:
    ends = np.cumsum([0, *operation.params["sizes"]])
    parts = [_along(operation.params["axis"], slice(i, j)) for i, j in zip(ends[:-1], ends[1:])]
    return [a.viewed(operands[0], lambda x, part=part: x[part]) for part in parts]


@rule("unstack")
def _unstack(a: Arrays, operation: Any, operands: list[Array]) -> list[Array]:
    x, axis = operands[0], operation.params["axis"]
    shape = x.shape[:axis] + x.shape[axis + 1 :]
    parts = [_along(axis, slice(k, k + 1)) for k in range(x.shape[axis])]
    return [a.reshaped(a.viewed(x, lambda x, part=part: x[part]), shape) for part in parts]


def joined(a: Arrays, parts: Sequence[Array], axis: int, aval: Any) -> Array:
    """Arrays one after the other along an axis."""
    type = type_of(aval)
    if math.prod(aval.shape) <= a.small:
        return a.of_nodes(np.concatenate([as_nodes(a, x) for x in parts], axis), type)
    made, start = a.in_memory(aval.shape, type), 0
    for x in parts:
        end = start + x.shape[axis]
        target = a.viewed(made, lambda y, i=start, j=end: y[_along(axis, slice(i, j))])
        a.fill(target, x)
        start = end
    return made


def as_nodes(a: Arrays, x: Array) -> Any:
    """The nodes of an array."""
    if x.nodes is not None:
        return x.nodes
    nodes = np.empty(x.shape, object)
    for index in np.ndindex(*x.shape):
        nodes[index] = a.at(x, index)
    return nodes


@rule("concatenate")
def _concatenate(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    return joined(a, operands, operation.params["dimension"], operation.results[0].aval)


@rule("stack")
def _stack(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    axis = operation.params["axis"]
    parts = [a.reshaped(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in operands]
    return joined(a, parts, axis, operation.results[0].aval)


@rule("tile")
def _tile(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, reps = operands[0], operation.params["reps"]
    wide = tuple(n for r, s in zip(reps, x.shape) for n in (r, s))
    narrow = a.reshaped(x, [n for s in x.shape for n in (1, s)])
    repeated = a.viewed(narrow, lambda x: np.broadcast_to(x, wide))
    return a.reshaped(repeated, operation.results[0].aval.shape)


@rule("pad")
def _pad(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, padding = operands
    aval, config = operation.results[0].aval, operation.params["padding_config"]
    inside, taken = [], []
    for n, (low, _, between), size in zip(x.shape, config, aval.shape):
        step = between + 1
        first = max(0, -(low // step))
        last = min(n, -(-(size - low) // step))
        taken.append(slice(first, max(first, last)))
        inside.append(
            slice(low + first * step, low + max(first, last - 1) * step + 1 if last > first else 0, step)
        )
    x = a.viewed(x, lambda x: x[tuple(taken)])
    node = a.at(padding, ())
    if math.prod(aval.shape) <= a.small:
        nodes = np.empty(aval.shape, object)
        nodes[...] = node
        if x.size:
            nodes[tuple(inside)] = as_nodes(a, x)
        return a.of_nodes(nodes, x.type)
    made = a.computed(a.filled(node, aval.shape))
    if x.size:
        a.fill(a.viewed(made, lambda y: y[tuple(inside)]), x)
    return made


@rule("iota")
def _iota(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    shape, axis = operation.params["shape"], operation.params["dimension"]
    type = type_of(operation.results[0].aval)
    narrow = [n if k == axis else 1 for k, n in enumerate(shape)]
    x = a.literal(np.arange(shape[axis]).reshape(narrow), type)
    return a.viewed(x, lambda x: np.broadcast_to(x, shape))


@rule("platform_index")
def _platform(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    platforms = operation.params["platforms"]
    number = next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
    return a.literal(np.int32(number), "i32")


# Reductions


def _reduced(a: Arrays, operation: Any, operands: list[Array], name: str, first: Any) -> Array:
    x, axes = operands[0], operation.params["axes"]
    kept = [k for k in range(len(x.shape)) if k not in axes]
    extents, most = [x.shape[k] for k in axes], a.small if x.nodes is not None else 64
    start = a.graph.constant(first, x.type)

    def compute(index: Sequence[Place]) -> Node:
        def term(inner: Sequence[Place]) -> Node:
            full: list[Place] = [0] * len(x.shape)
            for k, i in (*zip(kept, index), *zip(axes, inner)):
                full[k] = i
            return a.at(x, full)

        return a.combined(extents, term, start, partial(a.graph.op, name, x.type), most)

    terms = math.prod(extents)
    if x.compute is not None and UNROLLED < terms * x.cost and terms <= most:
        x = a.stored(x)
    return a.made(operation.results[0].aval.shape, x.type, compute, [x], terms)


def _least(type: str, sign: int) -> Any:
    dtype = DTYPES[type]
    if type == "b":
        return sign < 0
    if dtype.kind == "f":
        return sign * np.inf
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


@rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or", "reduce_xor")
def _reduce(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    kind, type = str(operation.name).removeprefix("reduce_"), operands[0].type
    name = {"sum": "add", "prod": "mul"}.get(kind) or kind
    first = {"sum": 0, "prod": 1, "or": 0, "xor": 0, "and": -1 if type != "b" else True}
    first |= {"max": _least(type, -1), "min": _least(type, 1)}
    return _reduced(a, operation, operands, name, first[kind])


@rule("argmax", "argmin")
def _arg(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, (axis,) = operands[0], operation.params["axes"]
    g, better = a.graph, "gt" if operation.name == "argmax" else "lt"
    type = type_of(operation.results[0].aval)
    if x.shape[axis] > max(a.small, 64):
        raise UncoveredError("the place of the largest of many")

    def compute(index: Sequence[Place]) -> Node:
        def value(k: int) -> Node:
            return a.at(x, (*index[:axis], k, *index[axis:]))

        best, place = value(0), g.constant(0, type)
        for k in range(1, x.shape[axis]):
            new = value(k)
            wins = g.op(better, "b", new, best)
            if x.type in ("f64", "f32"):
                # The first NaN wins.
                first = g.op("and", "b", g.op("ne", "b", new, new), g.op("eq", "b", best, best))
                wins = g.op("or", "b", g.op("and", "b", wins, g.op("eq", "b", best, best)), first)
            best = g.op("select", x.type, wins, new, best)
            place = g.op("select", type, wins, g.constant(k, type), place)
        return place

    return a.made(operation.results[0].aval.shape, type, compute, [x], x.shape[axis])


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulated(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    x, axis = operands[0], operation.params["axis"]
    name, first = {
        "cumsum": ("add", 0),
        "cumprod": ("mul", 1),
        "cummax": ("max", _least(x.type, -1)),
        "cummin": ("min", _least(x.type, 1)),
    }[operation.name]
    if x.size > a.small:
        return _cumulated_in_memory(a, operation, a.stored(x), name, a.graph.constant(first, x.type))
    nodes = as_nodes(a, x).copy()
    rows = np.moveaxis(nodes, axis, 0)
    order = list(range(len(rows)))[:: -1 if operation.params["reverse"] else 1]
    for before, k in zip(order[:-1], order[1:]):
        for index in np.ndindex(*rows.shape[1:]):
            rows[(k, *index)] = a.graph.op(name, x.type, rows[(before, *index)], rows[(k, *index)])
    return a.of_nodes(nodes, x.type)


def _cumulated_in_memory(a: Arrays, operation: Any, x: Array, name: str, first: Node) -> Array:
    """By a loop along the axis, for every place of the others."""
    axis, n = operation.params["axis"], x.shape[operation.params["axis"]]
    made = a.in_memory(x.shape, x.type)

    def along(others: Sequence[Place]) -> None:
        region = a.graph.open_loop(indexed=True)
        total, k = a.graph.carry(first), region.index
        assert k is not None
        if operation.params["reverse"]:
            k = a.graph.op("sub", "i64", a.graph.integer(n - 1), k)
        index = (*others[:axis], k, *others[axis:])
        new = a.graph.op(name, x.type, total, a.at(x, index))
        a.put(made, index, new)
        region.carries[0][2] = new
        a.graph.close_loop(n)

    a.each([*x.shape[:axis], *x.shape[axis + 1 :]], along)
    return made


@rule("dot_general")
def _dot(a: Arrays, operation: Any, operands: list[Array]) -> Array:
    (lc, rc), (lb, rb) = operation.params["dimension_numbers"]
    left, right = (x if x.nodes is not None else a.stored(x) for x in operands)
    lf = [k for k in range(len(left.shape)) if k not in (*lc, *lb)]
    rf = [k for k in range(len(right.shape)) if k not in (*rc, *rb)]
    extents, type = [left.shape[k] for k in lc], type_of(operation.results[0].aval)
    small = left.nodes is not None or right.nodes is not None

    def compute(index: Sequence[Place]) -> Node:
        b, m = len(lb), len(lb) + len(lf)
        batch, rows, columns = index[:b], index[b:m], index[m:]

        def term(inner: Sequence[Place]) -> Node:
            i: list[Place] = [0] * len(left.shape)
            j: list[Place] = [0] * len(right.shape)
            for axes, places in ((lb, batch), (lf, rows), (lc, inner)):
                for k, place in zip(axes, places):
                    i[k] = place
            for axes, places in ((rb, batch), (rf, columns), (rc, inner)):
                for k, place in zip(axes, places):
                    j[k] = place
            x, y = (a.graph.convert(z, type) for z in (a.at(left, i), a.at(right, j)))
            return a.graph.op("mul", type, x, y)

        add = partial(a.graph.op, "add", type)
        return a.combined(extents, term, a.graph.constant(0, type), add, a.small if small else 64)

    shape = operation.results[0].aval.shape
    return a.made(shape, type, compute, [left, right], math.prod(extents))
