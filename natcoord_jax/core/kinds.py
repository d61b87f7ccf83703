"""Kinds of arguments: numbers, functions, handles, and combinations of them."""

import dataclasses
import inspect
from functools import singledispatch
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from natcoord_jax.core.handles import Handle

LONGEST = 60
"""Characters of a value in a message."""


def short(value: Any) -> str:
    """A value in a message: what it is, not all of it."""
    text = described(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


@singledispatch
def described(value: Any) -> str:
    """A value in words; classes that a message may have to name register theirs."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    plain = type(value).__module__ in ("builtins", "numpy")
    return repr(value) if plain else f"an object of type {type(value).__name__}"


@described.register
def _(value: Handle) -> str:
    return f"the {value.kind} {value.name!r}"


@described.register(jax.Array)
@described.register(np.ndarray)
def _(value: Any) -> str:
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return f"an array of type {value.dtype}"
    if value.ndim or isinstance(value, Tracer):
        return f"an array of shape {value.shape}"
    return repr(np.asarray(value).item())


class Kind:
    """What an argument is.

    Attributes:
        wanted: what to pass, for the message.
        distinct: whether nothing else passes for it, so that arguments that are swapped can be told.
        measured: whether it is numbers, which have a unit.
    """

    wanted: str
    distinct: bool = False
    measured: bool = False

    def complaint(self, value: Any) -> str | None:
        """What is wrong with a value, to follow the name of the argument; None: nothing."""
        raise NotImplementedError

    def masked(self, value: Any) -> Any:
        """The value, with not a number for what is traced and would be refused if it were not."""
        return value

    def __or__(self, other: "Kind") -> "Kind":
        return Either((self, other))


@dataclasses.dataclass(frozen=True)
class Either(Kind):
    """One of several kinds."""

    kinds: tuple[Kind, ...]

    @property
    def measured(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """If one is."""
        return any(kind.measured for kind in self.kinds)

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """All of them."""
        return " or ".join(kind.wanted for kind in self.kinds)

    def complaint(self, value: Any) -> str | None:
        """The first that says more than what was given, if none of the kinds fits."""
        found = []
        for kind in self.kinds:
            found.append(kind.complaint(value))
            if found[-1] is None:
                return None
        telling = [text for text in found if text != is_other(value)]
        # Where the shape is that of one kind, it is not what is wrong.
        fitting = [text for text in telling if not text.startswith("has shape")]
        return (fitting or telling or found)[0]

    def masked(self, value: Any) -> Any:
        """As the first kind that it fits has it."""
        return next((kind.masked(value) for kind in self.kinds if kind.complaint(value) is None), value)


def is_other(value: Any) -> str:
    """The complaint about something of another kind altogether."""
    return f"is {short(value)}"


@dataclasses.dataclass(frozen=True)
class Choice(Kind):
    """One of some values."""

    values: tuple[Any, ...]

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """All of them."""
        named = [f'"{value}"' if isinstance(value, str) else repr(value) for value in self.values]
        return " or ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)

    def complaint(self, value: Any) -> str | None:
        """Whether it is among them."""
        alike = isinstance(value, str | int | np.integer) and not isinstance(value, bool)
        return None if alike and value in self.values else is_other(value)


@dataclasses.dataclass(frozen=True)
class Of(Kind):
    """An object of a class."""

    classes: tuple[type, ...]
    wanted: str
    distinct: bool = True

    def complaint(self, value: Any) -> str | None:
        """Whether it is one."""
        return None if isinstance(value, self.classes) else is_other(value)


def of(wanted: str, *classes: type) -> Of:
    """An object of one of some classes."""
    return Of(classes, wanted)


@dataclasses.dataclass(frozen=True)
class FunctionOf(Kind):
    """Something that can be called.

    Attributes:
        signature: what it takes and returns, for the message.
        count: of what it takes; None: not looked at.
    """

    signature: str
    count: int | None = None

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Its signature."""
        return f"a function {self.signature}"

    def complaint(self, value: Any) -> str | None:
        """Whether it can be called, with as many arguments."""
        if not callable(value) or isinstance(value, type):
            return is_other(value)
        if self.count is None:
            return None
        try:
            signature = inspect.signature(value)
        except (TypeError, ValueError):  # (It does not tell.)
            return None
        try:
            signature.bind(*(None,) * self.count)
        except TypeError:
            return "takes other arguments"
        return None


@dataclasses.dataclass(frozen=True)
class Several(Kind):
    """A tuple or a list of one kind."""

    each: Kind
    least: int = 0
    most: int | None = None

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What each is."""
        if self.most is not None and self.most == self.least:
            return f"a tuple of {self.most}, each of it {self.each.wanted}"
        return f"a tuple, each of it {self.each.wanted}"

    def complaint(self, value: Any) -> str | None:
        """The first complaint about any."""
        if not isinstance(value, tuple | list):
            return is_other(value)
        if len(value) < self.least or (self.most is not None and len(value) > self.most):
            return f"has {len(value)} entries"
        wrong = [self.each.complaint(x) for x in value]
        return next((f"[{k}] {text}" for k, text in enumerate(wrong) if text), None)


@dataclasses.dataclass(frozen=True)
class HandleOf(Kind):
    """A handle of a part of a scene: "body", "joint" or "effect"."""

    part: str
    distinct: bool = True

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Where it comes from."""
        if self.part == "body":
            return "the handle of a body, as scene.add(nc.RigidBody(...)) returns it, or nc.ground"
        example = {"joint": "nc.Revolute(...)", "effect": "nc.JointTorque(...)"}[self.part]
        article = "an" if self.part == "effect" else "a"
        return f"the handle of {article} {self.part}, as scene.add({example}) returns it"

    def complaint(self, value: Any) -> str | None:
        """Whether it is one."""
        return None if isinstance(value, Handle) and value.kind == self.part else is_other(value)


class Concrete(Either):
    """What has to have a value: it is part of the program, or read by Python."""

    def __init__(self, *kinds: Kind):
        super().__init__(kinds)

    def complaint(self, value: Any) -> str | None:
        """That of the kinds, or that it is being traced."""
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)):
            return "is traced by jit, vmap or grad, and needs a value here: call this outside of them"
        return super().complaint(value)


class Anything(Kind):
    """What is looked at elsewhere, or may be anything."""

    wanted = "anything"

    def complaint(self, value: Any) -> str | None:
        """Nothing."""
        return None


NAME = of("a name in quotes", str)
FLAG = of("True or False", bool, np.bool_)
BODY, JOINT = HandleOf("body"), HandleOf("joint")
BODY_NAME, JOINT_NAME = BODY | NAME, JOINT | NAME
