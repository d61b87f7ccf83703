"""Kinds of arguments that are numbers."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from natcoord_jax.core.kinds import Kind, is_other, short


def array_of(value: Any) -> Any:
    """Numbers as an array or something with a shape; None for what is no array of real numbers."""
    if isinstance(value, bool | np.bool_ | str | bytes) or value is None:
        return None
    if isinstance(value, list | tuple):
        if any(isinstance(x, jax.Array | list | tuple) for x in value):
            parts = [array_of(x) for x in value]
            if any(x is None for x in parts) or len({x.shape for x in parts}) > 1:
                return None
            if any(isinstance(x, Tracer) for x in parts):
                return jax.ShapeDtypeStruct((len(parts), *parts[0].shape), jnp.result_type(float))
            if any(isinstance(x, jax.ShapeDtypeStruct) for x in parts):
                return jax.ShapeDtypeStruct((len(parts), *parts[0].shape), np.dtype(float))
            value = [np.asarray(x) for x in parts]
        if any(isinstance(x, bool | np.bool_ | str) for x in value):
            return None
    if not isinstance(value, jax.Array | jax.ShapeDtypeStruct):
        try:
            value = np.asarray(value)
        except (TypeError, ValueError):
            return None
    return value if value.dtype.kind in "iuf" or jnp.issubdtype(value.dtype, jnp.floating) else None


def values_of(array: Any) -> np.ndarray | None:
    """Values of an array; None while there are none."""
    traced = isinstance(array, Tracer | jax.ShapeDtypeStruct)
    return None if traced else np.asarray(array)


def shown(values: np.ndarray) -> str:
    """Numbers in a message; of many, how many."""
    if values.ndim == 0:
        return repr(values.item())
    return str(values.tolist()) if values.size <= 9 else f"some of {values.size} numbers"


@dataclasses.dataclass(frozen=True)
class Numbers(Kind):
    """An array of finite numbers.

    Attributes:
        shape: with None for any length, or "..." first for any leading axes.
        sign: "", "positive" or "not negative".
        infinite: whether infinities pass.
        instead: advice that follows what is wanted.
    """

    shape: tuple[Any, ...] = ()
    sign: str = ""
    infinite: bool = False
    instead: str = ""
    measured: bool = True

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Its shape and sign."""
        unsigned = "" if self.infinite else "finite "
        size = {"": unsigned, "positive": "positive ", "not negative": ""}[self.sign]
        rest = " that is not negative" if self.sign == "not negative" else ""
        if self.shape == ():
            return f"a {size}number{rest}{self.instead}"
        shape = ", ".join("n" if n is None else str(n) for n in self.shape) + "," * (len(self.shape) == 1)
        return f"{size}numbers of shape ({shape}){rest.replace('is', 'are')}{self.instead}"

    def complaint(self, value: Any) -> str | None:
        """Whether it is such an array."""
        if type(value) is float and self.shape == () and math.isfinite(value) and self._signed(value):
            return None  # the usual case, without an array
        array = array_of(value)
        if array is None:
            return is_other(value)
        if not self._fits(array.shape):
            return f"is {short(value)}" if array.shape == () else f"has shape {array.shape}"
        known = values_of(array)
        if known is None:
            return None
        if not (~np.isnan(known) if self.infinite else np.isfinite(known)).all():
            return f"is not finite: {shown(known)}"
        if self.sign and not self._signed(known).all():
            return f"is {shown(known)}"
        return None

    def _signed(self, value: Any) -> Any:
        return True if not self.sign else value > 0 if self.sign == "positive" else value >= 0

    def _fits(self, shape: tuple[int, ...]) -> bool:
        wanted, found = self.shape, shape
        if wanted[:1] == ("...",):
            wanted = wanted[1:]
            found = found[len(found) - len(wanted) :] if len(found) >= len(wanted) else (-1,)
        return len(wanted) == len(found) and all(a in (None, b) for a, b in zip(wanted, found))


def Number(sign: str = "", *, infinite: bool = False, instead: str = "") -> Numbers:
    """One number."""
    return Numbers((), sign, infinite, instead)


def Vector(length: int | None = 3) -> Numbers:
    """Numbers in a row."""
    return Numbers((length,))


@dataclasses.dataclass(frozen=True)
class Directions(Kind):
    """Components of a direction: three numbers that are not all zero."""

    wanted: str = "finite numbers of shape (3,), not all zero: a direction"
    measured: bool = True

    def complaint(self, value: Any) -> str | None:
        """Whether it has a length."""
        wrong = Numbers((3,)).complaint(value)
        known = None if wrong else values_of(array_of(value))
        return "is zero" if known is not None and not np.any(known) else wrong


@dataclasses.dataclass(frozen=True)
class Whole(Kind):
    """A whole number, of Python or NumPy: it decides about the program."""

    least: int | None = None
    most: int | None = None

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Its range."""
        if self.most is not None:
            return f"a whole number from {self.least} to {self.most}"
        if self.least == 1:
            return "a positive whole number"
        return "a whole number" + ("" if self.least is None else f", {self.least} or more")

    def complaint(self, value: Any) -> str | None:
        """Whether it is one in range."""
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            if not isinstance(value, jax.Array | np.ndarray) or isinstance(value, Tracer):
                return is_other(value)
            if value.ndim or value.dtype.kind not in "iu":
                return is_other(value)
        low, high = self.least, self.most
        inside = (low is None or int(value) >= low) and (high is None or int(value) <= high)
        return None if inside else is_other(value)


COMPONENTS = Vector(3)
