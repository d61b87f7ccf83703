"""Contact as an energy of a gap that is no function of a few invariants: of surfaces, as they are meshed.

A force that does exactly the work of an energy V(g) of a gap g, and neither pushes nor turns as a whole, is
-[V(g_1) - V(g_0)] / (g_1 - g_0) times a discrete derivative of the gap,

    D g = G_m + [g(q_1) - g(q_0) - G_m . (q_1 - q_0)] c / |Delta pi|^2,    c = D pi(q_m)^T Delta pi,

with any lever G_m in the middle of the step whose sum and moment vanish, and squares of distances pi, whose
derivatives have neither as well. Both gaps are those of the places themselves: whatever facet is the nearest
there, it is the same function at the end of a step and at the start of the next.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.core.closed_tangents import by_twists
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.potential import marker_response, place_markers
from natcoord_jax.effects.contact.law import ContactLaw

RIGID = 1e-20
"""Square of the change of distances, relative to theirs, below which the points move as a rigid body."""

OVERLAPPING = 1e-6
"""Overlap at the start, relative to the size of the facets, that is more than rounding of places."""


class Measured(eqx.Module):
    """A gap at one place of its points.

    Attributes:
        gap: of the surfaces, negative where they overlap [m].
        lever: covector whose sum and moment vanish, near enough the derivative of the gap [-].
        between: numbers of the points whose distances carry the correction of the lever.
    """

    gap: Float[Array, ""]
    lever: Float[Array, "k 3"]
    between: Int[Array, " p"]


class DiscreteGap(ContactLaw):
    """Base of contacts of points: subclass it and give what is `measured` of them.

    Unlike that of `GapPotential`, the gap may be any function of the points that does not change when all of
    them move as a rigid body.

    Attributes:
        markers: points that the gap is between.
        name: optional name.
    """

    initial: Any = eqx.field(default=None, init=False)

    derived: ClassVar[tuple[str, ...]] = ("damping", "initial")

    @abc.abstractmethod
    def measured(self, x: Float[Array, "k 3"]) -> Measured:
        """Gap, lever, and the points that they are between."""

    def turned(self, x: Float[Array, "k 3"]) -> Float[Array, "k 3 k 3"] | None:
        """Derivatives of the lever by the points, nearly, for Newton's method; None: it hardly changes."""
        return None

    def gap(self, x: Float[Array, "k 3"]) -> Float[Array, ""]:
        """Distance of the surfaces, negative where they overlap [m]."""
        return self.measured(x).gap

    def touch(self, place: Array, rows: Array) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Its first point [m], and the force on the side of that by the force of the law [-]."""
        x = place_markers(place, rows)
        return x[0], self.measured(x).lever[0]

    def assembled_at(self, x: Float[Array, "k 3"]) -> "DiscreteGap":
        """With its damping, and the gap that it starts with in terms of the size of all."""
        damped: Any = self.renewed()
        return replace_fields(damped, initial=_relative_gap(self, x))

    def flaws(self) -> dict[str, Array]:
        """A start in penetration."""
        said = "starts in penetration, with energy that nothing put there; move the surfaces apart"
        return {} if self.initial is None else {said: self.initial < -OVERLAPPING}

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The force of the law along the discrete derivative of the gap, and more of it where it closes."""
        start, rates = place_markers(place, motion.start), place_markers(place, motion.rates)
        stages = place_markers(place, motion.rows if motion.force_rows is None else motion.force_rows)
        weights = jnp.asarray(now.tableau.b)
        begun, ended, derivatives = self._discrete(start, stages, now.h * rates, weights)
        elastic = self.mean_force(begun.gap, ended.gap)
        flow = jnp.einsum("i,ikx,ikx->", weights, derivatives, rates)
        forces = elastic * derivatives
        given = jnp.sum(forces * rates, axis=(1, 2))
        found = marker_response(place, self.lossy(-flow) * forces, None, rates, motion)
        return found if self.damping is None else replace_fields(found, released=given)

    def _discrete(
        self, start: Array, stages: Float[Array, "s k 3"], moved: Float[Array, "s k 3"], weights: Array
    ) -> tuple[Measured, Measured, Float[Array, "s k 3"]]:
        """What is measured at both ends of a step, and the discrete derivatives at its stages."""
        end = start + jnp.einsum("i,ikx->kx", weights, moved)
        every = jax.vmap(self.measured)(jnp.concatenate([start[None], end[None], stages]))
        begun, ended, first = (jax.tree.map(lambda y, k=k: y[k], every) for k in range(3))
        levers, at = every.lever[2:], first.between
        # Pairs of points, and by how much the squares of their distances change along the whole step.
        apart, parting = _apart(stages, at), _apart(moved, at)
        changes = 2.0 * jnp.einsum("i,iabx,iabx->ab", weights, apart, parting)
        square, scale = jnp.sum(changes**2), jnp.sum(jnp.sum(apart[0] ** 2, axis=2) ** 2)
        loose = square > RIGID * scale
        missing = ended.gap - begun.gap - jnp.einsum("i,ikx,ikx->", weights, levers, moved)
        factor = jnp.where(loose, missing / jnp.where(loose, square, 1.0), 0.0)
        # Every pair is there twice: half of the sum, and both of its points.
        carried = 4.0 * factor * jnp.einsum("ab,iabx->iax", changes, apart)
        return begun, ended, levers.at[:, at].add(carried)

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Array, *, turning: bool
    ) -> Array | None:
        """Those of the size of the force, and of its direction where it says how its lever turns."""
        if motion.spin.shape[-2] > place.shape[1] or now.tableau.stages > 1 or place.ndim > 3:
            return None

        def one(effect: Any, place: Array, start: Array, middle: Array, rates: Array) -> tuple[Array, Array]:
            x, rate = (place_markers(place, y)[None] for y in (middle, rates))
            begun = place_markers(place, start)
            first, last, found = effect._discrete(begun, x, now.h * rate, jnp.ones(1))
            moving = now.h > 0

            def force(after: Array) -> Array:
                speed = (first.gap - after) / jnp.where(moving, now.h, 1.0)
                return effect.mean_force(first.gap, after) * effect.lossy(jnp.where(moving, speed, 0.0))

            size, slope = jax.value_and_grad(force)(last.gap)
            along, turned = found[0].reshape(-1), effect.turned(x[0])
            stiffness = -slope * along[:, None] * last.lever.reshape(-1)
            if turned is not None:
                # The middle of a step moves by half of what its end does.
                stiffness = stiffness - 0.5 * size * turned.reshape(stiffness.shape)
            return stiffness, size * found[0]

        stiffness, forces = jax.vmap(one)(self, place, motion.start, motion.rows[0], motion.rates[0])
        return by_twists(stiffness, forces[:, :, None], place[:, :, None], motion, now.h, turning)

    def gap_at(self, place: Array, rows: Array) -> Float[Array, ""]:
        """Between the surfaces [m]."""
        return self.gap(place_markers(place, rows))


def _apart(x: Float[Array, "s k 3"], at: Int[Array, " p"]) -> Float[Array, "s p p 3"]:
    """Differences of pairs of points."""
    some = x[:, at]
    return some[:, :, None] - some[:, None]


@eager_numpy
def _relative_gap(gap: DiscreteGap, x: Float[Array, "k 3"]) -> Float[Array, ""]:
    """The gap in terms of the size of all."""
    return gap.gap(x) / jnp.sqrt(jnp.max(jnp.sum((x - x[0]) ** 2, axis=1)))
