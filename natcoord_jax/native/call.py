"""A program of small arrays as one operation of JAX, which is machine code of our own on the CPU.

Under `jax.vmap` the operation has lanes: the code of one lane is made into code for a group of them. On other
devices, in what is exported, and where llvmlite is missing, XLA computes the same.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend import core as jex
from jax.interpreters import batching, mlir

from natcoord_jax.native import machine
from natcoord_jax.native.arrays import SMALL
from natcoord_jax.native.build import Built, covered, statements_of
from natcoord_jax.native.driver import driver
from natcoord_jax.native.emit import Emitted
from natcoord_jax.native.program import Program, UncoveredError, flattened
from natcoord_jax.xla.tracing import is_concrete

LARGEST = 80_000
"""Statements, about, up to which a program becomes machine code: LLVM takes some 50 microseconds for each."""


class Code:
    """A program and the machine code that has been made of it; compared by identity.

    Args:
        closed: a jaxpr.
        program: the same, flat.
        small: numbers up to which arrays are kept apart, in registers.
    """

    def __init__(self, closed: Any, program: Program, small: int = SMALL):
        self.closed, self.program, self.small = closed, program, small
        self._built: Built | None = None
        self._names: dict[tuple, str] = {}

    def name(self, varies: tuple[bool, ...], lanes: int | None) -> str:
        """Under which XLA knows the code of some lanes.

        Raises:
            UncoveredError: for what there is no rule of.
        """
        if self._built is None:
            self._built = Built(self.program, self.small)
        built, together = self._built, lanes is not None
        width = 1 if lanes is None or lanes == 1 else machine.width(built.graph.statements)
        key = varies, width, together
        if key not in self._names:
            emitted = Emitted(built.graph, width, varies if together else [False] * len(varies))
            text = emitted.text + driver(width, len(built.inputs), len(built.outputs), emitted.work, together)
            self._names[key] = machine.registered(text)
        return self._names[key]


def fits(unknowns: int) -> bool:
    """Whether steps of so many unknowns may become machine code: their Newton matrix is kept in registers."""
    return unknowns**2 <= SMALL and jax.default_backend() == "cpu" and available()


def as_native(otherwise: Callable, function: Callable, *arguments: Any) -> Any:
    """The value of a function of small arrays, by machine code of our own where there is one for it.

    Not differentiable by itself.

    Args:
        otherwise: what finds the value of a function, of its arguments, that there is none for.
        function: of the arguments; it may close over traced values.
        arguments: pytrees of arrays.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    closed, lifted = _lifted(closed)
    code = code_of(closed)
    if code is None:
        return otherwise(function, *arguments)
    leaves = [*lifted, *jax.tree.leaves(arguments)]
    outputs = native_p.bind(*leaves, code=code, varies=(False,) * len(leaves), lanes=None)
    return jax.tree.unflatten(jax.tree.structure(shapes), outputs)


def _lifted(closed: Any) -> tuple[Any, list[Any]]:
    """A jaxpr whose constants are known, and the others, which become its first arguments."""
    pairs = list(zip(closed.jaxpr.constvars, closed.consts))
    known = [is_concrete(x) and isinstance(x, np.ndarray | np.generic) for _, x in pairs]
    kept = [pair for pair, keep in zip(pairs, known) if keep]
    others = [pair for pair, keep in zip(pairs, known) if not keep]
    invars = [*(v for v, _ in others), *closed.jaxpr.invars]
    unnamed = closed.jaxpr.debug_info.with_unknown_names()
    jaxpr = closed.jaxpr.replace(constvars=[v for v, _ in kept], invars=invars, debug_info=unnamed)
    return jex.ClosedJaxpr(jaxpr, [x for _, x in kept]), [x for _, x in others]


def code_of(closed: Any) -> Code | None:
    """What machine code is made of; None for programs that XLA compiles."""
    if not available() or not closed.jaxpr.outvars:
        return None
    try:
        program = flattened(closed)
        covered(program)
    except UncoveredError:
        return None
    if statements_of(program) > LARGEST:
        return None
    return Code(closed, program)


@cache
def available() -> bool:
    """Whether machine code can be made: llvmlite is there; without it that is said once."""
    try:
        machine.binding()
    except ImportError:
        warnings.warn(
            "llvmlite is missing: everything runs, small systems and batches several times slower; "
            "pip install llvmlite",
            stacklevel=2,
        )
        return False
    return True


native_p = jex.Primitive("native")
native_p.multiple_results = True


def _by_xla(*args: Any, code: Code, varies: tuple[bool, ...], lanes: int | None) -> list[Any]:
    function = jex.jaxpr_as_fun(code.closed)
    if lanes is None:
        return function(*args)
    axes = [0 if batched else None for batched in varies]
    return jax.vmap(function, in_axes=axes, axis_size=lanes)(*args)


@native_p.def_impl
def _impl(*args: Any, **params: Any) -> list[Any]:
    return jax.jit(partial(native_p.bind, **params))(*args)


@native_p.def_abstract_eval
def _abstract(*args: Any, code: Code, varies: tuple[bool, ...], lanes: int | None) -> list[Any]:
    batch = () if lanes is None else (lanes,)
    return [ShapedArray((*batch, *x.shape), x.dtype) for x in code.closed.out_avals]


def _batched(
    args: Sequence[Any], dims: Sequence[Any], *, code: Code, varies: tuple[bool, ...], lanes: int | None
):
    size = next(x.shape[d] for x, d in zip(args, dims) if d is not None)
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims)]
    every, now = [], []
    for x, d, before in zip(moved, dims, varies):
        if lanes is not None and (d is not None or before):
            # Lanes of lanes are lanes.
            shape = x.shape[(d is not None) + before :]
            x = x.reshape(size if d is not None else 1, lanes if before else 1, *shape)
            x = jnp.broadcast_to(x, (size, lanes, *shape)).reshape(size * lanes, *shape)
        every.append(x)
        now.append(before or d is not None)
    count = size * (lanes or 1)
    found = native_p.bind(*every, code=code, varies=tuple(now), lanes=count)
    if lanes is not None:
        found = [x.reshape(size, lanes, *x.shape[1:]) for x in found]
    return found, [0] * len(found)


batching.primitive_batchers[native_p] = _batched
_fallback = mlir.lower_fun(_by_xla, multiple_results=True)


def _lowered(ctx: Any, *args: Any, code: Code, varies: tuple[bool, ...], lanes: int | None) -> Any:
    params = {"code": code, "varies": varies, "lanes": lanes}
    if ctx.module_context.lowering_parameters.for_export or lanes == 0:
        return _fallback(ctx, *args, **params)
    try:
        name = code.name(varies, lanes)
    except UncoveredError:
        return _fallback(ctx, *args, **params)
    return jax.ffi.ffi_lowering(name)(ctx, *args)


mlir.register_lowering(native_p, _fallback)
mlir.register_lowering(native_p, _lowered, platform="cpu")
