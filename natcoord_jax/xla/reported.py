"""Derivatives that could not be found, raised where Python sees them.

Within a compiled program a derivative that is none is NaN. Called from Python (`jax.grad` outside of any
`jit`), changes pass from program to program as numbers: where finite ones go into one and NaN comes out, an
error says so. Both ends of a program are an identity that looks at what passes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend import core as jex
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


class DerivativeError(ArithmeticError):
    """A derivative of a run that is none, raised where it is taken outside of `jit`; within, it is NaN."""


@dataclass
class Passage:
    """Of changes through a program, forth or back.

    To programs that are compared, one is as another.

    Attributes:
        where: name of the function, for the message.
        entering: whether changes go in still.
        sound: whether those that went in were finite.
    """

    where: str
    entering: bool = field(default=False, compare=False)
    sound: bool = field(default=False, compare=False)

    def __hash__(self) -> int:
        return hash(self.where)

    def enter(self, values: Any) -> Any:
        """What goes in, as it is."""
        return _through(values, self, True)

    def leave(self, values: Any) -> Any:
        """What comes out, as it is."""
        return _through(values, self, False)

    def look(self, first: bool, change: Array) -> None:
        """See a change that goes in, or one that comes out after all of these.

        Raises:
            DerivativeError: if the latter is no number, the former being some.
        """
        finite = bool(np.all(np.isfinite(change)))
        if first:
            self.sound = finite and (self.sound or not self.entering)
        elif self.sound and not finite:
            raise DerivativeError(
                f"{self.where}: a derivative is not a number, though what it is of went well: linearised "
                "equations cannot be solved there, or a function in them has no derivative. Look for a "
                "position where constraints depend on each other, and for sqrt, norms, quotients and `where` "
                "at zero in laws and functions of your own; or start a little beside. Frequencies that "
                "coincide have none where a change splits them; in reverse mode, functions of them need the "
                "same slope by each, as their mean has. Within jit it is NaN"
            )
        self.entering = first


def _through(values: Any, passage: Passage, entering: bool) -> Any:
    def one(x: Any) -> Any:
        if not isinstance(x, Tracer) or not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return passage_p.bind(x, passage=passage, entering=entering, change=None)

    return jax.tree.map(one, values)


passage_p = jex.Primitive("passage")


@passage_p.def_impl
def _impl(value: Any, *, passage: Passage, entering: bool, change: str | None) -> Any:
    if change is not None:
        # Tangents enter where the program begins, cotangents where it ends.
        passage.look(entering == (change == "forward"), value)
    return value


@passage_p.def_abstract_eval
def _abstract(value: Any, **_: Any) -> Any:
    return ShapedArray(value.shape, value.dtype)


mlir.register_lowering(passage_p, lambda _, value, **__: [value])


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, change: str | None, **at: Any):
    value, moved = passage_p.bind(*primals, change=change, **at), tangents[0]
    zero = isinstance(moved, ad.Zero)
    return value, moved if zero else passage_p.bind(moved, change="forward", **at)


ad.primitive_jvps[passage_p] = _jvp


def _transpose(cotangent: Any, _: Any, *, change: str | None, **at: Any) -> list[Any]:
    zero = isinstance(cotangent, ad.Zero)
    return [cotangent if zero else passage_p.bind(cotangent, change="back", **at)]


ad.primitive_transposes[passage_p] = _transpose


def _batched(values: Sequence[Any], dims: Sequence[Any], **at: Any):
    return passage_p.bind(*values, **at), dims[0]


batching.primitive_batchers[passage_p] = _batched
