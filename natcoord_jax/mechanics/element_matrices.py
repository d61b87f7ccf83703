"""Matrices of bodies, effects (of those on many bodies a sparse part and products) and joints."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.motion import NeighbourTangents, SpreadTangents
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.mechanics.local import body_motion, whole
from natcoord_jax.mechanics.response import step_context
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
    xp: Any = np if is_concrete(group.effect.parts) else jnp
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
    if is_concrete(tables):
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


def spreads(system: Model) -> bool:
    """Whether there are such effects."""
    return any(group.effect.spread for group in system.effects)


def _tangents(step: Any, group: Group, where: Any, twists: Float[Array, "bodies s 6"]) -> SpreadTangents:
    """Those of impulses."""
    motion = body_motion(
        step.start[group.bodies],
        whole(twists[group.bodies][..., : rates_of(group)]),
        where.h,
        step.tableau,
    )
    now = step_context(where, step.tableau)
    return group.effect.spread_tangents(where.place, motion, now, turning=group.turning)


def part_matrices(step: Any, group: Group, where: Any, twists: Array) -> Float[Array, "nf x x"]:
    """Of the parts of a group, by the unknowns in `elements`.

    Args:
        step: the equations.
        group: of an effect that is `spread`.
        where: what it needs besides the motion.
        twists: of all bodies and the ground.
    """
    found, bodies = _tangents(step, group, where, twists).parts, bodies_of_elements(group)
    if group.turning:
        along = step.system.local_rates.blocks(bodies, step.start)
        found = along(along(found, 1), 4)
    width = bodies.shape[1] * rates_of(group)
    return -where.h * found.reshape(-1, width, width)


def products(step: Any, twists: Float[Array, "bodies s 6"]) -> tuple[Products | NeighbourCouplings, ...]:
    """Of all groups, by all unknowns.

    Args:
        step: the equations, with one stage.
        twists: of all bodies and the ground.
    """
    if not spreads(step.system):
        return ()
    places = step.system.local_rates.places(1, step.unknowns)[:, 0]
    columns, rows, couplings = [], [], []
    for group, where in zip(step.groups, step.situations):
        if not group.effect.spread:
            continue
        found = _tangents(step, group, where, twists)
        if found.neighbours is not None:
            couplings += _couplings(step, group, where.h, places, found.neighbours)
        if found.columns is None or found.rows is None:
            continue
        touched = places[jnp.asarray(group.bodies)][..., : rates_of(group)].reshape(group.count, -1)
        along = step.system.local_rates.blocks(group.bodies, step.start)
        for kept, given, scale in ((columns, found.columns, -where.h), (rows, found.rows, 1.0)):
            given = along(given, 1) if group.turning else given
            each = jnp.arange(group.count)[:, None]
            zero = jnp.zeros((group.count, step.unknowns + 1), given.dtype)
            kept.append(zero.at[each, touched].add(scale * given.reshape(group.count, -1))[:, :-1])
    dense = (Products(jnp.concatenate(columns), jnp.concatenate(rows)),) if columns else ()
    return *dense, *couplings


def _couplings(
    step: Any, group: Group, h: Array, places: Int[Array, "bodies r"], found: NeighbourTangents
) -> list[NeighbourCouplings]:
    """Of what is near in this step, of each instance; the balances have minus the impulses."""
    bodies, maps = bodies_of_elements(group).reshape(group.count, -1), (found.across, found.along)
    if group.turning:
        along = step.system.local_rates.blocks(bodies, step.start)
        maps = tuple(along(x, 1) for x in maps)
    touched = places[jnp.asarray(bodies)][..., : rates_of(group)]
    # What is many is the last axis, so that what is computed is wide.
    across, along = (jnp.transpose(x[:, :, 0], (0, 3, 2, 1)) for x in maps)
    every = jnp.swapaxes(touched, 1, 2), across, along, found.pairs, h * found.stiffness
    each = (jax.tree.map(lambda x, k=k: x[k], every) for k in range(group.count))
    return [NeighbourCouplings(*given, size=step.unknowns) for given in each]
