"""Kinds of arguments that are numbers."""

import dataclasses
import math
import operator
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from natcoord_jax.core.kinds import Either, Kind, is_other, short

ROUNDING = 1e-9
"""Relative asymmetry and relative negative eigenvalue allowed in a matrix."""


def array_of(value: Any) -> Any:
    """Numbers as an array or something with a shape; None for what is no array of real numbers."""
    if isinstance(value, bool | np.bool_ | str | bytes) or value is None:
        return None
    if isinstance(value, list | tuple):
        if any(isinstance(x, jax.Array | list | tuple) for x in value):
            parts = [array_of(x) for x in value]
            if any(x is None for x in parts) or len({x.shape for x in parts}) > 1:
                return None
            if any(isinstance(x, Tracer | jax.ShapeDtypeStruct) for x in parts):
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
        above: they are larger than this.
        below: they are smaller than this.
        most: the largest that they may be.
    """

    shape: tuple[Any, ...] = ()
    sign: str = ""
    infinite: bool = False
    instead: str = ""
    measured: bool = True
    above: float | None = None
    below: float | None = None
    most: float | None = None

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Its shape and range."""
        unsigned = "" if self.infinite else "finite "
        size = {"": unsigned, "positive": "positive ", "not negative": ""}[self.sign]
        ends = ("above", self.above), ("below", self.below), ("up to", self.most)
        bounds = [f"{word} {limit:g}" for word, limit in ends if limit is not None]
        bounds = [f"that is {self.sign}"] * (self.sign == "not negative") + bounds
        limits = " " * bool(bounds) + " and ".join(bounds)
        if self.shape == ():
            return f"a {size}number{limits}{self.instead}"
        shape = ", ".join("n" if n is None else str(n) for n in self.shape) + "," * (len(self.shape) == 1)
        return f"{size}numbers of shape ({shape}){limits.replace('is', 'are')}{self.instead}"

    def complaint(self, value: Any) -> str | None:
        """Whether it is such an array."""
        if type(value) is float and self.shape == () and self.includes(value):
            return None  # the usual case, without an array
        array = array_of(value)
        if array is None:
            return is_other(value)
        wanted, shape = self.shape, array.shape
        if wanted[:1] == ("...",):
            wanted = wanted[1:]
            shape = shape[len(shape) - len(wanted) :] if len(shape) >= len(wanted) else (-1,)
        if len(wanted) != len(shape) or any(a not in (None, b) for a, b in zip(wanted, shape)):
            return f"is {short(value)}" if array.shape == () else f"has shape {array.shape}"
        values = values_of(array)
        return None if values is None else self.misfit(values)

    def misfit(self, values: np.ndarray) -> str | None:
        """What is wrong with numbers of any shape, if something is."""
        wrong = np.unique(values[~np.broadcast_to(self.includes(values), values.shape)])
        if not wrong.size:
            return None
        finite = np.all(~np.isnan(wrong) if self.infinite else np.isfinite(wrong))
        wrong = wrong[0] if wrong.size == 1 else wrong
        return f"is {shown(wrong)}" if finite else f"is not finite: {shown(wrong)}"

    def includes(self, values: Any) -> Any:
        """Which of some numbers are in the range; not a number is in none."""
        inside = values == values if self.infinite else abs(values) < math.inf
        if self.sign:
            inside = inside & (values > 0 if self.sign == "positive" else values >= 0)
        for limit, within in (self.above, operator.gt), (self.below, operator.lt), (self.most, operator.le):
            inside = inside if limit is None else inside & within(values, limit)
        return inside

    @property
    def bounded(self) -> bool:
        """Whether it excludes more than what is not finite."""
        return bool(self.sign) or (self.above, self.below, self.most) != (None, None, None)

    def masked(self, value: Any) -> Any:
        """With not a number for what is traced and out of the range; what has no range is left as it is."""
        return masked(value, self.includes) if self.bounded else value


