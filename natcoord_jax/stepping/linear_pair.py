"""A linear function that comes with its transpose, each computed in its own way.

JAX transposes a linear program operation by operation. Where the transpose has a better program of its own,
`apply` binds both together; derivatives with respect to what the function depends on nonlinearly are taken
of plain programs, so that second derivatives are exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend import core as jex
from jax.interpreters import ad, batching, mlir


@dataclass(frozen=True, eq=False)
class Side:
    """A linear function of flat arguments after flat residuals.

    Attributes:
        fast: computes it.
        plain: the same as a program that JAX can differentiate.
        shapes: of its outputs.
    """

    fast: Callable
    plain: Callable
    shapes: tuple[jax.ShapeDtypeStruct, ...]


def apply(forward: Callable, backward: Callable, residuals: Any, arguments: Any, outputs: Any) -> Any:
    """Value of a linear function whose transpose is known.

    Args:
        forward: function of (residuals, arguments), linear in the arguments, differentiable by JAX.
        backward: its transpose, a function of (residuals, cotangents of the outputs). Neither closes over
            traced values.
        residuals: pytree of arrays.
        arguments: pytree of arrays.
        outputs: pytree of arrays or shapes like the value.
    """
    res, res_tree = jax.tree.flatten(residuals)
    lin, lin_tree = jax.tree.flatten(arguments)
    out, out_tree = jax.tree.flatten(outputs)
    count = len(res)

    def forwards(*flat: Any) -> list[Any]:
        given = jax.tree.unflatten(res_tree, flat[:count]), jax.tree.unflatten(lin_tree, flat[count:])
        return jax.tree.leaves(forward(*given))

    def backwards(*flat: Any) -> list[Any]:
        given = jax.tree.unflatten(res_tree, flat[:count]), jax.tree.unflatten(out_tree, flat[count:])
        return jax.tree.leaves(backward(*given))

    def transposed(*flat: Any) -> list[Any]:
        fixed, cotangents = flat[:count], flat[count:]
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in lin]
        return list(jax.linear_transpose(lambda *x: forwards(*fixed, *x), *shapes)(list(cotangents)))

    sides = (
        Side(forwards, forwards, _shapes(out)),
        Side(backwards, transposed, _shapes(lin)),
    )
    return jax.tree.unflatten(out_tree, linear_pair_p.bind(*res, *lin, sides=sides, count=count))


def _shapes(values: Sequence[Any]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in values)


linear_pair_p = jex.Primitive("linear_pair")
linear_pair_p.multiple_results = True


@linear_pair_p.def_impl
def _impl(*args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    return sides[0].fast(*args)


@linear_pair_p.def_abstract_eval
def _abstract(*args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    return [ShapedArray(s.shape, s.dtype) for s in sides[0].shapes]


def _lowered(*args: Any, sides: tuple[Side, Side], count: int) -> list[Any]:
    return sides[0].fast(*args)


mlir.register_lowering(linear_pair_p, mlir.lower_fun(_lowered, multiple_results=True))


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, sides: tuple[Side, Side], count: int):
    bind = partial(linear_pair_p.bind, sides=sides, count=count)
    changed = [ad.instantiate_zeros(t) for t in tangents[count:]]
    values, changes = bind(*primals), bind(*primals[:count], *changed)
    varied = [k for k, t in enumerate(tangents[:count]) if not isinstance(t, ad.Zero)]
    varied = [k for k in varied if jnp.issubdtype(jnp.result_type(primals[k]), jnp.inexact)]
    if varied:

        def of_residuals(*some: Any) -> list[Any]:
            every = list(primals)
            for k, x in zip(varied, some):
                every[k] = x
            return sides[0].plain(*every)

        at, along = tuple(primals[k] for k in varied), tuple(tangents[k] for k in varied)
        more = jax.jvp(of_residuals, at, along)[1]
        changes = [a + b for a, b in zip(changes, more)]
    return values, changes


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

    def every(side: Side, other: Side) -> Side:
        inside = [*axes, *(0 for _ in other.shapes)]
        return Side(
            jax.vmap(side.fast, in_axes=inside),
            jax.vmap(side.plain, in_axes=inside),
            tuple(jax.ShapeDtypeStruct((size, *s.shape), s.dtype) for s in side.shapes),
        )

    pair = every(sides[0], sides[1]), every(sides[1], sides[0])
    found = linear_pair_p.bind(*moved[:count], *linear, sides=pair, count=count)
    return found, [0] * len(found)


batching.primitive_batchers[linear_pair_p] = _batched
