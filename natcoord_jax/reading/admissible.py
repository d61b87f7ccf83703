"""Numbers that a part can have: what is known is refused, and what is traced becomes not a number.

Inside `jax.jit` nothing can be raised. A run with what is not a number ends at its first step, with the code
that says so; a spring that pushes because a search went below zero would be silently wrong.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from natcoord_jax.core.arguments import declared
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.flaws import flaws_of
from natcoord_jax.core.numeric import range_of
from natcoord_jax.model.model import Model, SomeModel


def as_declared(system: Model, name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Numbers for an effect, by field, that are what it asked for when it was made.

    Raises:
        ValueError: for others, with part and field, where they are known.
    """
    for group in (*system.joints, *system.effects):
        if name in group.names or name in group.labels:
            label = f"{group.effect.kind} {name!r}"
            for key, value in given.items():
                given = {**given, key: in_range(declared(group.effect, key), value, f"{label}: {key}")}
    return given


def in_range(kind: Any, value: Any, label: str) -> Any:
    """Numbers of any shape in the range of a kind; those that are not, if traced, not a number.

    Raises:
        ValueError: for numbers out of it, where they are known.
    """
    wanted = range_of(kind)
    if wanted is None:
        return value
    if not is_concrete(value):
        return wanted.masked(value)
    complaint = wanted.misfit(np.asarray(value))
    if complaint is not None:
        raise ValueError(f"{label} {complaint}; pass {wanted.wanted}")
    return value


def without_flaws(system: SomeModel, name: str) -> SomeModel:
    """The system after numbers of a part were set, where an effect is one that can be.

    Raises:
        ValueError: for an effect that cannot be, with what is wrong, where it is known.
    """
    traced = []
    for group in system.effects:
        if not group.lanes or (name not in group.names and name not in group.labels):
            continue
        flaw, unknown = flaws_of(group.effect)
        if flaw is not None:
            element, said = flaw
            of_them = f"element {element} of " if group.is_set else ""
            raise ValueError(f"{of_them}{group.effect.kind} {name!r} {said}")
        traced += unknown
    return without_masses(system, traced)


def sound(system: SomeModel, numbers: Any) -> SomeModel:
    """The system with some traced numbers in it, if all of them are numbers; see `without_masses`."""
    traced = [x for x in jax.tree.leaves(numbers) if eqx.is_inexact_array(x) and not is_concrete(x)]
    return without_masses(system, [jnp.isnan(x) for x in traced])


def without_masses(system: SomeModel, wrong: Sequence[Array]) -> SomeModel:
    """The system, whose masses are not numbers if anything is wrong.

    So no step of it is solved, whatever its effects make of their numbers: a comparison with one that is
    none may leave a stop out.
    """
    if not wrong:
        return system
    bad = jnp.any(jnp.stack([jnp.any(x) for x in wrong]))
    return replace_fields(system, mass=jnp.where(bad, jnp.nan, system.mass))
