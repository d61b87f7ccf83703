"""Which numbers that a program gives depend on which of those it is given: what may be other than zero.

A traced program is walked through once, with the set of all inputs that each number depends on, in bits. What
moves numbers about is done with their places, by NumPy; what is computed of several depends on all of them;
an operation that is not known is one where everything depends on everything. So the sets hold whatever the
values are: contacts that are open, and numbers that happen to vanish, change nothing.

See A. Griewank, A. Walther, Evaluating Derivatives (2008), section 7.1: propagation of index domains.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from natcoord_jax.xla.evaluation import INNER, ClosedJaxpr, Literal
from natcoord_jax.xla.evaluation import apply as computed
from natcoord_jax.xla.numpy_operations import scattering

Sets = np.ndarray
"""Bits of the inputs that numbers depend on (*shape, bytes)."""


class Known(NamedTuple):
    """What is known of an array.

    Attributes:
        shape: of it.
        value: its numbers, where they are part of the program.
        sets: what they depend on; None: on no input.
    """

    shape: tuple[int, ...]
    value: np.ndarray | None = None
    sets: Sets | None = None


def dependence(function: Callable[..., Any], others: Any, varying: Any) -> Bool[np.ndarray, "out in"]:
    """Which numbers of what a function gives depend on which of one argument's.

    Args:
        function: of the two arguments to an array.
        others: a pytree whose numbers may be any.
        varying: a vector.

    Returns:
        True where they may depend.
    """
    flat, structure = jax.tree.flatten(others)
    shapes = [jax.ShapeDtypeStruct(np.shape(x), jnp.result_type(x)) for x in (*flat, varying)]

    def of_leaves(*leaves: Any) -> Any:
        return jnp.ravel(function(jax.tree.unflatten(structure, leaves[:-1]), leaves[-1]))

    program, size = jax.make_jaxpr(of_leaves)(*shapes), np.size(varying)
    given = [Known(x.shape) for x in shapes[:-1]]
    given.append(Known((size,), None, np.packbits(np.eye(size, dtype=bool), axis=-1)))
    (found,) = _walked(program, given)
    if found.sets is None:
        return np.zeros((*found.shape, size), bool)
    return np.unpackbits(found.sets, axis=-1, count=size).astype(bool)


def derivative_pattern(function: Callable[..., Any], others: Any, at: Any) -> Bool[np.ndarray, "out in"]:
    """Entries of the derivative of a function that may be other than zero, at any point.

    Args:
        function: of a pytree and a vector to a vector.
        others: the pytree; its numbers may be any.
        at: the vector; its numbers may be any.
    """

    def change(given: Any, along: Any) -> Any:
        others, at = given
        return jax.jvp(lambda x: function(others, x), (at,), (along,))[1]

    return dependence(change, (others, at), at)


def _walked(program: ClosedJaxpr, given: Sequence[Known]) -> list[Known]:
    known: dict[Any, Known] = {}
    constants = [Known(np.shape(x), np.asarray(x)) for x in program.consts]
    known.update(zip([*program.jaxpr.constvars, *program.jaxpr.invars], [*constants, *given], strict=True))

    def of(atom: Any) -> Known:
        if isinstance(atom, Literal):
            return Known(np.shape(atom.val), np.asarray(atom.val, atom.aval.dtype))  # type: ignore[attr-defined]
        return known[atom]

    for equation in program.jaxpr.eqns:
        found = _done(equation, [of(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, found, strict=True))
    return [of(atom) for atom in program.jaxpr.outvars]


def _done(equation: Any, operands: list[Known]) -> list[Known]:
    """What is known of the results of one operation."""
    name, given, results = equation.primitive.name, equation.params, equation.outvars
    if operands and all(x.value is not None for x in operands) or name == "iota":
        values = computed(equation, [x.value for x in operands])  # type: ignore[misc]
        return [
            Known(v.aval.shape, np.asarray(x, v.aval.dtype)) for v, x in zip(results, values, strict=True)
        ]
    inner = next((given[key] for key in INNER if isinstance(given.get(key), ClosedJaxpr)), None)
    shapes = [x.aval.shape for x in results]
    # What is counted or compared has no derivative.
    smooth = [jnp.issubdtype(x.aval.dtype, np.inexact) for x in results]
    depending = any(x.sets is not None for x in operands)
    if inner is not None and name not in ("scan", "while", "cond"):
        found = _walked(inner, operands)
    elif not depending or not any(smooth):
        return [Known(shape) for shape in shapes]
    elif name == "scan":
        found = _scanned(equation, operands)
    elif name == "cond":
        found = [_either(x) for x in zip(*(_walked(branch, operands[1:]) for branch in given["branches"]))]
    else:
        rule = RULES.get(name)
        sets = None if rule is None else rule(equation, operands)
        if sets is None:
            union = _union([x.sets.reshape(-1, x.sets.shape[-1]) for x in operands if x.sets is not None])
            sets = [np.broadcast_to(union, (*shape, union.size)) for shape in shapes]
        found = [Known(shape, None, x) for shape, x in zip(shapes, sets, strict=True)]
    return [x if keep else Known(x.shape, x.value) for x, keep in zip(found, smooth, strict=True)]


def _union(sets: Sequence[Sets]) -> Sets:
    """Of rows of bits."""
    return np.bitwise_or.reduce(np.concatenate(sets), axis=0)


def _either(choices: Sequence[Known]) -> Known:
    """What may be one or the other."""
    sets = [x.sets for x in choices if x.sets is not None]
    values = [x.value for x in choices]
    same = values[0] is not None and all(x is not None and np.array_equal(x, values[0]) for x in values)
    value = values[0] if same and not sets else None
    return Known(choices[0].shape, value, np.bitwise_or.reduce(sets) if sets else None)


def _scanned(equation: Any, operands: list[Known]) -> list[Known]:
    """A loop of known length, step by step."""
    given = equation.params
    fixed, carried = (
        (len(list(part)) for part in list(given["ft_in"].unpack())[:2])
        if "ft_in" in given
        else (given["num_consts"], given["num_carry"])
    )
    constants, state, listed = (
        operands[:fixed],
        operands[fixed : fixed + carried],
        operands[fixed + carried :],
    )
    order, made = range(given["length"]), []
    for k in reversed(order) if given["reverse"] else order:
        results = _walked(given["jaxpr"], [*constants, *state, *(_row(x, k) for x in listed)])
        state = results[:carried]
        made.append(results[carried:])
    if given["reverse"]:
        made.reverse()
    outer = [x.aval.shape for x in equation.outvars[carried:]]
    every = zip(*made) if made else [() for _ in outer]
    return [*state, *(_stacked(rows, shape) for rows, shape in zip(every, outer))]


def _row(x: Known, k: int) -> Known:
    value, sets = (None if part is None else part[k] for part in (x.value, x.sets))
    return Known(x.shape[1:], value, sets)


def _stacked(rows: Sequence[Known], shape: tuple[int, ...]) -> Known:
    sizes = [x.sets.shape[-1] for x in rows if x.sets is not None]
    if not sizes:
        return Known(shape)
    return Known(shape, None, np.stack([_sets_of(x, sizes[0]) for x in rows]))


def _sets_of(x: Known, size: int) -> Sets:
    return np.zeros((*x.shape, size), np.uint8) if x.sets is None else x.sets


def _size(operands: list[Known]) -> int:
    return next(x.sets.shape[-1] for x in operands if x.sets is not None)


def _together(equation: Any, operands: list[Known]) -> list[Sets]:
    """Of operations number by number: what any of the operands depends on."""
    shape, size = equation.outvars[0].aval.shape, _size(operands)
    found = np.zeros((*shape, size), np.uint8)
    for x in operands:
        if x.sets is not None:
            found |= np.broadcast_to(x.sets, found.shape)
    return [found]


def _product(equation: Any, operands: list[Known]) -> list[Sets]:
    """The same of products; what is multiplied by a zero of the program depends on nothing."""
    (found,) = _together(equation, operands)
    for x in operands:
        if x.value is not None:
            found = np.where((x.value != 0)[..., None], found, np.uint8(0))
    return [found]


def _chosen(equation: Any, operands: list[Known]) -> list[Sets] | None:
    which, *cases = operands
    if which.value is None:
        return _together(equation, cases)
    size, shape = _size(operands), equation.outvars[0].aval.shape
    number = np.broadcast_to(which.value.astype(int), shape)[..., None]
    return [np.choose(number, [np.broadcast_to(_sets_of(x, size), (*shape, size)) for x in cases])]


def _moved(equation: Any, operands: list[Known]) -> list[Sets] | None:
    """Of operations that move numbers about, done with their places; indices have to be known."""
    size = _size(operands)
    places, tables, count = [], [np.zeros((1, size), np.uint8)], 1
    indices = INDICES.get(equation.primitive.name, len(operands))
    for x in operands[:indices]:
        if x.sets is None:
            places.append(np.zeros(x.shape, np.int64))
        else:
            rows = int(np.prod(x.shape))
            places.append(np.arange(count, count + rows).reshape(x.shape))
            tables.append(x.sets.reshape(rows, size))
            count += rows
    for x in operands[indices:]:
        if x.value is None:
            return None
        places.append(x.value)
    table = np.concatenate(tables)
    # (What is read from beyond an array is no place.)
    return [table[np.maximum(np.asarray(x), 0)] for x in computed(equation, places)]


def _scattered(equation: Any, operands: list[Known]) -> list[Sets] | None:
    """What is added at places that are known, or put there."""
    whole, indices, updates = operands
    if indices.value is None:
        return None
    size, pairs = _size(operands), []

    def change(result: np.ndarray, places: Any, sources: np.ndarray) -> None:
        pairs.append((np.broadcast_to(result[places], sources.shape).ravel(), sources.ravel()))

    numbers = (np.arange(int(np.prod(x.shape))).reshape(x.shape) for x in (whole, updates))
    (at, new), found = numbers, np.array(_sets_of(whole, size)).reshape(-1, size)
    if scattering(change)(at, indices.value, new, **equation.params) is NotImplemented:
        return None
    (targets, sources), added = pairs[0], _sets_of(updates, size).reshape(-1, size)
    if equation.primitive.name == "scatter":
        found[targets] = 0
    np.bitwise_or.at(found, targets, added[sources])
    return [found.reshape(*whole.shape, size)]


def _summed(equation: Any, operands: list[Known]) -> list[Sets] | None:
    (x,) = operands
    return None if x.sets is None else [np.bitwise_or.reduce(x.sets, axis=tuple(equation.params["axes"]))]


def _contracted(equation: Any, operands: list[Known]) -> list[Sets]:
    """Products of matrices: sums over all that is not a zero of the program."""
    (over_a, over_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    a, b = (
        _arranged(x, batch, over) for x, batch, over in zip(operands, (batch_a, batch_b), (over_a, over_b))
    )
    size, shape = _size(operands), equation.outvars[0].aval.shape
    found = np.zeros((a.shape[0], a.shape[1], b.shape[1], size), np.uint8)
    for k in range(a.shape[2]):
        for one, other, axis in ((a, b, 2), (b, a, 1)):
            if one.sets is not None:
                sets = np.expand_dims(one.sets[:, :, k], axis)
                if other.value is not None:
                    there = np.expand_dims(other.value[:, :, k] != 0, 3 - axis)[..., None]
                    sets = np.where(there, sets, np.uint8(0))
                found |= sets
    return [found.reshape(*shape, size)]


def _arranged(x: Known, batch: Sequence[int], over: Sequence[int]) -> Known:
    """An array as (batch, rows, contracted)."""
    free = [k for k in range(len(x.shape)) if k not in (*batch, *over)]
    sizes = [int(np.prod([x.shape[k] for k in axes])) for axes in (batch, free, over)]
    order = (*batch, *free, *over)
    value = None if x.value is None else np.transpose(x.value, order).reshape(sizes)
    sets = (
        None
        if x.sets is None
        else np.transpose(x.sets, (*order, len(order))).reshape(*sizes, x.sets.shape[-1])
    )
    return Known(tuple(sizes), value, sets)


MOVES = (
    "broadcast_in_dim reshape squeeze transpose rev concatenate stack tile expand_dims slice dynamic_slice "
    "dynamic_update_slice pad gather split unstack"
).split()
INDICES = {"dynamic_slice": 1, "dynamic_update_slice": 2, "gather": 1}
"""Operands from which on they are indices."""
ONE_BY_ONE = (
    "abs acos acosh add add_any asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy copy_p "
    "cos cosh div erf erf_inv erfc exp exp2 expm1 floor imag integer_pow lgamma log log1p logistic max min "
    "neg nextafter pow real rem round rsqrt sign sin sinh sqrt square stop_gradient sub tan tanh"
).split()
RULES: dict[str, Callable[[Any, list[Known]], list[Sets] | None]] = {
    **dict.fromkeys(ONE_BY_ONE, _together),
    **dict.fromkeys(MOVES, _moved),
    **dict.fromkeys(("scatter", "scatter-add"), _scattered),
    **dict.fromkeys(("reduce_sum", "reduce_max", "reduce_min", "reduce_prod"), _summed),
    "mul": _product,
    "select_n": _chosen,
    "dot_general": _contracted,
}
"""How sets go through an operation; None: everything depends on everything."""
