"""Programs rewritten operation by operation, so that nothing in them is handed to a library.

Small products become sums, scatters updates of slices, long reductions loops; see `one_kernel` for what for.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core as jex
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

KNOWN = frozenset(
    "abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh bitcast_convert_type "
    "broadcast_in_dim cbrt ceil clamp concatenate cond convert_element_type copy copy_p cos cosh "
    "cumsum custom_vmap_call div dynamic_slice dynamic_update_slice eq erf erf_inv erfc exp exp2 "
    "expand_dims expm1 floor gather ge gt integer_pow iota is_finite jit le log log1p logistic lt max "
    "min mul ne neg nextafter not optimization_barrier or pad pjit platform_index pow reduce_and "
    "reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt scan select_n "
    "shift_left shift_right_arithmetic shift_right_logical sign sin sinh slice split sqrt square "
    "squeeze stack stop_gradient sub tan tanh tile transpose unstack while xla_metadata_call xor".split()
)
"""Primitives that are compiled in place, without a call into a library."""

INLINED = {
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "closed_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}
"""Calls that are written out, as their names and rules for derivatives are of no use here: where their
programs are."""

REDUCTION_LIMIT = 3000
"""Numbers from which on the compiler hands a reduction to a library (seen: 4096)."""

REDUCTIONS = {
    "reduce_sum": jnp.add,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": jnp.logical_and,
    "reduce_or": jnp.logical_or,
}
"""Reductions that are written as loops where they are long, and in pieces where an axis is."""

WINDOW = 32
"""Length of an axis beyond which the compiler takes a reduction apart itself, into parts that do not fuse."""

FEW = 64
"""Length up to which it is taken apart here: programs should not grow with the number of bodies."""

REWRITTEN = frozenset(("dot_general", "scatter", "scatter-add", *INLINED))
"""Primitives that may be rewritten in terms of those."""


def _inner_programs(equation: Any) -> list[Any]:
    """Programs among the parameters of an equation."""
    found = []
    for value in equation.params.values():
        for x in value if isinstance(value, tuple | list) else (value,):
            if isinstance(x, jex.ClosedJaxpr):
                found.append(x.jaxpr)
            elif isinstance(x, jex.Jaxpr):
                found.append(x)
    return found


def operations(program: Any) -> int:
    """Number of operations of a program and of all programs in it that its outputs need."""
    return sum(1 + sum(map(operations, _inner_programs(equation))) for equation in _needed(program))


def mean_size(program: Any) -> float:
    """Numbers that an operation of a program finds on average."""
    count, numbers = _sizes(program)
    return numbers / max(count, 1)


def _sizes(program: Any) -> tuple[int, int]:
    """Operations without programs in them, and the numbers that they find."""
    count, numbers = 0, 0
    for equation in _needed(program):
        inner = [_sizes(x) for x in _inner_programs(equation)]
        here = 1, sum(math.prod(x.aval.shape) for x in equation.outvars)
        for a, b in inner or [here]:
            count, numbers = count + a, numbers + b
    return count, numbers


def _needed(program: Any) -> list[Any]:
    """Equations of a program that its outputs need."""
    wanted, found = set(map(id, program.outvars)), []
    for equation in reversed(program.eqns):
        if equation.effects or any(id(x) in wanted for x in equation.outvars):
            wanted.update(map(id, equation.invars))
            found.append(equation)
    return found[::-1]


def known(program: Any, names: frozenset[str] | None = None) -> bool:
    """Whether a program holds nothing but the operations of these names, by default `KNOWN`."""
    names = KNOWN if names is None else names
    return all(
        equation.primitive.name in names and all(known(inner, names) for inner in _inner_programs(equation))
        for equation in program.eqns
    )


class Flat:
    """A program as a function of its constants and arguments, in one list.

    Attributes:
        program: closed.
    """

    def __init__(self, program: Any):
        self.program = program

    def _parts(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        count = len(self.program.consts)
        return values[:count], values[count:]

    def __call__(self, *values: Any) -> list[Any]:
        """Its outputs."""
        consts, arguments = self._parts(values)
        return jex.jaxpr_as_fun(jex.ClosedJaxpr(self.program.jaxpr, consts))(*arguments)

    def rewritten(self, *values: Any) -> list[Any]:
        """Its outputs, rewritten on the way."""
        return _evaluate(self.program.jaxpr, *self._parts(values))


def _evaluate(program: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    values: dict[Any, Any] = dict(zip(program.constvars, consts)) | dict(zip(program.invars, arguments))

    def read(x: Any) -> Any:
        return x.val if isinstance(x, jex.Literal) else values[x]

    for equation in _needed(program):
        given = [read(x) for x in equation.invars]
        scope = str(equation.source_info.name_stack)
        if scope:
            with jax.named_scope(scope):
                found = _apply(equation, given)
        else:
            found = _apply(equation, given)
        values.update(zip(equation.outvars, found))
    return [read(x) for x in program.outvars]


def _apply(equation: Any, given: list[Any]) -> list[Any]:
    """Outputs of one equation."""
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        found = _product(given, params, equation.outvars[0].aval)
        if found is not None:
            return [found]
    if name in ("scatter", "scatter-add"):
        return [_update(name, given, params)]
    if name in REDUCTIONS:
        x, axes = given[0], params["axes"]
        if math.prod(x.shape) >= REDUCTION_LIMIT:
            return [_reduced(REDUCTIONS[name], x, axes)]
        if WINDOW < max((x.shape[axis] for axis in axes), default=0) <= FEW:
            return [_in_pieces(equation, x, WINDOW)]
    if name in INLINED and isinstance(params.get(INLINED[name]), jex.ClosedJaxpr):
        inner = params[INLINED[name]]
        return _evaluate(inner.jaxpr, inner.consts, given)
    if name != "custom_vmap_call":
        params = {key: _inside(value) for key, value in params.items()}
    found = equation.primitive.bind(*given, **params)
    return list(found) if equation.primitive.multiple_results else [found]


def _inside(value: Any) -> Any:
    """A parameter with the programs it holds rewritten."""
    if isinstance(value, jex.ClosedJaxpr):
        return jax.make_jaxpr(partial(Flat(value).rewritten, *value.consts))(*value.in_avals)
    if isinstance(value, tuple) and value and all(isinstance(x, jex.ClosedJaxpr) for x in value):
        return tuple(_inside(x) for x in value)
    return value


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
        return _reduced(jnp.add, left * right, axes)
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


def _in_pieces(equation: Any, x: Array, size: int) -> Array:
    """A reduction with long axes taken apart into pieces of some size."""
    operation, axes = REDUCTIONS[equation.primitive.name], equation.params["axes"]
    parts = [x]
    for axis in axes:
        starts = range(0, x.shape[axis], size)
        ends = [min(start + size, x.shape[axis]) for start in starts]
        parts = [jax.lax.slice_in_dim(p, a, b, axis=axis) for p in parts for a, b in zip(starts, ends)]
    found = [equation.primitive.bind(part, **equation.params) for part in parts]
    return reduce(operation, found)


def _reduced(operation: Callable, x: Array, axes: Sequence[Any]) -> Array:
    """A large reduction as loops, which the compiler does not hand to a library."""
    for axis in sorted(map(int, axes), reverse=True):

        def add(k: Array, total: Array, x: Array = x, axis: int = axis) -> Array:
            return operation(total, row(x, k, axis))

        first = jax.lax.index_in_dim(x, 0, axis, keepdims=False)
        x = jax.lax.fori_loop(1, x.shape[axis], add, first)
    return x


def _update(name: str, given: list[Any], params: dict[str, Any]) -> Array:
    """A scatter as updates of slices, one window after the other."""
    operand, indices, updates = given
    numbers = params["dimension_numbers"]
    batches = numbers.scatter_indices_batching_dims
    counted = [jax.lax.broadcasted_iota(indices.dtype, indices.shape[:-1], k)[..., None] for k in batches]
    indices = jnp.concatenate([indices, *counted], axis=-1)
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

    def one(k: Any, total: Array) -> Array:
        window, place = row(updates, k), row(places, k)
        starts = [jnp.zeros((), place.dtype)] * operand.ndim
        for n, dim in enumerate(targets):
            starts[dim] = place[n]
        now = jax.lax.dynamic_slice(total, starts, shape, allow_negative_indices=False)
        if name == "scatter-add":
            window = now + window
        if params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP:
            limits = zip(starts, shape, operand.shape)
            inside = jnp.all(jnp.stack([(at >= 0) & (at + size <= end) for at, size, end in limits]))
            window = jnp.where(inside, window, now)
        return jax.lax.dynamic_update_slice(total, window, starts, allow_negative_indices=False)

    return one(0, operand) if count == 1 else jax.lax.fori_loop(0, count, one, operand)
