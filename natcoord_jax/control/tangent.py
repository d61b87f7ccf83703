"""Small changes of a state: displacements of the free motions, and velocities."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.coordinates import coordinate_rates
from natcoord_jax.mechanics.momentum import inertia
from natcoord_jax.mechanics.rates import null_space
from natcoord_jax.model.rows import row_rates, rows_with_ground
from natcoord_jax.system import System

SMALL = 1e-13
"""Regularisation of the inertia of the free motions, relative; motions without inertia are left alone."""


def _with_mass(system: System, rates: Array) -> Array:
    """Velocities of rows times the mass matrix, trailing axes kept."""
    by_body = rates.reshape(-1, 4, 3, *rates.shape[2:])
    return jnp.moveaxis(
        inertia(system, jnp.moveaxis(by_body, (0, 1, 2), (-3, -2, -1))), (-3, -2, -1), (0, 1, 2)
    )


def steady_rates(system: System, state: State) -> Float[Array, " n"]:
    """Rates of the free motions with the momenta of a state: the projection in the metric of the mass.

    Unlike the relative rates of joints it sees nothing of velocities normal to the constraints, so that
    rates vanish together with momenta.
    """
    rows = state.rows
    velocity, spin = null_space(system, rows)

    def rates_of(w: Array) -> Array:
        return row_rates(rows, jnp.einsum("bnc,n->bc", velocity, w), jnp.einsum("bnc,n->bc", spin, w))

    def along(force: Array) -> Array:
        return jax.vjp(rates_of, jnp.zeros(velocity.shape[1], rows.dtype))[1](force)[0]

    units = jnp.eye(system.structure.unknowns, dtype=rows.dtype)
    inertia = jax.vmap(lambda unit: along(_with_mass(system, rates_of(unit).reshape(-1, 3))))(units)
    diagonal = jnp.diagonal(inertia)
    floor = SMALL * jnp.where(diagonal > 0, diagonal, 1.0)
    return jnp.linalg.solve(inertia + jnp.diag(floor), along(_with_mass(system, state.v)))


def tangent_maps(system: System, state: State) -> tuple[Float[Array, "x z"], Float[Array, "z x"]]:
    """Changes of a state vector per displacement of each free motion and per velocity, and the way back.

    The step (57) carries the velocities of all rows on, also what is normal to the constraints: they are all
    there. Positions obey the constraints exactly.

    Args:
        system: compiled system.
        state: where the changes are made.

    Returns:
        Z, whose columns are displacements with velocities kept, then velocities, then stored rates of rotors;
        and a left inverse of Z.
    """
    rows = state.rows
    velocity, spin = null_space(system, rows)
    count, size = velocity.shape[1], state.q.size

    def column(v: Array, omega: Array) -> tuple[Array, Array]:
        moved, still = row_rates(rows, v, omega), jnp.zeros((1, *NODE), rows.dtype)
        moving, spin = jnp.concatenate([moved, still]), jnp.concatenate([omega, still[:, 0]])
        return moved.reshape(-1), coordinate_rates(system, rows_with_ground(state.q), moving, spin)

    moved, rates = jax.vmap(column, in_axes=1, out_axes=1)(velocity, spin)
    heavy = _with_mass(system, moved.reshape(-1, 3, count)).reshape(size, count)
    inertia = moved.T @ heavy
    diagonal = jnp.diagonal(inertia)
    floor = SMALL * jnp.where(diagonal > 0, diagonal, 1.0)
    project = jnp.linalg.solve(inertia + jnp.diag(floor), heavy.T)
    stored, counted = state.rates.size, rates.shape[0]
    velocities = jnp.eye(size + stored, dtype=rows.dtype)

    def none(*shape: int) -> Array:
        return jnp.zeros(shape, rows.dtype)

    forth = jnp.block([
        [moved, none(size, size + stored)],
        [none(size, count), velocities[:size]],
        [rates, none(counted, size + stored)],
        [none(stored, count), velocities[size:]],
    ])  # fmt: skip
    upper = jnp.concatenate([project, none(count, forth.shape[0] - size)], axis=1)
    lower = [velocities[:, :size], none(size + stored, counted), velocities[:, size:]]
    lower = jnp.concatenate([none(size + stored, size), *lower], axis=1)
    back = jnp.concatenate([upper, lower])
    return forth, back
