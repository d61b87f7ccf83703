"""Numbers that a part can have: what is known is refused, and what is traced becomes not a number.

Inside `jax.jit` nothing can be raised. A run with what is not a number ends at the first step that needs it,
with the code that says so; a spring that pushes because a search went below zero would be silently wrong.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from natcoord_jax.core.arguments import DECLARED
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import Effect, replace_fields
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


def without_flaws(system: SomeModel, name: str) -> SomeModel:
    """The system after numbers of a part were set, where an effect is one that can be.

    Where what is wrong with an instance is traced, none of its numbers is a number: what follows from those
    that were set may look sound.

    Raises:
        ValueError: for an effect that cannot be, with what is wrong, where it is known.
    """
    effects = list(system.effects)
    for number, group in enumerate(effects):
        if not group.lanes or (name not in group.names and name not in group.labels):
            continue
        flaw = first_flaw(group.effect)
        if flaw is not None:
            element, said = flaw
            of_them = f"element {element} of " if group.is_set else ""
            raise ValueError(f"{of_them}{group.effect.kind} {name!r} {said}")
        wrong = traced_flaws(group.effect)
        if wrong is not None:
            effects[number] = replace_fields(group, effect=_spoiled(group.effect, wrong))
    return replace_fields(system, effects=tuple(effects))


def _spoiled(effect: Effect, wrong: Bool[Array, " n"]) -> Effect:
    """Stacked instances, without numbers where something is wrong."""

    def spoiled(x: Any) -> Any:
        bad = wrong.reshape(-1, *[1] * (np.ndim(x) - 1))
        return jnp.where(bad, jnp.nan, x) if eqx.is_inexact_array(x) else x

    return jax.tree.map(spoiled, effect)


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
