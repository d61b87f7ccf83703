"""Masses of cells of solids, lumped at their nodes and consistent with the motion between them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.cells import CELLS, mass_quadrature, quadrature, shapes
from natcoord_jax.maths.vectors import cross


def lumped_mass(nodes: int, volumes: Float[Array, " g"], density: Float[Array, ""]) -> Float[Array, " k"]:
    """In proportion to the integrals of the squared shape functions, of which none is negative [kg].

    Of a box the moments of inertia are exact with 27 nodes, not with 8 or 20 (E. Hinton, T. Rock, O. C.
    Zienkiewicz, Earthq. Eng. Struct. Dyn. 4 (1976) 245-249).
    """
    share = shapes(CELLS[nodes], quadrature(nodes)[0])[0].T ** 2 @ volumes
    return density * jnp.sum(volumes) * share / jnp.sum(share)


def consistent_mass(
    nodes: int, reference: Float[Array, "k 3"], density: Float[Array, ""]
) -> Float[Array, "k 1 k 1"]:
    """Integrals of the density times the products of the shape functions of a cell [kg]."""
    points, weights = mass_quadrature(nodes)
    values, slopes = shapes(CELLS[nodes], points)
    a, b, c = jnp.moveaxis(reference.T @ slopes, -1, 0)
    volumes = weights * jnp.sum(a * cross(b, c), axis=-1)
    return density * ((values.T * volumes) @ values)[:, None, :, None]
