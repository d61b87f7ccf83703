"""Redundant constraints: multipliers and rows in the range of the constraint matrix."""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.mechanics.violations import spans
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model

RANK = 1e-9
"""Part of what a motion of the size of the scene changes a constraint by that is rounding of nothing."""


def least_change(system: Model) -> Float[Array, ""] | None:
    """Change of constraints that counts, where their rank is not known: of scenes built inside of jit."""
    if system.structure.redundant:
        return None
    groups = [group for group in (*system.effects, *system.joints) if group.multipliers and group.holds]
    return RANK * jnp.max(jnp.concatenate([x.reshape(-1) for x in spans(system, groups)]))


def project_multipliers(y: Array, balances: int, projector: Array | None) -> Array:
    """Unknowns with their multipliers in the range of the constraints: reactions of minimum norm.

    At the mid-point of a step, off the manifold, redundant constraints are not quite dependent; multipliers
    outside of the range would then push along the free motion.
    """
    if projector is None:
        return y
    return jnp.concatenate([y[:balances], projector @ y[balances:]])


def project_rows(rows: Array, y: Array, balances: int, projector: Array | None) -> Array:
    """Constraint rates in the range of the constraints; the other rows set idle multipliers to zero."""
    if projector is None:
        return rows
    idle = y[balances:] - projector @ y[balances:]
    return projector @ rows + idle / (1.0 + rows.shape[0])


def at_every_stage(projector: Float[Array, "m m"], groups: Sequence[Group], stages: int) -> Array:
    """A projector of one stage for the multipliers of all; those of inequalities stay as they are."""
    held = held_multipliers(groups)
    if stages == 1 and held.all():
        return projector
    every = places_by_stage(groups, stages)
    full = jnp.zeros((every.size, every.size), projector.dtype)
    if not held.all():
        full = jnp.eye(every.size, dtype=projector.dtype)
        every = every[:, held]
    return full.at[every[:, :, None], every[:, None, :]].set(projector)


def held_multipliers(groups: Sequence[Group]) -> np.ndarray:
    """Which of the multipliers of one stage are of equations."""
    parts = [np.full(group.count * group.multipliers, group.holds) for group in groups]
    return np.concatenate([np.zeros(0, bool), *parts])


def places_by_stage(groups: Sequence[Group], stages: int) -> np.ndarray:
    """Places (stages, m) of the multipliers of each stage; they go group by group, then by stage."""
    places, position = [np.zeros((stages, 0), int)], 0
    for group in groups:
        shape = group.count, stages, group.multipliers
        here = position + np.arange(math.prod(shape)).reshape(shape)
        places.append(np.moveaxis(here, 1, 0).reshape(stages, -1))
        position += here.size
    return np.concatenate(places, axis=1)


def contact_mobilities(equations: Any) -> Float[Array, " multipliers"]:
    """What unit impulses of contacts do [1/kg], for all multipliers; 0 for those of equations."""
    stages, parts = equations.tableau.stages, [jnp.zeros(0)]
    for group in equations.groups:
        shape = group.count, stages, group.multipliers
        own = group.effect.mobility[:, None, None] if group.effect.unilateral else 0.0
        parts.append(jnp.broadcast_to(own, shape).reshape(-1))
    return jnp.concatenate(parts)


def contact_weights(equations: Any) -> Float[Array, " unknowns"]:
    """What makes energies [J] of the squares of what is missing in the rows of contacts; 0 for all others."""
    mobility = contact_mobilities(equations)
    weights = jnp.where(mobility > 0, 1.0 / jnp.where(mobility > 0, mobility, 1.0), 0.0)
    return jnp.concatenate([jnp.zeros(equations.balances), weights])
