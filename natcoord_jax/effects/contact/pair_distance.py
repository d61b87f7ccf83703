"""Distances of many pairs of segments or points by their invariants; pairs are the last axis of all arrays.

The axes d_1 and d_2 of two segments, and r from the first end of the second to that of the first, have six
products; of two points there is r alone, and its square. A step moves the products exactly along the mean of
the vectors at its start and its end, so that an energy of the products has an exact discrete gradient.
"""

from collections.abc import Iterable
from functools import reduce
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.effects.contact.law import ContactLaw, closing_speed
from natcoord_jax.effects.contact.pairs import TOWARDS_MIDDLE, nearest_points, segment_distance_square
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.vectors import safe_sqrt
from natcoord_jax.xla.materialise import materialised

VECTORS: Any = {1: np.array([[1, -1]]), 2: np.array([[-1, 1, 0, 0], [0, 0, -1, 1], [1, 0, -1, 0]])}
"""d_1, d_2 and r by the ends of both segments; r by two points."""

PRODUCTS: Any = {1: np.array([[0], [0]]), 2: np.array([(0, 1, 0, 0, 1, 2), (0, 1, 1, 2, 2, 2)])}
"""Which vectors are in each product."""


def vectors(ends: Float[Array, "v 3 n"], pairs: Int[Array, "2 p"]) -> Float[Array, "d 3 p"]:
    """Vectors of pairs.

    Args:
        ends: of each segment, or points.
        pairs: numbers of two of them.
    """
    both = jnp.moveaxis(ends[..., pairs], 2, 0).reshape(2 * ends.shape[0], 3, pairs.shape[-1])
    return jnp.sum(VECTORS[ends.shape[0]][..., None, None] * both, axis=1)


def products(one: Float[Array, "d 3 p"], other: Float[Array, "d 3 p"]) -> Float[Array, "c p"]:
    """Of vectors with the same or with others."""
    first, second = PRODUCTS[1 + (one.shape[0] > 1)]
    return jnp.sum(one[first] * other[second], axis=1)


def rates_of(at: Float[Array, "d 3 p"], velocity: Float[Array, "d 3 p"]) -> Float[Array, "c p"]:
    """Of the products, of vectors with these velocities."""
    return products(at, velocity) + products(velocity, at)


def distance(found: Float[Array, "c p"]) -> Float[Array, " p"]:
    """Of the nearest points, by the products."""
    return safe_sqrt(found[0] if found.shape[0] == 1 else segment_distance_square(found))


class Pushes(eqx.Module):
    """An energy of the overlaps of pairs along a step.

    Attributes:
        law: of the overlap.
        radii: sums of those of the two; zero where there is no pair: what has no size does not overlap.
        start: vectors at the start.
        h: step [s].
        tableau: of the scheme.
    """

    law: ContactLaw
    radii: Float[Array, " p"]
    start: Float[Array, "d 3 p"]
    h: Float[Array, ""]
    tableau: Tableau = eqx.field(static=True)

    def middle(self, velocity: Float[Array, "d 3 p"]) -> Float[Array, "d 3 p"]:
        """Vectors in the middle of the step, for mean velocities."""
        return self.start + 0.5 * self.h * velocity

    def gradients(self, flow: Float[Array, "c p"]) -> tuple[Float[Array, "c p"], Float[Array, "c p"]]:
        """Of the energy by the products, averaged along a step, without what impacts lose and with it.

        Args:
            flow: mean rates of the products.
        """
        begun = products(self.start, self.start)
        before = distance(begun) - self.radii
        if begun.shape[0] == 1:
            # The change of a distance is that of the square over the sum of both: no digits cancel.
            both = safe_sqrt(begun[0]) + safe_sqrt(begun[0] + self.h * flow[0])
            inverse = jnp.where(both > 0, 1.0 / jnp.where(both > 0, both, 1.0), 0.0)
            closing = -inverse * flow[0]
            elastic = -(self.law.mean_force(before, before - self.h * closing) * inverse)[None]
        else:
            given = self.energy, begun, self.h * flow[None], self.tableau, None
            elastic, closing = averaged_gradient(*given)[0], closing_speed(distance, begun, flow, self.h)
        return elastic, self.law.lossy(closing) * elastic

    def energy(self, found: Float[Array, "c p"]) -> Float[Array, " p"]:
        """Energy of each pair [J], by the products."""
        return self.law.stored_at(distance(found) - self.radii)

    def forces(
        self, gradient: Float[Array, "c p"], velocity: Float[Array, "d 3 p"]
    ) -> Float[Array, "v 3 2 p"]:
        """On the ends of both segments [N]."""
        return _on_ends(-_pulled(gradient, self.middle(velocity)))

    def tangents(
        self, velocity: Float[Array, "d 3 p"]
    ) -> tuple[Float[Array, "v 3 2 p"], Float[Array, "w w p"]]:
        """Forces on the ends, and minus their derivatives by the increments of the ends along the step.

        With the gradients S of the products, and vectors in the middle and at the end,
        d f = -(G_m^T S' G_1 + 1/2 sum_i S_i Q_i) d(D x), as in `core.closed_tangents`.
        """
        middle, end = self.middle(velocity), self.start + self.h * velocity
        flow = rates_of(middle, velocity)
        gradient, slopes = self.gradients(flow)[1], self._slopes(flow)
        # What is one product is as soon computed again.
        once = materialised if len(gradient) > 1 else lambda x: x
        across, along = once((_by_ends(middle), _by_ends(end)))
        # Written out: a sum along an axis takes ten times as long.
        along = once(_added(slopes[:, k, None] * x for k, x in enumerate(along)))
        whole = _added(x[:, None] * y for x, y in zip(across, along))
        weights, (one, other) = VECTORS[1 + (len(gradient) > 1)], PRODUCTS[1 + (len(gradient) > 1)]
        pairs = weights[one][:, :, None] * weights[other][:, None]
        pairs = 0.5 * (pairs + np.swapaxes(pairs, 1, 2))
        geometric = _added(weight[..., None] * x for weight, x in zip(pairs, gradient))
        width = 3 * len(geometric)
        geometric = geometric[:, None, :, None] * np.eye(3)[:, None, :, None]
        whole = whole + geometric.reshape(width, width, -1)
        return self.forces(gradient, velocity), whole

    def _slopes(self, flow: Float[Array, "c p"]) -> Float[Array, "c c p"]:
        """Of the gradients by the increments of the products; of segments nearly.

        A gradient is minus a force P times that of the distance, averaged: it changes as the force does with
        the distance at the end, and as the gradient of the distance does in the middle.
        """
        rate = 1.0 / jnp.where(self.h > 0, self.h, 1.0)
        if flow.shape[0] == 1:
            moved = jnp.full_like(flow, 1.0) * rate
            return jax.jvp(lambda x: self.gradients(x)[1], (flow,), (moved,))[1][:, None]
        begun = products(self.start, self.start)
        middle, end = begun + 0.5 * self.h * flow, begun + self.h * flow
        before, after = (distance(x) - self.radii for x in (begun, end))

        def push(after: Float[Array, " p"]) -> Float[Array, " p"]:
            return self.law.lossy(rate * (before - after)) * self.law.mean_force(before, after)

        force, softer = jax.jvp(push, (after,), (jnp.ones_like(after),))
        along, ended = materialised((_gradient(middle), _gradient(end)))
        return -softer * along[:, None] * ended - 0.5 * force * _curvature(middle, along)