def range_of(kind: Any) -> Numbers | None:
    """The numbers that a kind is of; of several its first."""
    kinds = kind.kinds if isinstance(kind, Either) else (kind,)
    return next((x for x in kinds if isinstance(x, Numbers)), None)


def masked(value: Any, includes: Callable[[Any], Any]) -> Any:
    """Numbers with not a number for those that are traced and not included."""
    return jax.tree.map(lambda x: jnp.where(includes(x), x, jnp.nan) if isinstance(x, Tracer) else x, value)


def Number(sign: str = "", *, infinite: bool = False, instead: str = "", **limits: float) -> Numbers:
    """One number."""
    return Numbers((), sign, infinite, instead, True, **limits)


def Vector(length: int | None = 3) -> Numbers:
    """Numbers in a row."""
    return Numbers((length,))


@dataclasses.dataclass(frozen=True)
class Definite(Numbers):
    """A symmetric matrix without negative eigenvalues, in the unit of each of its rows, up to round-off."""

    bounded: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Its shape."""
        return f"a symmetric matrix of shape {self.shape} without negative eigenvalues"

    def misfit(self, values: np.ndarray) -> str | None:
        """Which of these it is not."""
        if not np.isfinite(values).all() or np.all(self.includes(values)):
            return super().misfit(values)
        gap = np.max(np.abs(values - np.swapaxes(values, -1, -2)))
        even = gap <= ROUNDING * np.max(np.abs(values))
        return "has negative eigenvalues" if even else f"is not symmetric (by {gap:.2e})"

    def includes(self, values: Any) -> Any:
        """Of each of some matrices, whether it is one."""
        xp = jnp if isinstance(values, Tracer) else np
        finite = xp.all(xp.isfinite(values), (-1, -2), keepdims=True)
        values = xp.where(finite, values, 0.0)
        diagonal = xp.diagonal(values, axis1=-2, axis2=-1)
        size = xp.sqrt(xp.where(diagonal == 0, 1.0, abs(diagonal)))
        scaled = values / (size[..., None] * size[..., None, :])
        odd = xp.max(abs(scaled - xp.swapaxes(scaled, -1, -2)), (-1, -2))
        least = xp.linalg.eigvalsh(scaled)[..., 0]
        return finite & ((odd <= ROUNDING) & (least >= -ROUNDING))[..., None, None]


@dataclasses.dataclass(frozen=True)
class Directions(Numbers):
    """Components of directions: numbers that are not all zero."""

    shape: tuple[Any, ...] = (3,)
    bounded: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleVariableOverride]
    wanted: ClassVar[str] = "finite numbers, not all zero: a direction"  # pyright: ignore

    def misfit(self, values: np.ndarray) -> str | None:
        """Whether they have a length."""
        return super().misfit(values) and ("is zero" if np.isfinite(values).all() else "is not finite")

    def includes(self, values: Any) -> Any:
        """Whether they are finite and have a length."""
        return (abs(values) < math.inf).all(-1, keepdims=True) & (values != 0).any(-1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class Rotations(Numbers):
    """Rotation matrices."""

    shape: tuple[Any, ...] = (3, 3)
    bounded: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleVariableOverride]
    wanted: ClassVar[str] = "a rotation: orthonormal and right-handed, by a matrix or a quaternion"  # pyright: ignore

    def misfit(self, values: np.ndarray) -> str | None:
        """How far they are from being rotations."""
        if not np.isfinite(values).all() or np.all(self.includes(values)):
            return super().misfit(values)
        least = np.min(np.linalg.det(values))
        return (
            f"is no rotation (R R^T differs from 1 by {_stretch(values).max():.1e}, determinant {least:+.3f})"
        )

    def includes(self, values: Any) -> Any:
        """Whether they keep lengths and hands."""
        linalg: Any = (jnp if isinstance(values, Tracer) else np).linalg
        return ((_stretch(values) <= 1e-8) & (linalg.det(values) > 0))[..., None, None]


def _stretch(matrix: Any) -> Any:
    """How far matrices are from keeping lengths."""
    return abs(matrix @ matrix.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))


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
