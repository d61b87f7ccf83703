"""Compilation of functions of the library: of pytrees, with callables that are seen anew at each call."""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, TypeVar

from natcoord_jax.core.closures import with_callables
from natcoord_jax.xla.effort import Effort
from natcoord_jax.xla.jit import programs_of
from natcoord_jax.xla.reported import Passage

F = TypeVar("F", bound=Callable[..., Any])


def _with(effort: Effort | None, function: F) -> F:
    """A function of pytrees, compiled; leaves that are no arrays are part of the program."""

    def called(donated: tuple, arguments: tuple) -> Any:
        return function(*arguments)

    name = function.__name__.strip("_")
    programs = partial(programs_of(name, called, effort), ())

    def run(*arguments: Any) -> Any:
        passage = Passage(name)
        return passage.leave(programs(passage.enter(arguments)))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return with_callables(function, run, arguments)

    return call  # pyright: ignore[reportReturnType]


def compiled(function: F) -> F:
    """A function compiled as `nc.jit` does, whose callables are seen anew at each call, see `closures`."""
    return _with(None, function)


def briefly(function: F) -> F:
    """The same for a function that is run once or a few times, with least effort.

    Who runs one often wraps it in a `jit`, where its own effort does not apply.
    """
    return _with("quick", function)