def _added(terms: Iterable[Array]) -> Array:
    return reduce(add, terms)


def _gradient(found: Float[Array, "c p"]) -> Float[Array, "c p"]:
    """Of the distance by the products."""
    value, pulled = jax.vjp(distance, found)
    return pulled(jnp.ones_like(value))[0]


def _curvature(found: Float[Array, "6 p"], along: Float[Array, "6 p"]) -> Float[Array, "6 6 p"]:
    """Second derivatives of the distance of segments by the products, nearly.

    The square of the distance is linear in the products for given nearest points s and t, which minimise it
    but for what draws them to their middles.

    Args:
        found: products.
        along: gradient of the distance.
    """
    (s, t), pulled = jax.vjp(nearest_points, found)
    one, none = jnp.ones_like(s), jnp.zeros_like(s)
    s, t, by_s, by_t = materialised((s, t, pulled((one, none))[0], pulled((none, one))[0]))
    with_s = jnp.stack([2 * s, none, -2 * t, 2 * one, none, none])
    with_t = jnp.stack([none, 2 * t, -2 * s, none, -2 * one, none])
    little = TOWARDS_MIDDLE * (found[0] + found[1])
    square = (with_s - 2 * little * by_s)[:, None] * by_s + (with_t - 2 * little * by_t)[:, None] * by_t
    size = distance(found)
    return (0.5 * square - along[:, None] * along) / jnp.where(size > 0, size, 1.0)


def _by_ends(at: Float[Array, "d 3 p"]) -> Float[Array, "c w p"]:
    """Derivatives of the products by the ends of both segments."""
    weights, (one, other) = VECTORS[1 + (at.shape[0] > 1)], PRODUCTS[1 + (at.shape[0] > 1)]
    found = [weights[i][:, :, None, None] * at[k][:, None] for i, k in ((one, other), (other, one))]
    return (found[0] + found[1]).reshape(len(one), -1, at.shape[-1])


def _pulled(gradient: Float[Array, "c p"], at: Float[Array, "d 3 p"]) -> Float[Array, "d 3 p"]:
    """Gradient by the vectors from that by their products."""
    return jax.vjp(lambda x: products(x, x), at)[1](gradient)[0]


def _on_ends(x: Float[Array, "d 3 *rest p"]) -> Float[Array, "v 3 2 *rest p"]:
    """On the ends of both segments, of what is on the vectors between them."""
    weights = VECTORS[1 + (x.shape[0] > 1)].T
    found = jnp.sum(weights.reshape(*weights.shape, *(1,) * (x.ndim - 1)) * x, axis=1)
    return jnp.moveaxis(found.reshape(2, -1, *x.shape[1:]), 0, 2)
