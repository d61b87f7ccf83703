"""Programs of functions of pytrees, some arguments of which are part of the program."""

import inspect
from collections.abc import Callable, Hashable, Iterable, Sequence
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import numpy as np

from natcoord_jax.xla.effort import Effort, Programs

ARRAYS = jax.Array, np.ndarray, np.generic
NUMBERS = bool, int, float, complex


class Static(eqx.Module):
    """What is part of a program: no array, and compared."""

    value: Any = eqx.field(static=True)


def split(tree: Any, numbers: bool = False) -> tuple[Hashable, list[Any]]:
    """A pytree as what is part of a program, and arrays; with numbers of Python among these, if asked for."""
    leaves, structure = jax.tree.flatten(tree)
    if numbers:
        leaves = [np.asarray(x) if isinstance(x, NUMBERS) else x for x in leaves]
    kept = tuple(isinstance(x, ARRAYS) for x in leaves)
    rest = tuple(None if keep else x for x, keep in zip(leaves, kept))
    return (structure, rest, kept), [x for x, keep in zip(leaves, kept) if keep]


def joined(static: Any, arrays: Sequence[Any]) -> Any:
    """The pytree that was split."""
    structure, rest, kept = static
    given = iter(arrays)
    return jax.tree.unflatten(structure, [next(given) if keep else x for x, keep in zip(rest, kept)])


def programs_of(
    name: str, function: Callable, effort: Effort | None = None, numbers: bool = False
) -> Callable[[Any, Any], Any]:
    """Programs of a function of pytrees, whose leaves that are no arrays are part of the program.

    Args:
        name: of the function.
        function: of arguments whose memory may be used again, and of others.
        effort: how it is compiled.
        numbers: whether numbers of Python are arrays.
    """

    def flat(static: Any, donated: list, kept: list) -> Any:
        results = function(joined(static[0], donated), joined(static[1], kept))
        fixed, arrays = split(results)
        return arrays, Static(fixed)

    programs = Programs(name, flat, effort)

    def call(donated: Any, kept: Any) -> Any:
        (fixed, again), (others, arrays) = split(donated, numbers), split(kept, numbers)
        found, made = programs((fixed, others), again, arrays)
        return joined(made.value, found)

    return call


def with_marked(
    function: Callable, effort: Effort | None, statics: set[int | str], donates: set[int | str]
) -> Callable:
    """A compiled function, some arguments of which are part of the program, or may be used again."""

    def called(donated: Any, kept: Any) -> Any:
        args = [_either(*pair) for pair in zip(donated[0], kept[0])]
        return function(*args, **{name: _either(donated[1][name], x) for name, x in kept[1].items()})

    name = getattr(function, "__name__", type(function).__name__)
    programs = programs_of(name, called, effort, numbers=True)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        def part(place: int | str, x: Any, donated: bool) -> Any:
            if (place in donates) != donated:
                return None
            if place not in statics:
                return x
            try:
                hash(x)
            except TypeError as error:
                where = repr(place) if isinstance(place, str) else place
                raise TypeError(f"{name}: static argument {where} has to be hashable: {error}") from error
            return Static(x)

        donated, kept = (
            (
                [part(place, x, those) for place, x in enumerate(args)],
                {name: part(name, x, those) for name, x in kwargs.items()},
            )
            for those in (True, False)
        )
        return programs(donated, kept)

    return call


def marked(function: Callable, numbers: int | Sequence[int], names: str | Iterable[str]) -> set[int | str]:
    """Places of arguments, by position and by name."""
    numbers = [numbers] if isinstance(numbers, int) else list(numbers)
    names = [names] if isinstance(names, str) else list(names)
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a function that is not of Python
        parameters = ()
    positional = [x.name for x in parameters if x.kind in (x.POSITIONAL_ONLY, x.POSITIONAL_OR_KEYWORD)]
    places = [n + len(positional) if n < 0 else n for n in numbers]
    by_name = [positional[n] for n in places if n < len(positional)]
    by_number = [positional.index(name) for name in names if name in positional]
    return {*places, *names, *by_name, *by_number}


def _either(donated: Any, kept: Any) -> Any:
    given = kept if donated is None else donated
    return given.value if isinstance(given, Static) else given
