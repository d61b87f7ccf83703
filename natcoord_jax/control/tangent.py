"""Small changes of a state in few numbers: displacements and rates of the free motions.

The step (57) carries the velocities of all rows on, also what little of them is normal to the constraints.
The curvature that the solver uses is that of steps whose velocities are projected, which differs by a part of
order dt^2; it needs two numbers for every free motion instead of twelve for every body. The gradients are
those of the step itself.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.coordinates import coordinate_rates, state_rates
from natcoord_jax.mechanics.momentum import inertia
from natcoord_jax.mechanics.rates import null_space, tree_rates, twists
from natcoord_jax.model.rows import row_rates, rows_with_ground
from natcoord_jax.system import System

SMALL = 1e-13
"""Regularisation of the inertia of the free motions, relative; motions without inertia are left alone."""


def _rotor_places(system: System) -> Array:
    """Coordinates whose rates are stored."""
    places = [group.coordinates[:, 0] for group in system.effects if group.effect.rotors]
    return jnp.concatenate(places) if places else jnp.zeros(0, int)


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


def split(
    system: System, state: State, w: Float[Array, " n"], worth: Float[Array, " n"]
) -> tuple[State, Float[Array, ""]]:
    """State with given rates of the free motions, and what the momenta are worth that they leave out.

    Where these momenta vanish, the rates are those of `steady_rates`: the projection as an equation for its
    result.
    """
    rows = state.rows
    both = jnp.stack([w, worth])
    velocity, spin = (jnp.einsum("bnc,kn->kbc", x, both) for x in null_space(system, rows))
    moving, virtual = jax.vmap(row_rates, in_axes=(None, 0, 0))(rows, velocity, spin)
    left = jnp.sum(virtual * _with_mass(system, state.v - moving.reshape(-1, 3)))
    still, places = replace_fields(state, v=moving.reshape(-1, 3)), _rotor_places(system)
    return (replace_fields(still, rates=state_rates(system, still)[places]) if places.size else still), left


def tangent_maps(
    system: System, state: State
) -> tuple[Float[Array, "x z"], Float[Array, "z x"], Float[Array, "n n"]]:
    """Changes of a state vector per displacement and rate of each free motion, and the way back.

    Args:
        system: compiled system.
        state: where the changes are made.

    Returns:
        Z, whose first half of columns are displacements with rates kept and whose second half are rates; a
        left inverse of Z that keeps momenta, the projection in the metric of the mass; and the inverse of
        the inertia of the free motions.
    """
    rows, w = state.rows, tree_rates(system, state)
    velocity, spin = null_space(system, rows)
    count, size = velocity.shape[1], state.q.size

    def column(v: Array, omega: Array) -> tuple[Array, Array, Array]:
        moved, still = row_rates(rows, v, omega), jnp.zeros((1, *NODE), rows.dtype)
        moving, spin = jnp.concatenate([moved, still]), jnp.concatenate([omega, still[:, 0]])
        rates = coordinate_rates(system, rows_with_ground(state.q), moving, spin)
        turned = jax.jvp(lambda r: row_rates(r, *twists(system, r, w)), (rows,), (moved,))[1]
        return moved.reshape(-1), turned.reshape(-1), rates

    moved, turned, rates = jax.vmap(column, in_axes=1, out_axes=1)(velocity, spin)
    places = _rotor_places(system)
    stored = jnp.zeros((places.shape[0], count), rows.dtype)
    displaced = jnp.concatenate([moved, turned, rates, stored])
    quickened = jnp.concatenate([jnp.zeros_like(moved), moved, jnp.zeros_like(rates), rates[places]])
    forth = jnp.concatenate([displaced, quickened], axis=1)
    heavy = _with_mass(system, moved.reshape(-1, 3, count)).reshape(size, count)
    inertia = moved.T @ heavy
    diagonal = jnp.diagonal(inertia)
    floor = SMALL * jnp.where(diagonal > 0, diagonal, 1.0)
    flexibility = jnp.linalg.inv(inertia + jnp.diag(floor))
    project = flexibility @ heavy.T
    rest = jnp.zeros((count, forth.shape[0] - 2 * size), rows.dtype)
    upper = jnp.concatenate([project, jnp.zeros_like(project), rest], axis=1)
    lower = jnp.concatenate([-(project @ turned) @ project, project, rest], axis=1)
    return forth, jnp.concatenate([upper, lower]), flexibility
