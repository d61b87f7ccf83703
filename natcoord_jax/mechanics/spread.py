"""Derivatives of effects that are on many bodies at once: a sparse part, and products of columns and rows."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.core.motion import NeighbourTangents, SpreadTangents
from natcoord_jax.linsolve.neighbour_couplings import NeighbourCouplings
from natcoord_jax.linsolve.products import Products
from natcoord_jax.mechanics.element_matrices import bodies_of_elements, rates_of
from natcoord_jax.mechanics.local import body_motion, whole
from natcoord_jax.mechanics.response import step_context
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model


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
