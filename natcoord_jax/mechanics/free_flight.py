"""Contacts that are apart: whose gaps a part of a step may close at its end, where an impact is located."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.constraint import FREE, RESTING
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.violations import contact_gaps
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model, SomeModel

TOUCHING = 1e-12
"""Gap at the start of a step, per unit of size of the places, up to which surfaces have met before: what the
last step has left of a gap that it closed."""

CLOSED = 1e-13
"""The same at which the part of a step ends that an impact splits off, at most."""

SLOW = 1e-8
"""Way in a step, per unit of size, up to which surfaces that meet or part rest on each other."""


def touch(system: Model, state: State, part: float = TOUCHING) -> Float[Array, ""]:
    """Gap [m] up to which surfaces touch."""
    return part * (system.size + jnp.max(jnp.abs(state.rows[:, 0])))


def bouncing_groups(system: Model) -> list[Any]:
    """Contacts that have impacts."""
    return [group for group in system.effects if group.effect.unilateral and group.effect.bounces]


def gaps_and_rates(
    system: Model, groups: Sequence[Group], state: State, v: Float[Array, "rows 3"]
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Gaps [m], and how fast velocities change them [m/s]."""

    def gaps(q: Array) -> Array:
        return contact_gaps(system, groups, replace_fields(state, q=q))

    return jax.jvp(gaps, (state.q,), (v,))


def lowest(gap: Array, begun: Array, ended: Array, h: Array) -> Array:
    """Least gap [m] between two instants, of those that fall at the first and rise at the second; else inf.

    Args:
        gap: at the first [m].
        begun: rate there [m/s], which changes evenly.
        ended: at the second.
        h: between them [s].
    """
    dips = (begun < 0) & (ended > 0)
    return jnp.where(dips, gap - 0.5 * h * begun**2 / jnp.where(dips, ended - begun, 1.0), jnp.inf)


def meeting(system: Model, groups: Sequence[Group], state: State) -> Bool[Array, " c"]:
    """Contacts that touch and close."""
    gap, rate = gaps_and_rates(system, groups, state, state.v)
    return (gap <= touch(system, state)) & (rate < 0)


def apart(system: Model, groups: Sequence[Group], state: State, dt: Array) -> Bool[Array, " c"]:
    """Contacts that are open at the start of a (part of a) step of length dt, or that open there."""
    gap, rate = gaps_and_rates(system, groups, state, state.v)
    return (gap > touch(system, state)) | (rate * dt > touch(system, state, SLOW))


def in_free_flight(system: SomeModel, state: State, dt: Array, free: Bool[Array, ""]) -> SomeModel:
    """The system with its contacts as they are in a part of a step: those that are apart do not push.

    Args:
        system: compiled system.
        state: at the start of the part.
        dt: step [s].
        free: whether the part ends where one closes; if not, they may push as in whole steps.
    """
    groups = bouncing_groups(system)
    closed = contact_gaps(system, groups, state) <= touch(system, state)
    phase = jnp.where(free & apart(system, groups, state, dt), FREE, jnp.where(closed, RESTING, 0))
    each = jnp.split(phase, np.cumsum([group.count for group in groups])[:-1])
    return eqx.tree_at(
        lambda s: [g.effect.phase for g in bouncing_groups(s)], system, each, is_leaf=lambda x: x is None
    )
