"""Which callables there are among arguments, and which of them read what may change.

A function, an object that can be called, a module with methods that no library has written.
"""

import dataclasses
import sys
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from inspect import unwrap
from types import FunctionType
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import numpy as np

from natcoord_jax.xla.programs import LIBRARIES, Signature, signature

M = TypeVar("M", bound=eqx.Module)


class Function(eqx.Module):
    """A function in a module, as a static part of it.

    Attributes:
        function: the function.
        called: how it is called, as far as it is known beforehand.
    """

    function: Callable = eqx.field(static=True)
    called: tuple[Signature, ...] = eqx.field(static=True, default=())

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The function's value."""
        return self.function(*args, **kwargs)

    @classmethod
    def of(cls, value: Any, *examples: Any) -> Any:
        """A callable wrapped, with examples of its arguments; a module or no callable as it is."""
        if isinstance(value, eqx.Module) or not callable(value):
            return value
        return cls(value, (signature("", (examples, {}))[0],) if examples else ())


def replace_fields(module: M, **fields: Any) -> M:
    """Copy of a module with other values in some fields, whatever its constructor takes."""
    return _made_anew(type(module), module, fields)


def _made_anew(cls: type, module: Any, fields: dict[str, Any]) -> Any:
    fresh = object.__new__(cls)
    for name in (field.name for field in dataclasses.fields(cls)):
        object.__setattr__(fresh, name, fields[name] if name in fields else getattr(module, name))
    return fresh


class Stacked(eqx.Module):
    """Base of modules in one of whose fields numbers have leading axes.

    Class attributes:
        stacked: name of the field.
    """

    stacked: ClassVar[str]

    @property
    def lanes(self) -> tuple[int, ...]:
        """Lengths of these."""
        raise NotImplementedError


class Batched(eqx.Module):
    """Base of modules that may be several at once: then all numbers in them have leading axes."""

    @property
    def batch(self) -> tuple[int, ...]:
        """Lengths of these."""
        raise NotImplementedError


class Looked(eqx.Module):
    """Base of modules with methods of their own whose methods are what they compute now."""

    seen: Any = eqx.field(kw_only=True, default=None)


def _is_library(cls: Any) -> bool:
    root = (getattr(cls, "__module__", None) or "").partition(".")[0]
    return root in LIBRARIES or root in sys.stdlib_module_names or root == "jaxtyping"


@lru_cache(maxsize=4096)
def own_methods(cls: type) -> tuple[str, ...]:
    """Names of the methods of a module that no library has written."""
    if not issubclass(cls, eqx.Module) or issubclass(cls, Looked):
        return ()
    names = {
        name: None
        for owner in cls.__mro__
        if not _is_library(owner)
        for name, value in vars(owner).items()
        if isinstance(getattr(cls, name, None), FunctionType)
        and (name == "__call__" or not name.startswith("__"))
    }
    return tuple(names)


@lru_cache(maxsize=4096)
def _stops(cls: type) -> bool:
    return issubclass(cls, Function | Stacked | Batched) or bool(own_methods(cls))


def facts(cls: type) -> tuple:
    """What a class of one's own says of its instances, as the degree of an energy."""
    plain = bool | int | float | str | tuple | None
    return tuple(
        (name, value)
        for owner in cls.__mro__
        if own_methods(cls) and not _is_library(owner)
        for name, value in vars(owner).items()
        if isinstance(value, plain) and not name.startswith("_")
    )


def _is_callable(leaf: Any) -> bool:
    """Whether a leaf may read what changes."""
    if isinstance(leaf, jax.Array | np.ndarray | str | int | float | type | None):
        return False
    if not callable(leaf):
        return False
    # Functions of libraries read nothing, unless it was given to them.
    return not _is_library(leaf) or bool(getattr(leaf, "__closure__", None)) or isinstance(leaf, partial)


Visit = Callable[[Any, tuple[int, ...]], Any]


def mapped(tree: Any, visit: Visit, note: list[Any], lanes: tuple[int, ...] = ()) -> Any:
    """A tree with what `visit` makes of its callables; what else there is is noted."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: _stops(type(x)) and x is not tree)
    note.append(structure)
    return jax.tree.unflatten(structure, [_each(x, visit, note, lanes) for x in leaves])


def _each(x: Any, visit: Visit, note: list[Any], lanes: tuple[int, ...]) -> Any:
    if isinstance(x, Function):
        note.append(_code(x.function))
        return visit(x, lanes)
    if isinstance(x, Batched):
        return mapped(x, visit, note, (*lanes, *x.batch))
    if isinstance(x, Stacked):
        (inner,) = mapped((getattr(x, x.stacked),), visit, note, (*lanes, *x.lanes))
        rest = mapped(replace_fields(x, **{x.stacked: None}), visit, note, lanes)
        return replace_fields(rest, **{x.stacked: inner})
    if own_methods(type(x)):
        note.append(type(x))
        return visit(mapped(x, visit, note, lanes), lanes)
    if _is_callable(x):
        note.append(_code(x))
        return visit(x, lanes)
    note.append((np.shape(x), x.dtype) if isinstance(x, jax.Array | np.ndarray) else (type(x), x))
    return x


def _code(function: Any) -> Hashable:
    """What is the same of functions that are made anew: their code, or what they are of."""
    if isinstance(function, partial):
        return _code(function.func), len(function.args), tuple(function.keywords)
    code = getattr(unwrap(function), "__code__", None)
    return type(function) if code is None else code


def name_of(part: Any) -> str:
    """A callable, for messages."""
    part = unwrap(part.function if isinstance(part, Function) else part)
    code = getattr(part, "__code__", None)
    if code is None:
        return f"a {type(part).__name__}"
    return f"the function {code.co_name!r} ({code.co_filename}, line {code.co_firstlineno})"


def looked(module: Any, seen: Any) -> Any:
    """A module whose methods are those that were seen."""
    return _made_anew(_looked_class(type(module)), module, {"seen": seen})


@lru_cache(maxsize=4096)
def _looked_class(cls: type) -> type:
    def method(name: str) -> Callable[..., Any]:
        def call(self: Any, *args: Any, **kwargs: Any) -> Any:
            return self.seen.call(name, (self, *args), kwargs)

        return call

    names = {name: method(name) for name in own_methods(cls)}
    return type(cls)(cls.__name__, (cls, Looked), {"__module__": cls.__module__, **names})
