"""Redundant constraints: multipliers and rows in the range of the constraint matrix."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.system import Group


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
    """A projector of one stage for the multipliers of all."""
    if stages == 1:
        return projector
    every = places_by_stage(groups, stages)
    full = jnp.zeros((every.size, every.size), projector.dtype)
    return full.at[every[:, :, None], every[:, None, :]].set(projector)


def places_by_stage(groups: Sequence[Group], stages: int) -> np.ndarray:
    """Places (stages, m) of the multipliers of each stage; they go group by group, then by stage."""
    places, position = [np.zeros((stages, 0), int)], 0
    for group in groups:
        shape = group.count, stages, group.multipliers
        here = position + np.arange(math.prod(shape)).reshape(shape)
        places.append(np.moveaxis(here, 1, 0).reshape(stages, -1))
        position += here.size
    return np.concatenate(places, axis=1)
