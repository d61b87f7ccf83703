"""A linear function that comes with its transpose, each computed in its own way.

JAX transposes a linear program operation by operation, and differentiates it in the same way. Where the
transpose has a better program of its own, and the changes of both are the same linear functions of other
arguments, `apply` binds all of that together: derivatives of any order are then made of these two programs.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend import core as jex
from jax.interpreters import ad, batching, mlir


@jax.tree_util.register_static
@dataclass(frozen=True)
class Unchanged:
    """In the place of the tangent of a number that does not change."""


def along(function: Callable, at: tuple, changes: tuple) -> tuple[Any, Any]:
    """Value of a function and its change along changes of its arguments, some of them `Unchanged`."""
    leaves, structure = jax.tree.flatten(at)
    every = structure.flatten_up_to(changes)
    varied = [k for k, change in enumerate(every) if not isinstance(change, Unchanged)]

    def of_varied(*some: Any) -> Any:
        given = list(leaves)
        for k, x in zip(varied, some):
            given[k] = x
        return function(*jax.tree.unflatten(structure, given))

    return jax.jvp(of_varied, tuple(leaves[k] for k in varied), tuple(every[k] for k in varied))


class LinearWithTranspose(ABC):
    """A linear function of arguments after residuals, and its transpose; without traced values.

    The programs of `forward` and `backward` need not be differentiable. Those of their changes are where the
    two are used in them through `apply` and `transposed`.
    """

    @abstractmethod
    def forward(self, residuals: Any, arguments: Any) -> Any:
        """The function."""

    @abstractmethod
    def backward(self, residuals: Any, cotangents: Any) -> Any:
        """Its transpose."""

    def forward_many(self, residuals: Any, arguments: Any) -> Any:
        """The function of several arguments, along the first axis of each array."""
        return jax.vmap(partial(self.forward, residuals))(arguments)

    def backward_many(self, residuals: Any, cotangents: Any) -> Any:
        """The transpose of several cotangents, along the first axis of each array."""
        return jax.vmap(partial(self.backward, residuals))(cotangents)

    @abstractmethod
    def forward_changed(
        self, residuals: Any, changes: Any, arguments: Any, arguments_dot: Any
    ) -> tuple[Any, Any]:
        """The function and its change along changes of the residuals, some `Unchanged`, and the arguments."""

    @abstractmethod
    def backward_changed(
        self, residuals: Any, changes: Any, cotangents: Any, cotangents_dot: Any
    ) -> tuple[Any, Any]:
        """The same of its transpose."""


@dataclass(frozen=True, eq=False)
class Side:
    """A linear function of flat arguments after flat residuals.

    Attributes:
        value: computes it.
        many: computes it for several linear arguments, along the first axis of each.
        changed: (which residuals change, all arguments, changes of these, changes of the linear arguments) to
            the value and its change.
        shapes: of its outputs.
    """

    value: Callable
    many: Callable
    changed: Callable
    shapes: tuple[jax.ShapeDtypeStruct, ...]


def apply(pair: LinearWithTranspose, residuals: Any, arguments: Any, outputs: Any) -> Any:
    """Value of a linear function, differentiable in every mode.

    Args:
        pair: the function and its transpose.
        residuals: pytree of arrays.
        arguments: pytree of arrays.
        outputs: pytree of arrays or shapes like the value.
    """
    return _bound(pair, residuals, arguments, outputs, 0)


def transposed(pair: LinearWithTranspose, residuals: Any, cotangents: Any, arguments: Any) -> Any:
    """Value of its transpose, where `arguments` is like what the function is of."""
    return _bound(pair, residuals, cotangents, arguments, 1)


def _bound(pair: LinearWithTranspose, residuals: Any, given: Any, outputs: Any, number: int) -> Any:
    """The function, number 0, or its transpose, number 1."""
    res, res_tree = jax.tree.flatten(residuals)
    own, own_tree = jax.tree.flatten(given)
    out, out_tree = jax.tree.flatten(outputs)
    count = len(res)

    def side(programs: tuple[Callable, ...], linear_tree: Any, shapes: Sequence[Any]) -> Side:
        value, many, changed = programs

        def unflattened(flat: Sequence[Any]) -> tuple[Any, Any]:
            return res_tree.unflatten(flat[:count]), linear_tree.unflatten(flat[count:])

        def flattened(function: Callable) -> Callable:
            return lambda *flat: jax.tree.leaves(function(*unflattened(flat)))

        def flat_changed(varied: Sequence[int], flat: Any, some: Any, linear_dot: Any) -> tuple[Any, Any]:
            every: list[Any] = [Unchanged()] * count
            for k, x in zip(varied, some):
                every[k] = x
            fixed, linear = unflattened(flat)
            changes = res_tree.unflatten(every), linear_tree.unflatten(linear_dot)
            found, found_dot = changed(fixed, changes[0], linear, changes[1])
            return jax.tree.leaves(found), jax.tree.leaves(found_dot)

        return Side(flattened(value), flattened(many), flat_changed, _shapes(shapes))

    forward = pair.forward, pair.forward_many, pair.forward_changed
    backward = pair.backward, pair.backward_many, pair.backward_changed
    programs = forward, backward
    sides = side(programs[number], own_tree, out), side(programs[1 - number], out_tree, own)
    return out_tree.unflatten(linear_pair_p.bind(*res, *own, sides=sides, count=count))


def _shapes(values: Sequence[Any]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in values)


linear_pair_p = jex.Primitive("linear_pair")
linear_pair_p.multiple_results = True


@linear_pair_p.def_impl
def _impl(*args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    return sides[0].value(*args)


@linear_pair_p.def_abstract_eval
def _abstract(*args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    return [ShapedArray(s.shape, s.dtype) for s in sides[0].shapes]


mlir.register_lowering(linear_pair_p, mlir.lower_fun(_impl, multiple_results=True))


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, sides: tuple[Side, Side], count: int):
    linear_dot = [ad.instantiate_zeros(t) for t in tangents[count:]]
    varied = [k for k, t in enumerate(tangents[:count]) if not isinstance(t, ad.Zero)]
    varied = [k for k in varied if jnp.issubdtype(jnp.result_type(primals[k]), jnp.inexact)]
    if varied:
        return sides[0].changed(varied, primals, [tangents[k] for k in varied], linear_dot)
    bind = partial(linear_pair_p.bind, sides=sides, count=count)
    return bind(*primals), bind(*primals[:count], *linear_dot)


ad.primitive_jvps[linear_pair_p] = _jvp


def _transpose(cotangents: Sequence[Any], *args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    given = [ad.instantiate_zeros(ct) for ct in cotangents]
    found = linear_pair_p.bind(*args[:count], *given, sides=sides[::-1], count=count)
    wanted = [ad.is_undefined_primal(x) for x in args[count:]]
    return [None] * count + [x if use else None for x, use in zip(found, wanted)]


ad.primitive_transposes[linear_pair_p] = _transpose


def _batched(args: Sequence[Any], dims: Sequence[Any], *, sides: tuple[Side, Side], count: int):
    size = next(x.shape[d] for x, d in zip(args, dims) if d is not None)
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims)]
    axes = [None if d is None else 0 for d in dims[:count]]
    linear = [
        jnp.broadcast_to(x, (size, *x.shape)) if d is None else x for x, d in zip(moved[count:], dims[count:])
    ]
    shared = all(axis is None for axis in axes)

    def every(side: Side, other: Side) -> Side:
        inside = [0] * len(other.shapes)
        over = partial(jax.vmap, axis_size=size)
        value = side.many if shared else over(side.value, in_axes=[*axes, *inside])
        # Several arguments of every lane, or lanes of several arguments, where these are lanes themselves.
        many = over(side.many, in_axes=[*axes, *(1 for _ in inside)], out_axes=1)

        def changed(varied: Sequence[int], flat: Any, some: Any, linear_dot: Any) -> tuple[Any, Any]:
            of_lane = partial(side.changed, varied)
            along_axes = [*axes, *inside], [axes[k] for k in varied], inside
            return over(of_lane, in_axes=along_axes)(list(flat), list(some), list(linear_dot))

        shapes = tuple(jax.ShapeDtypeStruct((size, *s.shape), s.dtype) for s in side.shapes)
        return Side(value, many, changed, shapes)

    pair = every(sides[0], sides[1]), every(sides[1], sides[0])
    found = linear_pair_p.bind(*moved[:count], *linear, sides=pair, count=count)
    return found, [0] * len(found)


batching.primitive_batchers[linear_pair_p] = _batched
