"""Callables among the arguments of a program: seen anew at each call from Python.

A compiled program knows a callable by what it was when it was traced, and what the callable reads (a global,
a closure, an attribute, an array) may have changed since. So, wherever a program is called, each callable in
its arguments is replaced by what it computes now, see `programs`: the numbers in it are arguments like all
others, and the rest is what programs are told apart by. That is a function, an object that can be called, or
a module with methods of its own, as effects and costs that are subclasses of those here.

With what a callable is called is known once the program has been traced, and then remembered.
"""

import dataclasses
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.callables import (
    Function,
    Looked,
    facts,
    looked,
    mapped,
    name_of,
    own_methods,
    replace_fields,
)
from natcoord_jax.core.checks import as_array, at_top_level, is_concrete
from natcoord_jax.xla.programs import Program, Signature, signature, traced

REMEMBERED = 512
"""Calls of programs whose callables are remembered."""


class Unseen(BaseException):
    """A callable is called in a way that was not known; the call begins anew."""

    def __init__(self, call: "Call"):
        super().__init__()
        self.call = call


class Call:
    """One call of a program: its callables as they are now, and how they are known to be called.

    Attributes:
        known: by place of the callable, how it is called, and what it was when it was last looked at.
        parts: the callables.
        asked: what was not known.
        running: whether the call can begin anew.
        complete: whether nothing was asked for after it.
    """

    def __init__(self, known: dict[int, dict[Signature, Any]], asked: set[tuple[int, Signature]]):
        self.known, self.asked = known, asked
        self.parts: list[Any] = []
        self.running, self.complete = False, True

    def add(self, part: Any) -> None:
        """One more callable."""
        ways = self.known.setdefault(len(self.parts), {})
        for how in part.called if isinstance(part, Function) else ():
            ways.setdefault(how, None)
        self.parts.append(part)

    def missed(self, position: int, how: Signature) -> None:
        """Remember how a callable is called, and begin anew if the call can."""
        self.known[position][how] = None
        self.asked.add((position, how))
        if self.running:
            raise Unseen(self)
        # (A rule for derivatives that is evaluated later: what is made of it serves no other call.)
        self.complete = False

    def seen(self, position: int, lanes: tuple[int, ...]) -> "Seen":
        """What a callable computes now."""
        looked_at = ((how, self._looked_at(position, how)) for how in tuple(self.known[position]))
        found = [(how, *x) for how, x in looked_at if x is not None]
        constants = tuple(tuple(_in_lanes(x, lanes) for x in values) for _, _, values in found)
        programs = tuple((how, program) for how, program, _ in found)
        return Seen(constants, programs, facts(type(self.parts[position])), Origin(self, position))

    def _looked_at(self, position: int, how: Signature) -> tuple[Program, Sequence[Any]] | None:
        part = self.parts[position]
        function = partial(_called, part, how.method, self)
        try:
            program, values = traced(function, how)
        except Exception:
            # What was once called so need not be able to, until it is called so again.
            if (position, how) in self.asked or how in getattr(part, "called", ()):
                raise
            del self.known[position][how]
            return None
        if not is_concrete(values):
            if at_top_level():  # they are of a trace that has ended
                raise _keeps(part)
            return program, values
        last, now = self.known[position][how], (program, tuple(map(_content, values)))
        if last != now:
            again, others = traced(function, how)
            if not is_concrete(others):
                raise _keeps(part)
            if (again, tuple(map(_content, others))) != now:
                raise ValueError(
                    f"{name_of(part)} is not the same when it is called twice with the same arguments (it "
                    "draws random numbers, reads a clock or counts its calls), which a program cannot "
                    "see: draw the numbers beforehand, and let it depend on its arguments"
                )
        self.known[position][how] = now if last is None or last[0] != program else (last[0], now[1])
        return self.known[position][how][0], values


def _keeps(part: Any) -> ValueError:
    """The refusal of a callable with a memory, which is traced once for all steps."""
    return ValueError(
        f"{name_of(part)} keeps what it has computed (an integral, a filter, the last value), for which a "
        "program has no place between calls: let it depend on its arguments alone, or make the steps by "
        "nc.step in a jax.lax.scan that carries what is to be kept (docs/howto/feedback.md has one)"
    )


class Origin:
    """Where something seen comes from; not compared."""

    def __init__(self, call: Call, position: int):
        self.call, self.position = call, position

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Origin) and self.call.complete and other.call.complete)

    @property
    def part(self) -> Any:
        """The callable itself."""
        return self.call.parts[self.position]


