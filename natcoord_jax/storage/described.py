"""A structure in words: classes and functions by name, arrays by number.

What is described is data: objects whose class says what their fields are (data classes, modules, named
tuples, enumerations), containers, numbers and text. Their classes, and functions among them, are looked up by
module and name when they are read; no code is stored and none of a file is run. Objects are made of their
fields, as they were, without their constructors: those have done their checks.
"""

import dataclasses
import enum
import importlib
import math
import sys
from collections.abc import Callable
from functools import partial
from types import FunctionType, MethodType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import as_array
from natcoord_jax.maths.indices import Indices

PLAIN = str, bool, int, type(None)
"""What JSON has itself."""

CONTAINERS: dict[str, Any] = {"tuple": tuple, "list": list, "set": set, "frozenset": frozenset}

MISSING = object()
"""Value of a field that has not been set."""


class DescriptionError(ValueError):
    """Something that cannot be described, or a description that fits nothing here."""


def name_of(thing: Any) -> str:
    """Module and qualified name of a class or a function.

    Raises:
        DescriptionError: if that does not lead to it.
    """
    module, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    try:
        if module is not None and name is not None and looked_up(f"{module}:{name}") is thing:
            return f"{module}:{name}"
    except DescriptionError:
        pass
    # Functions that have been wrapped or were written as a lambda are called otherwise than where they are.
    for known, value in list(vars(sys.modules.get(module or "", sys)).items()):
        if value is thing:
            return f"{module}:{known}"
    raise DescriptionError(
        f"{name or thing!r} of the module {module!r} cannot be found again by its name (it is a lambda, or "
        "made inside of a function); define it at the top of a module"
    )


def looked_up(name: str) -> Any:
    """The class or function of a module.

    Raises:
        DescriptionError: if there is none.
    """
    module, _, path = name.partition(":")
    try:
        found: Any = sys.modules.get(module) or importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise DescriptionError(
            f"{path!r} of the module {module!r} is not to be found here: {error}"
        ) from error
    return found


class Description:
    """What is described so far.

    Attributes:
        arrays: the arrays, in their order.
        fields: names of the fields of every class.
    """

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.fields: dict[str, list[str]] = {}

    def of(self, x: Any) -> Any:
        """Description of a value, as JSON has it.

        Raises:
            DescriptionError: for what is no data.
        """
        if isinstance(x, enum.Enum):
            return {"enum": name_of(type(x)), "name": x.name}
        if isinstance(x, PLAIN) and type(x) in PLAIN:
            return x
        if type(x) is float:
            return x if math.isfinite(x) else {"float": repr(x)}
        if isinstance(x, jax.Array | np.ndarray | np.generic):
            return self._array(x)
        if isinstance(x, type):
            return {"type": name_of(x)}
        if isinstance(x, tuple) and type(x) is not tuple:
            names = getattr(type(x), "_fields", ())
            return {"named": self._class(type(x), names), "of": [self.of(y) for y in x]}
        if isinstance(x, tuple | list | set | frozenset) and type(x) in CONTAINERS.values():
            ordered = sorted(x, key=repr) if isinstance(x, set | frozenset) else x
            return {type(x).__name__: [self.of(y) for y in ordered]}
        if type(x) is dict:
            return {"dict": [[self.of(key), self.of(value)] for key, value in x.items()]}
        return self._object(x)

    def _array(self, x: Any) -> Any:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            raise DescriptionError("a key of random numbers is no number; save jax.random.key_data(key)")
        self.arrays.append(np.asarray(x))
        kind = "jax" if isinstance(x, jax.Array) else "scalar" if isinstance(x, np.generic) else "numpy"
        return {"array": len(self.arrays) - 1, "kind": kind}

    def _object(self, x: Any) -> Any:
        if isinstance(x, range):
            return {"range": [x.start, x.stop, x.step]}
        if isinstance(x, partial):
            return {"partial": self.of((x.func, x.args, dict(x.keywords)))}
        if isinstance(x, MethodType):
            return {"method": x.__name__, "of": self.of(x.__self__)}
        if dataclasses.is_dataclass(x):
            names = [field.name for field in dataclasses.fields(x)]
            values = {name: getattr(x, name, MISSING) for name in names}
            given = {name: self.of(value) for name, value in values.items() if value is not MISSING}
            return {"class": self._class(type(x), names), "fields": given}
        if isinstance(x, FunctionType) or callable(x):
            return {"function": name_of(x)}
        raise DescriptionError(f"{x!r} of {type(x)} is no data that can be described")

    def _class(self, cls: type, names: Any) -> str:
        name = name_of(cls)
        self.fields[name] = list(names)
        return name


def check_fields(fields: dict[str, list[str]]) -> None:
    """Look whether classes have the fields that they had.

    Raises:
        DescriptionError: naming those that have not.
    """
    for name, before in fields.items():
        cls = looked_up(name)
        now = getattr(cls, "_fields", None)
        if now is None:
            now = [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
        gone, new = [x for x in before if x not in now], [x for x in now if x not in before]
        if gone or new:
            changes = [f"no longer has {gone}"] * bool(gone) + [f"has {new} besides"] * bool(new)
            raise DescriptionError(
                f"{name} {' and '.join(changes)}; it has changed since the file was written"
            )


def made(what: Any, arrays: list[np.ndarray]) -> Any:
    """What was described.

    Raises:
        DescriptionError: for names that lead to something else than a class of data or a function.
    """
    again: Callable[[Any], Any] = partial(made, arrays=arrays)
    if not isinstance(what, dict):
        return what
    (kind, value), *rest = what.items()
    rest = dict(rest)
    if kind == "array":
        array = arrays[value]
        return {"jax": as_array, "numpy": np.array, "scalar": lambda x: x[()]}[rest["kind"]](array)
    if kind in CONTAINERS:
        return CONTAINERS[kind](map(again, value))
    if kind == "named":
        return looked_up(value)(*map(again, rest["of"]))
    if kind == "dict":
        return {again(key): again(x) for key, x in value}
    if kind == "range":
        return range(*value)
    if kind == "float":
        return float(value)
    if kind == "partial":
        function, args, keywords = again(value)
        return partial(function, *args, **keywords)
    return _named(kind, value, rest, again)


def _named(kind: str, value: str, rest: dict[str, Any], again: Callable[[Any], Any]) -> Any:
    if kind == "method":
        return getattr(again(rest["of"]), value)
    found = looked_up(value)
    if kind == "enum" and isinstance(found, type) and issubclass(found, enum.Enum):
        return found[rest["name"]]
    if kind == "class" and isinstance(found, type) and dataclasses.is_dataclass(found):
        fresh = object.__new__(found)
        static = {x.name for x in dataclasses.fields(found) if x.metadata.get("converter") == Indices.of}
        for name, x in rest["fields"].items():
            object.__setattr__(fresh, name, Indices.of(again(x)) if name in static else again(x))
        return fresh
    if (kind == "type" and isinstance(found, type)) or (kind == "function" and callable(found)):
        return found
    raise DescriptionError(f"{value} is no {kind}")
