"""Matrices of bodies, effects and joints, and which unknowns of local equations they touch."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.model.groups import Group
from natcoord_jax.model.local_rates import TWIST
from natcoord_jax.model.model import Model


def touches(group: Group) -> bool:
    """Whether a group has anything to do with bodies."""
    return group.count > 0 and group.bodies.shape[1] > 0


def rates_of(group: Group) -> int:
    """Components of the twists of its bodies that a group has to do with: of points there is no spin."""
    return TWIST if group.turning else TWIST // 2


def bodies_of_elements(group: Group) -> Array | np.ndarray:
    """Bodies of the matrices of a group: those of its instances, or of their parts."""
    if not group.effect.spread:
        return group.bodies
    xp: Any = np if is_concrete(group.bodies, group.effect.parts) else jnp
    parts = xp.asarray(group.effect.parts)
    table = xp.take_along_axis(xp.asarray(group.bodies), parts.reshape(group.count, -1), axis=1)
    return table.reshape(-1, parts.shape[-1])


def elements(system: Model, stages: int = 1) -> list[Array | np.ndarray]:
    """The unknowns that each element of the Jacobian touches; on the host where the numbers are known.

    Args:
        system: compiled system.
        stages: of the collocation method.

    Returns:
        An array (count, width) for the bodies, for the mass between them if there is any, and for each group
        with bodies, in the order of `FullStep.matrices`; the number of unknowns stands for what is fixed.
    """
    groups = tuple(g for g in (*system.effects, *system.joints) if touches(g))
    tables = [bodies_of_elements(group) for group in groups]
    xp: Any = jnp
    if is_concrete(system.local_rates, tables):
        xp, tables = np, [np.asarray(table) for table in tables]
    first = stages * system.local_rates.count
    size = first + stages * sum(g.count * g.multipliers for g in groups)
    places = system.local_rates.places(stages, size, xp)
    found = [places[:-1].reshape(places.shape[0] - 1, -1)]
    if system.mass_between is not None:
        rates = system.mass_between.rates
        found.append(places[system.mass_between.bodies][..., :rates].reshape(-1, 2 * stages * rates))
    for group, table in zip(groups, tables):
        count, rows = table.shape[0], stages * group.multipliers
        lams = first + np.arange(count * rows, dtype=np.int32).reshape(count, rows)
        first += count * rows
        touched = places[table][..., : rates_of(group)].reshape(count, -1)
        found.append(xp.concatenate([touched, lams], axis=1))
    return found


def dense(
    system: Model,
    matrices: Sequence[Float[Array, "_ _ _"]],
    size: int,
    stages: int = 1,
    products: Sequence[Products | NeighbourCouplings] = (),
) -> Float[Array, "n n"]:
    """The dense matrix of element matrices, see `elements`, and of products."""
    # What is fixed goes beyond the matrix and is cut off.
    matrix = jnp.zeros((size + 1, size + 1), matrices[0].dtype)
    for touched, local in zip(elements(system, stages), matrices, strict=True):
        matrix = matrix.at[touched[:, :, None], touched[:, None, :]].add(local)
    matrix = matrix[:size, :size]
    return sum((product.to_dense() for product in products), matrix)