class Seen(eqx.Module):
    """What a callable computes.

    Attributes:
        constants: the numbers in it, by program.
        programs: what else it is, by how it is called.
        facts: what the class of a module says of it.
        origin: the callable.
    """

    constants: tuple[tuple[Any, ...], ...]
    programs: tuple[tuple[Signature, Program], ...] = eqx.field(static=True)
    facts: tuple = eqx.field(static=True)
    origin: Origin = eqx.field(static=True)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Its value."""
        return self.call("", args, kwargs)

    def call(self, method: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """Value of a method of a module, which is the first argument, or of a function."""
        call = self.origin.call
        how, arrays = signature(method, _slotted(call, (args, kwargs)))
        for (known, program), constants in zip(self.programs, self.constants, strict=True):
            if known == how:
                # Effects that take many instances at once have them along the last axis.
                given = [x[..., 0] if x.ndim > n else x for x, n in zip(constants, program.axes)]
                return program(given, arrays)
        call.missed(self.origin.position, how)
        return _called(self.origin.part, method, call, _slotted(call, (args, kwargs)))


class Slot(eqx.Module):
    """A callable among arguments: which one it is, its numbers, and what of it has got another structure."""

    leaves: list[Any]
    grown: dict[str, Any]
    position: int = eqx.field(static=True)


def _slotted(call: Call, tree: Any) -> Any:
    """Arguments with a slot for each of the callables of a call."""

    def slot(x: Any) -> Any:
        seen = x.seen if isinstance(x, Looked) else x
        if not isinstance(seen, Seen) or seen.origin.call is not call:
            return x
        position = seen.origin.position
        if x is seen:
            return Slot([], {}, position)
        grown = _grown(x, seen.origin.part)
        before = {name: getattr(seen.origin.part, name) for name in grown}
        now = replace_fields(x, **before) if grown else x
        leaves = jax.tree.leaves(now, is_leaf=lambda x: isinstance(x, Seen))
        return Slot([leaf for leaf in leaves if not isinstance(leaf, Seen)], grown, position)

    return jax.tree.map(slot, tree, is_leaf=lambda x: isinstance(x, Seen | Looked))


def _grown(module: Looked, part: Any) -> dict[str, Any]:
    """Fields that have been given numbers since a module was seen, as those that follow from others."""
    found = {}
    for name in (field.name for field in dataclasses.fields(part) if not field.metadata.get("static")):
        now, before = getattr(module, name), getattr(part, name)
        if before is None and now is not None:
            found[name] = now
    return found


def _called(part: Any, method: str, call: Call, arguments: Any) -> Any:
    """Value of a callable as it is in Python, of arguments with slots."""

    def whole(x: Any) -> Any:
        if not isinstance(x, Slot):
            return x
        found = jax.tree.unflatten(jax.tree.structure(call.parts[x.position]), x.leaves)
        return replace_fields(found, **x.grown) if x.grown else found

    args, kwargs = jax.tree.map(whole, arguments, is_leaf=lambda x: isinstance(x, Slot))
    return getattr(type(part), method)(*args, **kwargs) if method else part(*args, **kwargs)


def _in_lanes(x: Any, lanes: tuple[int, ...]) -> Any:
    if isinstance(x, np.ndarray):
        return as_array(np.broadcast_to(np.asarray(x), (*lanes, *x.shape)))
    return jnp.broadcast_to(x, (*lanes, *x.shape)) if lanes else x


def _content(x: Any) -> Hashable:
    if not isinstance(x, jax.Array | np.ndarray):
        return x
    array = np.asarray(x) if x.dtype.kind in "biufc" else np.asarray(jax.random.key_data(x))
    content = array.tobytes()
    return array.shape, array.dtype.str, content if len(content) < 100 else hashlib.sha256(content).digest()


KNOWN: OrderedDict[Hashable, dict[int, dict[Signature, Any]]] = OrderedDict()
"""How callables are called, by program and by what it is called with."""

MOST = 200
"""Times that a call begins anew."""


def with_callables(program: Hashable, run: Callable[..., Any], arguments: tuple) -> Any:
    """Value of a program whose callables are those of now.

    Args:
        program: what tells it from others.
        run: calls it; a function of the arguments, which is called anew where it has turned out how a
            callable is called.
        arguments: pytrees. Callables in them are functions and objects that can be called, as leaves or
            wrapped as `Function`, and modules with methods that no library has written.

    Raises:
        ValueError: for a callable that cannot be seen: it is not the same when it is called again.
    """
    parts: list[Any] = []
    note: list[Any] = [program]

    def collect(part: Any, _: Any) -> Any:
        parts.append(part)
        return part

    mapped(arguments, collect, note)
    if not parts:
        return run(*arguments)
    known = _known(tuple(note))
    asked: set[tuple[int, Signature]] = set()
    for _ in range(MOST):
        call = Call(known, asked)
        for part in parts:
            call.add(part)
        count = iter(range(len(parts)))

        def seen(part: Any, lanes: tuple[int, ...], call: Call = call, count: Any = count) -> Any:
            found = call.seen(next(count), lanes)
            return looked(part, found) if own_methods(type(part)) else found

        arguments_now = mapped(arguments, seen, [])
        call.running = True
        try:
            return run(*arguments_now)
        except Unseen as error:
            if error.call is not call:
                raise
        finally:
            call.running = False
    raise ValueError(
        f"{', '.join(map(name_of, parts))}: called with other arguments at each call, which a program "
        "cannot follow; pass arrays, and what stays the same"
    )


def _known(key: Hashable) -> dict[int, dict[Signature, Any]]:
    found = KNOWN.pop(key, None)
    KNOWN[key] = {} if found is None else found
    if len(KNOWN) > REMEMBERED:
        KNOWN.popitem(last=False)
    return KNOWN[key]
