"""Potentials: an energy of invariants of markers."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.closed_tangents import tangents_together
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.gradient import averaged_coupling, averaged_gradient, cancelling_energy, gradient_of
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.kinds import NAME
from natcoord_jax.core.markers import Attachment, Marker, Markers
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.together import chunked, instances_last, place_together, steps_together
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.xla.materialise import materialised


def place_markers(place: Float[Array, "k *m w"], rows: Float[Array, "*s b 4 3"]) -> Float[Array, "*out"]:
    """Marker vectors x_k = sum_a w_ka q_a, of the rows of one body or of several; of attachments four."""
    several = rows.shape[-3] // place.shape[0]
    if several > 1:
        rows = rows.reshape(*rows.shape[:-3], place.shape[0], NODE[0] * several, 3)
    if place.ndim == 3:
        rows = rows[..., None, :, :]
    return jnp.sum(place[..., None] * rows, axis=-2)


class MarkerEffect(Effect):
    """Base of effects on markers."""

    markers: Any = eqx.field(metadata=is_a(Markers()))
    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))

    def attach(self, find: Callable[[Handle], tuple[Joint, Array]]) -> Sequence[Marker | Attachment]:
        """Markers of the effect; effects on a joint look it up with `find`: handle to (joint, triad)."""
        return self.markers


class Potential(MarkerEffect):
    """Base of elastic effects between markers: subclass it and give `invariants` and `energy`.

    The invariants must be at most quadratic in the marker vectors, and unchanged when all of them are
    rotated (and, for points, moved) together: then energy, momentum and angular momentum are kept exactly.

    Attributes:
        markers: points and directions, or attachments, that the energy depends on, in the order
            `invariants` receives them: a point or a direction as (3,), an attachment as (4, 3).
        name: optional name.

    Class attributes:
        degree: polynomial degree of `energy` in the invariants, if it is a polynomial; saves work.
        points: of the quadrature along a step, if it is none; more make the force a better average, energy is
            exact with any number. Default: two more than twice the stages.
        units: numbers of consecutive invariants that have the same unit; None: all have. What each is rounded
            by is told from the largest.
        together: whether `invariants` and `energy` (and `slope` and `curvature`, if they are given) also take
            many instances at once, whose numbers, marker vectors and invariants then have one more axis, the
            last. That is much faster than a function of one instance that is vmapped.

    Example:
        >>> import natcoord_jax as nc
        >>> class Tether(nc.Potential):
        ...     stiffness: float = 1.0
        ...     degree = 2
        ...     def invariants(self, x):
        ...         return ((x[1] - x[0]) @ (x[1] - x[0]))[None]
        ...     def energy(self, invariants):
        ...         return 0.5 * self.stiffness * invariants[0] ** 2
    """

    kind: ClassVar[str] = "potential"
    stores: ClassVar[bool] = True
    elastic: ClassVar[bool] = True
    degree: ClassVar[int | None] = None
    points: ClassVar[int | None] = None
    units: ClassVar[tuple[int, ...] | None] = None
    together: ClassVar[bool] = False

    @abc.abstractmethod
    def invariants(self, x: Float[Array, "k *m 3"]) -> Float[Array, " p"]:
        """Invariants of the marker vectors, at most quadratic."""

    @abc.abstractmethod
    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""

    def slope(self, invariants: Float[Array, " p"]) -> Float[Array, " p"]:
        """Gradient of the energy by the invariants."""
        return gradient_of(self.energy, invariants)

    def energy_curvature(self, invariants: Float[Array, " p"]) -> Float[Array, "p p"]:
        """Second derivatives of the energy by the invariants; for Newton's Jacobian."""
        return jax.hessian(self.energy)(invariants)

    @property
    def viscosity(self) -> Float[Array, "p p *n"] | None:
        """Stresses by rates of the invariants, symmetric and not negative; None: nothing is lost.

        What is lost is the work in the account of the effect: `works` must then be true.
        """
        return None

    def pulled_back(self, x: Float[Array, "k *m 3"], gradient: Float[Array, " p"]) -> Float[Array, "k *m 3"]:
        """Gradient by the marker vectors from that by the invariants."""
        return jax.vjp(self.invariants, x)[1](gradient)[0]

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Forces -D pi^T S_i with the averaged gradients S_i, D pi where forces take hold."""
        start = self.invariants(place_markers(place, motion.start))
        if start.ndim != 1:
            raise ValueError(
                f"{type(self).__name__}.invariants has shape {start.shape}; make it one axis of invariants, "
                "of a single one `value[None]`"
            )

        def gradient(steps: Float[Array, "s p"]) -> Float[Array, "s p"]:
            found = self.averaged(start, steps, now.tableau)
            return found if now.stress is None else found + now.stress

        return _response(self, gradient, place, motion, now)

    def responses(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Forces of all instances, at once if they can be."""
        as_usual = motion.force_rows is None and now.stress is None and not now.tableau.variational
        if not (self.together and as_usual):
            return super().responses(place, motion, now, lam)
        return chunked(responses_together, self, place, motion, now)

    def averaged(
        self, start: Float[Array, "p *n"], steps: Float[Array, "s p *n"], tableau: Tableau
    ) -> Float[Array, "s p *n"]:
        """Averaged gradients, see `averaged_gradient`."""
        points = self.points if self.points is None else self.points + tableau.stages - 1
        given = self.energy, start, steps, tableau, self.degree, points
        return averaged_gradient(*given, self.slope, self.units)

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Array, *, turning: bool
    ) -> Array | None:
        """In formulas for one stage, of what takes many instances at once on markers of single bodies."""
        several = motion.spin.shape[-2] > place.shape[1]
        if not self.together or several or now.tableau.stages > 1 or now.stress is not None:
            return None
        return chunked(partial(tangents_together, turning=turning), self, place, motion, now)

    def linearised(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> "LinearisedPotential":
        """The potential with gradients that are linear in the steps of the invariants."""
        start = self.invariants(place_markers(place, motion.start))
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        steps = steps_together(self, x, now.h * rates)
        gradient = self.averaged(start, steps, now.tableau)
        middle = start + 0.5 * jnp.asarray(now.tableau.b) @ steps
        if now.stress is not None:
            gradient = gradient + now.stress
        return LinearisedPotential(self, steps, gradient, self.energy_curvature(middle))

    def strain_rates(self, place: Array, motion: Motion, h: Array) -> Array:
        """Rates of the invariants at the stages: h times them are the increments."""
        return steps_together(self, place_markers(place, motion.rows), place_markers(place, motion.rates))

    def curvature(self, place: Array, rows: Array, coordinates: Array) -> Array:
        """Second derivatives of the energy [J per squared unit of invariant]."""
        return self.energy_curvature(self.invariants(place_markers(place, rows)))

    def cancelling(self, place: Array, rows: Array, coordinates: Array) -> tuple[Array, Array]:
        """Stiffness times invariants, of which the stresses are differences; the distance of the markers."""
        x = place_markers(place, rows)
        points = x if place.ndim == 2 else x[:, 0]
        reach = jnp.sqrt(jnp.max(jnp.sum((points - points[0]) ** 2, axis=-1), initial=0.0))
        return cancelling_energy(self.energy, self.invariants(x), self.units), reach

    def quadratic(self, place: Array, rows: Array) -> Array:
        """The invariants."""
        return jnp.ravel(self.invariants(place_markers(place, rows)))

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Array:
        """Energy [J]."""
        return self.energy(self.invariants(place_markers(place, rows)))


class LinearisedPotential(eqx.Module):
    """A potential near one motion, see `Effect.linearised`.

    Attributes:
        potential: it gives the invariants.
        steps: of the invariants at that motion.
        gradient: averaged gradients there.
        curvature: second derivatives of the energy at the middle of the step.
    """

    potential: Potential
    steps: Float[Array, "s p"]
    gradient: Float[Array, "s p"]
    curvature: Float[Array, "p p"]

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The response with linear gradients."""
        coupling = averaged_coupling(now.tableau.stages)

        def gradient(steps: Float[Array, "s p"]) -> Float[Array, "s p"]:
            moved = coupling @ (steps - self.steps)
            return self.gradient + jnp.sum(self.curvature * moved[:, None], axis=-1)

        return _response(self.potential, gradient, place, motion, now)


def _response(
    potential: Potential, gradient: Callable[[Array], Array], place: Array, motion: Motion, now: StepContext
) -> Response:
    """Forces -D pi^T S_i with gradients S_i of the steps of the invariants, D pi where forces take hold."""
    x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
    given = gradient(steps_together(potential, x, now.h * rates))
    held = x if motion.force_rows is None else place_markers(place, motion.force_rows)
    forces = -jax.vmap(potential.pulled_back)(held, given)
    viscosity = potential.viscosity
    if viscosity is None:
        return marker_response(place, forces, None, rates, motion)
    flow = steps_together(potential, x, rates)
    stored = jnp.sum(forces * rates, axis=tuple(range(1, forces.ndim)))
    forces = forces - jax.vmap(potential.pulled_back)(held, flow @ viscosity)
    return replace_fields(marker_response(place, forces, None, rates, motion), released=stored)


def marker_response(
    place: Float[Array, "k *m w"],
    forces: Float[Array, "s k *m 3"] | None,
    torques: Float[Array, "s k 3"] | None,
    rates: Float[Array, "s k *m 3"],
    motion: Motion,
) -> Response:
    """Response of forces [N] on markers and torques [N m] on their bodies."""
    stages = rates.shape[0]
    power, found = jnp.zeros(stages, rates.dtype), None
    if forces is not None:
        power = power + jnp.sum(forces * rates, axis=tuple(range(1, forces.ndim)))
        found = on_rows(place, forces)
    if torques is not None:
        if motion.spin.shape[-2] > place.shape[0]:
            raise ValueError(
                "a torque [N m] acts on a body, and what lies between nodes is none; pass markers of bodies, "
                "or forces on points between nodes"
            )
        power = power + jnp.sum(torques * motion.spin, axis=(-1, -2))
    return Response(found, torques, jnp.zeros((stages, 0)), power)


def on_rows(place: Float[Array, "k *m w"], forces: Float[Array, "s k *m 3"]) -> Float[Array, "s b 4 3"]:
    """Forces on the rows of the bodies of markers."""
    found = place[..., None] * forces[..., None, :]
    if place.ndim == 3:
        found = jnp.sum(found, axis=-3)
    return found.reshape(forces.shape[0], -1, *NODE)


def responses_together(potential: Potential, place: Array, motion: Motion, now: StepContext) -> Response:
    """Responses of many instances, whose axis is the last in all that is computed."""
    potential, place, start = instances_last((potential, place, motion.start))
    x = place_together(place, instances_last(motion.rows, 1))
    rates = place_together(place, instances_last(motion.rates, 1))
    steps = steps_together(potential, x, now.h * rates)
    begun, steps = materialised((potential.invariants(place_together(place, start)), steps))
    given = materialised(potential.averaged(begun, steps, now.tableau))
    forces = -jax.vmap(potential.pulled_back)(x, given)
    power = jnp.sum(forces * rates, axis=tuple(range(1, forces.ndim - 1)))
    viscosity, released = potential.viscosity, None
    if viscosity is not None:
        released = power.T
        flow = steps_together(potential, x, rates)
        viscous = -jax.vmap(potential.pulled_back)(x, jnp.sum(viscosity * flow[:, None], axis=2))
        power = power + jnp.sum(viscous * rates, axis=tuple(range(1, forces.ndim - 1)))
        forces = forces + viscous
    on_rows = place[..., None, :] * forces[..., None, :, :]
    if place.ndim == 4:
        on_rows = jnp.sum(on_rows, axis=-4)
    on_rows = on_rows.reshape(on_rows.shape[0], -1, 4, *on_rows.shape[-2:])
    nothing = jnp.zeros((power.shape[1], now.tableau.stages, 0), power.dtype)
    return Response(jnp.moveaxis(on_rows, -1, 0), None, nothing, power.T, released)
