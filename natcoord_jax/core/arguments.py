"""Arguments of public functions and parts: what each is, said once, and looked at in one way.

A public function says by `checked` what its arguments are; a part (an effect, a joint, the shape of a body)
says it of its fields, `metadata=is_a(Number())`. A call with something else ends in an error that names the
part, the argument with its unit, what was given and what to pass. Units are read from the docstring. What is
traced has no value yet: its shape is looked at, and a number of a part that would be refused becomes not a
number.
"""

import dataclasses
import inspect
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce, wraps
from typing import Annotated, Any, ClassVar, TypeVar, get_origin

import equinox as eqx
import numpy as np

from natcoord_jax.core.checks import is_concrete, require_double
from natcoord_jax.core.kinds import Kind, short
from natcoord_jax.core.numeric import masked
from natcoord_jax.xla.tracing import at_top_level

F = TypeVar("F", bound=Callable[..., Any])
DECLARED = "natcoord_jax: kind of argument"
"""Key of a field's metadata."""


BOUND = {"self", "cls"}
"""What a method is called on."""


def is_a(kind: Kind) -> dict[str, Any]:
    """What a field of a part is, as its metadata."""
    return {DECLARED: kind}


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The arguments of a call.

    Attributes:
        label: name of the function or part.
        order: names of the arguments that may be given by position.
        kinds: of all arguments, by name.
        defaults: of those that may be left out.
        source: where the docstrings are, which tell units.
    """

    label: str
    order: tuple[str, ...]
    kinds: Mapping[str, Kind | None]
    defaults: Mapping[str, Any]
    source: Any

    @classmethod
    def of(cls, label: str, signature: inspect.Signature, kinds: Mapping[str, Any], source: Any):
        """From a signature, without `self`."""
        listed = [p for p in signature.parameters.values() if p.name not in BOUND]
        places = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
        order = tuple(p.name for p in listed if p.kind in places)
        defaults = {p.name: p.default for p in listed if p.default is not inspect.Parameter.empty}
        return cls(label, order, {p.name: kinds.get(p.name) for p in listed}, defaults, source)

    def check(self, positional: Sequence[Any], named: Mapping[str, Any], label: str) -> None:
        """Refuse a call with other arguments than declared.

        Raises:
            TypeError: for too many arguments by position, one that there is not, or one that is missing.
            ValueError: for an argument that is something else.
        """
        self._check_names(positional, named, label)
        given = {**dict(zip(self.order, positional)), **named}
        for name, value in given.items():
            kind = self.kinds[name]
            if kind is None or (name in self.defaults and value is self.defaults[name]):
                continue
            complaint = kind.complaint(value)
            if complaint is not None:
                raise ValueError(self._message(name, kind, complaint, given, label))

    def _check_names(self, positional: Sequence[Any], named: Mapping[str, Any], label: str) -> None:
        by_name = [f"{name}=" for name in self.kinds if name not in self.order]
        if len(positional) > len(self.order):
            taken, extra = ", ".join(self.order) or "nothing", short(positional[len(self.order)])
            raise TypeError(
                f"{label} takes {taken} by position, and got {extra} besides; pass it by name: "
                f"{', '.join(by_name)}"
            )
        unknown = [name for name in named if name not in self.kinds]
        if unknown:
            raise TypeError(
                f"{label} has no argument {unknown[0]!r}; pass some of {', '.join([*self.order, *by_name])}"
            )
        # (Copies are made of a class with nothing at all, and filled in afterwards.)
        given = {*self.order[: len(positional)], *named}
        missing = [name for name in self.kinds if name not in self.defaults and name not in given]
        if given and missing:
            raise TypeError(f"{label}: " + "; ".join(self._wish(name) for name in missing))

    def _wish(self, name: str) -> str:
        """What to pass for an argument that is missing."""
        kind = self.kinds[name]
        unit = unit_of(self.source, name) if kind is None or kind.measured else ""
        return f"{name}{unit} is missing; pass {name}=" + (f", {kind.wanted}" if kind else "")

    def _message(self, name: str, kind: Kind, complaint: str, given: Mapping[str, Any], label: str) -> str:
        unit = unit_of(self.source, name) if kind.measured else ""
        swapped = [
            other
            for other, value in given.items()
            if kind.distinct
            and kind.complaint(value) is None
            and (self.kinds[other] or kind).complaint(value) is not None
        ]
        hint = f" (`{swapped[0]}` got one: are the two swapped?)" if swapped else ""
        return f"{label}: {name}{unit} {complaint}; pass {kind.wanted}{hint}"


def require(part: Any, name: str, kind: Kind) -> None:
    """Refuse a field of a part that depends on other fields, in its `__check_init__`.

    Raises:
        ValueError: naming part, field, unit and what to pass.
    """
    complaint = kind.complaint(getattr(part, name))
    if complaint is not None:
        own = getattr(part, "name", None)
        named = f"{type(part).__name__} {own!r}" if isinstance(own, str) else type(part).__name__
        unit = unit_of(type(part), name) if kind.measured else ""
        raise ValueError(f"{named}: {name}{unit} {complaint}; pass {kind.wanted}")


def unit_of(source: Any, name: str) -> str:
    """Unit of an argument or a field, " [m]", as the docstring has it; "" if it says none."""
    classes = source.__mro__ if inspect.isclass(source) else (source,)
    for documented in classes:
        text = documented.__doc__ or ""
        entry = re.search(rf"^( *){name}: ?((?:.*\n)(?:\1 +.*\n)*)", text + "\n", re.MULTILINE)
        unit = re.search(r"\[[^\[\]]+\]", entry[2]) if entry else None
        if unit:
            return f" {unit[0]}"
    return ""


DECLARATIONS: dict[Any, Declaration] = {}
"""Those of the functions, for tests."""


def checked(label: str | None = None, /, **kinds: Kind) -> Callable[[F], F]:
    """Decorator of a public function: what its arguments are, all of them; double precision is asked for.

    Args:
        label: name of the function in messages; default its own.
        kinds: of arguments by name, whose annotations do not say it as `Annotated[type, kind]`. The default
            value of an argument is always allowed.

    Raises:
        TypeError: where it is applied, for arguments that are not declared, or are none.
    """

    def declare(function: F) -> F:
        signature = inspect.signature(function)
        noted = {p.name: p.annotation.__metadata__[0] for p in signature.parameters.values() if _says(p)}
        missing = (set(signature.parameters) - BOUND) ^ set(kinds | noted)
        if missing:
            raise TypeError(
                f"{function.__qualname__}: arguments and declarations differ in {sorted(missing)}"
            )
        name = label or function.__name__
        declaration = Declaration.of(name, signature, kinds | noted, function)
        bound = bool(BOUND & set(signature.parameters))

        @wraps(function)
        def call(*positional: Any, **named: Any) -> Any:
            require_double(name)
            part = named.get("name")
            said = f"{name} {part!r}" if isinstance(part, str) else name
            declaration.check(positional[1:] if bound else positional, named, said)
            return function(*positional, **named)

        DECLARATIONS[call] = declaration
        # (Who asks for the signature reads types.)
        plain = [
            p.replace(annotation=p.annotation.__origin__) if _says(p) else p
            for p in signature.parameters.values()
        ]
        call.__signature__ = signature.replace(parameters=plain)  # pyright: ignore[reportAttributeAccessIssue]
        call.__annotations__ = {**function.__annotations__, **{p.name: p.annotation for p in plain}}
        return call  # pyright: ignore[reportReturnType]

    return declare


def _says(parameter: inspect.Parameter) -> bool:
    return get_origin(parameter.annotation) is Annotated


@cache
def declaration_of(cls: type) -> Declaration | None:
    """What the fields of a class of parts declare; None where it makes them in an `__init__` of its own."""
    fields = [f for f in dataclasses.fields(cls) if f.init]
    signature = inspect.signature(cls.__init__)
    if {f.name for f in fields} != set(signature.parameters) - {"self"}:
        return None
    return Declaration.of(cls.__name__, signature, {f.name: f.metadata.get(DECLARED) for f in fields}, cls)


def declared(module: Any, path: str) -> Kind | None:
    """What a number of a part was declared to be, if it was, "field.number" in a module in a field."""
    owner, _, inside = path.partition(".")
    fields = {f.name: f for f in dataclasses.fields(module)}
    if owner not in fields:
        return None
    if inside:
        inner = getattr(module, owner)
        return declared(inner, inside) if dataclasses.is_dataclass(inner) else None
    return fields[owner].metadata.get(DECLARED)


class Part(eqx.Module):
    """Base of what users make: its fields say what they are, and are looked at when it is made.

    Fields without a kind, as in classes of users' own, are left alone. What would be refused if it were not
    traced becomes not a number.

    Class attributes:
        makes_arrays: whether numbers become arrays when it is made, which takes double precision. Others keep
            them as they were given until a scene is compiled.
    """

    makes_arrays: ClassVar[bool] = False

    def __new__(cls, *positional: Any, **named: Any):
        """Looks at the arguments before they become fields."""
        declaration, name = declaration_of(cls), named.get("name")
        if cls.makes_arrays:
            require_double(cls.__name__)
        if declaration is not None:
            label = f"{cls.__name__} {name!r}" if isinstance(name, str) else cls.__name__
            declaration.check(positional, named, label)
        return super().__new__(cls)

    def __check_init__(self) -> None:
        """Looks at what its numbers are together, and at those that are traced."""
        traced = []
        for said, wrong in self.flaws().items():
            if not is_concrete(wrong):
                traced.append(wrong)
            elif np.any(np.asarray(wrong)):
                raise ValueError(f"{type(self).__name__} {said}")
        if at_top_level():
            return
        wrong = reduce(operator.or_, traced, False)
        for field in dataclasses.fields(self):
            kind, value = field.metadata.get(DECLARED), getattr(self, field.name)
            value = value if kind is None else kind.masked(value)
            object.__setattr__(self, field.name, masked(value, lambda x: ~wrong) if traced else value)

    def flaws(self) -> dict[str, Any]:
        """What may be wrong with its numbers together, as the rest of a sentence, and whether it is."""
        return {}
