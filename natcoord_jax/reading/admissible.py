"""Numbers that a part can have: what is known is refused, and what is traced becomes not a number.

Inside `jax.jit` nothing can be raised. A run with what is not a number ends at the first step that needs it,
with the code that says so; a spring that pushes because a search went below zero would be silently wrong.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.arguments import DECLARED
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.flaws import first_flaw, traced_flaws
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model, SomeModel

WANTED = {"positive": "positive numbers", "not negative": "numbers that are not negative"}
"""What is wanted of a number that was declared with a sign."""


def as_signed(system: Model, name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Numbers for an effect, by field, that have the signs which it asked for when it was made.

    Raises:
        ValueError: for a number of another sign, with its part and field, where it is known.
    """
    for group in _groups(system, name):
        label = f"{group.effect.kind} {name!r}"
        signs = {field: getattr(_declared(group.effect, field), "sign", "") for field in given}
        given = {key: signed(x, signs[key], f"{label}: {key}") for key, x in given.items()}
    return given


def signed(value: Any, sign: str, label: str) -> Any:
    """A number of a sign, "positive", "not negative" or ""; of another one, if it is traced, not a number.

    Raises:
        ValueError: for one of another sign, where it is known.
    """
    if sign not in WANTED:
        return value
    if not is_concrete(value):
        return jnp.where(value > 0 if sign == "positive" else value >= 0, value, jnp.nan)
    least = float(np.min(np.asarray(value), initial=np.inf))
    if least < 0 or (least == 0 and sign == "positive"):
        raise ValueError(f"{label} is {least:g}; pass {WANTED[sign]}")
    return value


def without_flaws(system: SomeModel, name: str, places: Sequence[tuple[int, int | None]]) -> SomeModel:
    """The system, where an effect is one that can be.

    Args:
        system: after its numbers were set.
        name: of the effect.
        places: leaf and row of these numbers.

    Raises:
        ValueError: for an effect that cannot be, with what is wrong, where it is known.
    """
    for group in _groups(system, name):
        flaw = first_flaw(group.effect) if group.lanes else None
        if flaw is not None:
            number, said = flaw
            of_them = f"element {number} of " if group.is_set else ""
            raise ValueError(f"{of_them}{group.effect.kind} {name!r} {said}")
        wrong = traced_flaws(group.effect) if group.lanes else None
        if wrong is None:
            continue
        leaves, structure = jax.tree.flatten(system)
        for leaf, row in places:
            value = leaves[leaf]
            bad = wrong if row is None else wrong & (jnp.arange(len(wrong)) == row)
            leaves[leaf] = jnp.where(bad.reshape(-1, *[1] * (value.ndim - 1)), jnp.nan, value)
        system = jax.tree.unflatten(structure, leaves)
    return system


def _groups(system: Model, name: str) -> list[Group]:
    return [g for g in system.effects if name in g.names or name in g.labels]


def _declared(module: Any, path: str) -> Any:
    """What a number of a part was declared to be, if it was."""
    owner, _, rest = path.partition(".")
    fields = {f.name: f for f in dataclasses.fields(module)}
    if owner not in fields:
        return None
    if rest:
        inner = getattr(module, owner)
        return _declared(inner, rest) if dataclasses.is_dataclass(inner) else None
    return fields[owner].metadata.get(DECLARED)
