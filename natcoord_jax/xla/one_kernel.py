"""Run a loop of small operations as one function of machine code, on the CPU.

XLA's CPU backend calls a kernel for every fusion, at some forty nanoseconds each. A step of a small system
is a few hundred kernels of a few dozen numbers: the calls cost several times what the arithmetic does. A
call that carries the attribute `xla_cpu_small_call` is compiled into one function instead, loops included
(the compiler's own pass does so with tiny loops). That works for programs without calls into libraries,
and only if every argument is used. Programs of large arrays gain nothing by it and are left as they are; in
others

- small products are rewritten as sums, scatters as updates of slices, long reductions as loops,
- a program that holds anything else than the operations known to work is left as it is,
- all arguments travel in one array.

Other backends, and programs left as they are, compute the same, at the price of the calls.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core as jex
from jaxtyping import Array, Float

from natcoord_jax.xla import rewriting
from natcoord_jax.xla.kernels import KERNEL
from natcoord_jax.xla.rewriting import Flat, known, mean_size, operations

try:
    from jax.experimental.scheduling_groups import xla_metadata_call as _attributed
except ImportError:  # an experimental module of JAX: without it everything runs, only slower
    _attributed = None

LARGEST = 6800
"""Operations of a program that still compiles quickly in one piece: the time grows faster than the size."""

WIDE = 300
"""Numbers that an operation finds on average from which on calls cost next to nothing beside it: the program
compiles in two thirds of the time or less as it is, its products by a library. Forty arms of a star run as
fast (means of 150 and 560), blocks of 32 bricks 1.4 and 1.9 times as fast (450 to 6700)."""

ATTRIBUTES = {KERNEL: "true", "inlineable": "false"}
"""Compiled as one function; kept as a call until then."""


def as_one_kernel(function: Callable, *arguments: Any) -> Any:
    """The value of a function, computed in one kernel where that is possible.

    Not differentiable by itself.

    Args:
        function: of the arguments; it may close over traced values.
        arguments: pytrees of arrays.
    """
    if not on_cpu():
        return function(*arguments)
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    wide = mean_size(program.jaxpr) > WIDE
    return _flat(_as_it_is if wide else _kernel, program, shapes, arguments)


def _as_it_is(function: Callable) -> Callable:
    return function


def in_few_kernels(function: Callable, *arguments: Any) -> Any:
    """The value of a function, in one kernel; in one for each of its parts if that would be too large.

    Parts are traced once, whichever it is. Not differentiable by itself.

    Args:
        function: of what calls a part with its arguments, and of the arguments. Parts are hashable functions
            of pytrees of arrays that close over no traced values.
        arguments: pytrees of arrays.
    """
    if not on_cpu():
        return function(plainly, *arguments)
    parts: dict[Any, tuple[Any, Any]] = {}

    def traced(part: Callable, given: tuple) -> tuple[Any, Any]:
        leaves, tree = jax.tree.flatten(given)
        key = part, tree, *map(jax.typeof, leaves)
        if key not in parts:
            parts[key] = jax.make_jaxpr(part, return_shape=True)(*given)
        return parts[key]

    def written_out(part: Callable, *given: Any) -> Any:
        return _flat(_as_it_is, *traced(part, given), given)

    def apart(part: Callable, *given: Any) -> Any:
        return _flat(_kernel, *traced(part, given), given)

    whole = partial(function, written_out)
    program, shapes = jax.make_jaxpr(whole, return_shape=True)(*arguments)
    if mean_size(program.jaxpr) > WIDE:
        return _flat(_as_it_is, program, shapes, arguments)
    if operations(program.jaxpr) > LARGEST:
        return function(apart, *arguments)
    return _flat(_kernel, program, shapes, arguments)


def plainly(function: Callable, *arguments: Any) -> Any:
    """The value of a function: in the kernel of its caller, if that is in one."""
    return function(*arguments)


def scan_in_one_kernel(body: Callable, start: Any, given: Any, reverse: bool = False) -> tuple[Any, Any]:
    """`jax.lax.scan` in one kernel where that is possible and quickly compiled, else as it is.

    Under vmap it is a scan as usual: kernels of its operations on all lanes are large enough to be worth
    their calls. Not differentiable by itself.
    """

    def scan(start: Any, given: Any) -> tuple[Any, Any]:
        return jax.lax.scan(body, start, given, reverse=reverse)

    if not on_cpu():
        return scan(start, given)
    program, shapes = jax.make_jaxpr(scan, return_shape=True)(start, given)
    if operations(program.jaxpr) > LARGEST:
        return scan(start, given)
    return _flat(partial(_kernel, lanes_too=False), program, shapes, (start, given))


def lane_by_lane(function: Callable, *arguments: Any) -> Any:
    """The value of a function; under vmap on the CPU, lanes are worked through one after the other.

    Several at once would wait for the slowest of them and take twice as long to compile, and what they need
    would leave the fastest cache. Only the smallest systems, of one or two bodies, would gain by it.
    """
    if not on_cpu():
        return function(*arguments)
    return _flat(_in_turn, *jax.make_jaxpr(function, return_shape=True)(*arguments), arguments)


REFUSALS = ("UNIMPLEMENTED", "Failed to materialize symbols")
"""What the compiler says when it cannot make one kernel of a program."""

_refused: list[str] = []
"""What the compiler said when it could not do it, see `give_up`."""


def give_up(reason: str) -> bool:
    """Compile as usual from now on, in this process, if that is what the compiler could not do.

    Args:
        reason: what the compiler said.

    Returns:
        Whether anything has changed, so that it is worth to try again.
    """
    if _refused or not any(words in reason for words in REFUSALS):
        return False
    _refused.append(reason)
    jax.clear_caches()
    return True


def on_cpu() -> bool:
    """Whether loops of small operations are made one kernel: on the CPU, if the compiler can do it."""
    return jax.default_backend() == "cpu" and _attributed is not None and not _refused


def _flat(transform: Callable, program: Any, shapes: Any, arguments: tuple) -> Any:
    """A transformed function of flat arguments, among them what it closes over."""
    flat = Flat(program)
    outputs = transform(flat)(*flat.consts, *jax.tree.leaves(arguments))
    return jax.tree.unflatten(jax.tree.structure(shapes), outputs)


def _kernel(function: Callable, lanes_too: bool = True) -> Callable:
    """A flat function as one kernel, whatever the number of lanes, or of one lane only."""

    @jax.custom_batching.custom_vmap
    def call(*flat: Any) -> list[Any]:
        return _in_one_kernel(function, flat)

    @call.def_vmap
    def by_lanes(axis_size: int, in_batched: Sequence[bool], *flat: Any) -> tuple[list[Any], list[bool]]:
        axes = [0 if batched else None for batched in in_batched]
        every = jax.vmap(function, in_axes=axes, axis_size=axis_size)
        outputs = (_kernel(every) if lanes_too else every)(*flat)
        return outputs, [True] * len(outputs)

    return call


def _in_turn(function: Callable) -> Callable:
    """A flat function that works through lanes one after the other."""

    @jax.custom_batching.custom_vmap
    def call(*flat: Any) -> list[Any]:
        return function(*flat)

    @call.def_vmap
    def by_lanes(axis_size: int, in_batched: Sequence[bool], *flat: Any) -> tuple[list[Any], list[bool]]:
        def every(*flat: Any) -> list[Any]:
            def lane(own: list[Any]) -> list[Any]:
                rest = iter(own)
                return function(*(next(rest) if batched else x for x, batched in zip(flat, in_batched)))

            return jax.lax.map(lane, [x for x, batched in zip(flat, in_batched) if batched])

        outputs = _in_turn(every)(*flat)
        return outputs, [True] * len(outputs)

    return call


def _in_one_kernel(function: Callable, flat: Sequence[Any]) -> list[Any]:
    # After vmap, since small reductions of one lane are large ones of many.
    whole: Any = function
    if not isinstance(function, Flat):
        whole = Flat(jax.make_jaxpr(function)(*flat))
        flat = (*whole.consts, *flat)
    kinds = [(jnp.shape(x), jnp.result_type(x)) for x in flat]
    if not known(whole.program.jaxpr, rewriting.KNOWN | rewriting.REWRITTEN):
        return whole(*flat)
    program = jax.make_jaxpr(whole.rewritten)(*flat)
    packable = all(jnp.issubdtype(dtype, jnp.number) or dtype == jnp.bool for _, dtype in kinds)
    empty = all(math.prod(shape) == 0 for shape, _ in kinds)
    if _attributed is None or not packable or empty or not known(program.jaxpr):
        return jex.jaxpr_as_fun(program)(*flat)

    def unpacked(packed: Float[Array, " _"]) -> list[Any]:
        return jex.jaxpr_as_fun(program)(*apart(packed, kinds))

    kernel: Callable = _attributed(unpacked, **ATTRIBUTES)  # pyright: ignore[reportAssignmentType]
    return kernel(in_one_array([jnp.asarray(x) for x in flat]))


def in_one_array(arrays: Sequence[Array]) -> Float[Array, " _"]:
    """All arrays in one; `apart` takes them out again."""
    return jnp.concatenate([jnp.zeros(0), *(_recast(x, jnp.float64).reshape(-1) for x in arrays)])


def apart(packed: Float[Array, " _"], kinds: Sequence[tuple[tuple[int, ...], Any]]) -> list[Array]:
    """The arrays that are in one, of these shapes and types."""
    arrays, position = [], 0
    for shape, dtype in kinds:
        size = math.prod(shape)
        arrays.append(_recast(packed[position : position + size], dtype).reshape(shape))
        position += size
    return arrays


def _recast(x: Array, dtype: Any) -> Array:
    """The same numbers as doubles, or back; the same bits where doubles cannot hold all of them."""
    other = dtype if x.dtype == jnp.float64 else x.dtype
    if other != jnp.float64 and other.itemsize == 8:
        return jax.lax.bitcast_convert_type(x, dtype)
    return x.astype(dtype)
