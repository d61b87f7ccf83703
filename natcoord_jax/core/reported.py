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

from natcoord_jax.core.results import DerivativeError


@dataclass
class Passage:
    """Of changes through a program, forth or back.

    To programs that are compared, one is as another.

    Attributes:
        where: name of the function, for the message.
        sound: whether what went in last was finite.
    """

    where: str
    sound: bool = field(default=False, compare=False)

    def __hash__(self) -> int:
        return hash(self.where)

    def enter(self, values: Any) -> Any:
        """What goes in, as it is."""
        return _through(values, self, True)

    def leave(self, values: Any) -> Any:
        """What comes out, as it is."""
        return _through(values, self, False)

    def look(self, first: bool, changes: Sequence[Array]) -> None:
        """See the changes that go in, or those that come out after them.

        Raises:
            DerivativeError: if the latter are no numbers, the former being some.
        """
        finite = all(np.all(np.isfinite(x)) for x in changes)
        if not first and self.sound and not finite:
            raise DerivativeError(
                f"{self.where}: a derivative is not a number, though what it is of went well: linearised "
                "equations cannot be solved there, or a function in them has no derivative. Look for a "
                "position where constraints depend on each other, and for sqrt, norms, quotients and `where` "
                "at zero in laws and functions of your own; or start a little beside. Within jit it is NaN"
            )
        self.sound = first and finite


def _through(values: Any, passage: Passage, entering: bool) -> Any:
    leaves, structure = jax.tree.flatten(values)
    moving = [
        k for k, x in enumerate(leaves) if isinstance(x, Tracer) and jnp.issubdtype(x.dtype, jnp.inexact)
    ]
    if not moving:
        return values
    found = passage_p.bind(*(leaves[k] for k in moving), passage=passage, entering=entering, change=None)
    for k, x in zip(moving, found):
        leaves[k] = x
    return jax.tree.unflatten(structure, leaves)


passage_p = jex.Primitive("passage")
passage_p.multiple_results = True


@passage_p.def_impl
def _impl(*values: Any, passage: Passage, entering: bool, change: str | None) -> list[Any]:
    if change is not None:
        # Tangents enter where the program begins, cotangents where it ends.
        passage.look(entering == (change == "forward"), values)
    return list(values)


@passage_p.def_abstract_eval
def _abstract(*values: Any, **_: Any) -> list[Any]:
    return [ShapedArray(x.shape, x.dtype) for x in values]


mlir.register_lowering(passage_p, lambda _, *values, **__: list(values))


def _of_those_that_change(changes: Sequence[Any], **at: Any) -> list[Any]:
    found = iter(passage_p.bind(*(x for x in changes if not isinstance(x, ad.Zero)), **at))
    return [x if isinstance(x, ad.Zero) else next(found) for x in changes]


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, change: str | None, **at: Any):
    values = passage_p.bind(*primals, change=change, **at)
    return values, _of_those_that_change(tangents, change="forward", **at)


ad.primitive_jvps[passage_p] = _jvp


def _transpose(cotangents: Sequence[Any], *_: Any, change: str | None, **at: Any) -> list[Any]:
    return _of_those_that_change(cotangents, change="back", **at)


ad.primitive_transposes[passage_p] = _transpose


def _batched(values: Sequence[Any], dims: Sequence[Any], **at: Any):
    return passage_p.bind(*values, **at), dims


batching.primitive_batchers[passage_p] = _batched
