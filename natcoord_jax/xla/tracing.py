"""Whether something is being traced, and functions that are traced once."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jax.extend.core import Primitive, get_opaque_trace_state, jaxpr_as_fun
from jax.interpreters import batching, partial_eval


def is_concrete(*values: Any) -> bool:
    """Whether none of the values is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


with eval_context():
    TOP_LEVEL = get_opaque_trace_state()
    """State of JAX outside of all transformations, even if this is imported inside of one."""


def at_top_level(*values: Any) -> bool:
    """Whether nothing is being traced: neither the values nor the function around them."""
    return get_opaque_trace_state() == TOP_LEVEL and is_concrete(values)


@cache
def _making() -> type:
    """The class of traces that make a program."""
    found: list[type] = []
    with eval_context():
        jax.make_jaxpr(lambda x: found.append(type(x._trace)))(np.zeros(()))
    return found[0]


def in_program(*values: Any) -> bool:
    """Whether a program is being made, of the values or around; `jax.vmap` and `jax.grad` alone make none.

    Within these each operation is a program of its own.
    """
    tracers = [x for x in jax.tree.leaves(values) if isinstance(x, Tracer)]
    for trace in (get_opaque_trace_state()._trace_ref(), *(x._trace for x in tracers)):
        while trace is not None:
            if isinstance(trace, _making()):
                return True
            trace = getattr(trace, "parent_trace", None)
    return False


@cache
def _lane() -> tuple[type, Any]:
    """The class of values within `jax.vmap`, and what an axis without a name is called there."""
    found: list[Any] = []
    with eval_context():
        jax.vmap(found.append)(np.zeros(1))
    return type(found[0]), found[0]._trace.axis_data.name


def in_lanes(values: Sequence[Any]) -> bool:
    """Whether some values are lanes of `jax.vmap` without a name, and nothing else is done with any."""
    return not in_program(values) and _are_lanes(values)


def _are_lanes(values: Sequence[Any]) -> bool:
    if is_concrete(values):
        return False
    kind, unnamed = _lane()
    lanes = [isinstance(x, kind) and x._trace.axis_data.name is unnamed for x in values]
    inner = [x.val if lane else x for x, lane in zip(values, lanes)]
    return any(lanes) and (is_concrete(inner) or _are_lanes(inner))


def at_once(function: Callable[[Sequence[Any], tuple], Sequence[Any]], values: Sequence[Any]) -> list[Any]:
    """What a function gives for all lanes of some values at once, where they are `in_lanes`.

    Args:
        function: of the values with all lanes, and of the axis of these in each, to arrays with lanes along
            the first axis.
        values: arrays, some of them in lanes.
    """
    return _at_once.bind(*values, function=function)


_at_once = Primitive("at_once")
_at_once.multiple_results = True


def _of_all(values: Sequence[Any], axes: Sequence[Any], *, function: Callable) -> tuple[list, list]:
    found = list(function(values, tuple(axes)))
    return found, [0] * len(found)


batching.primitive_batchers[_at_once] = _of_all


def traced_once(function: Callable, *examples: Any) -> tuple[Callable, Any]:
    """A function of arguments like these examples, traced here and now, and zeros like what it gives.

    A loop that starts with zeros of the shapes of what it makes would be traced for these a second time.
    """
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
    run, structure = jaxpr_as_fun(program), jax.tree.structure(shapes)

    def call(*arguments: Any) -> Any:
        return jax.tree.unflatten(structure, run(*jax.tree.leaves(arguments)))

    return call, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def depends(function: Callable, *arguments: Any) -> bool:
    """Whether what a function gives depends on any of its arguments, as its program has it."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    return any(partial_eval.dce_jaxpr(program, [True] * len(program.outvars))[1])


def is_numeric(array: Any) -> bool:
    """Not so are keys of random numbers."""
    return jnp.issubdtype(array.dtype, np.number) or jnp.issubdtype(array.dtype, np.bool_)
