"""Potentials: an energy of invariants of markers."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.effect import Effect, Motion, Now, Response
from natcoord_jax.core.gradient import averaged_coupling, averaged_gradient
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.markers import Attachment, Marker


def place_markers(place: Float[Array, "k *m 4"], rows: Float[Array, "*s k 4 3"]) -> Float[Array, "*out"]:
    """Marker vectors x_k = sum_a w_ka q_a, one marker to a body slot; of attachments, four vectors each."""
    if place.ndim == 3:
        rows = rows[..., None, :, :]
    return jnp.sum(place[..., None] * rows, axis=-2)


class Potential(Effect):
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

    markers: Any
    name: Any = None

    kind: ClassVar[str] = "potential"
    stores: ClassVar[bool] = True
    elastic: ClassVar[bool] = True
    degree: ClassVar[int | None] = None
    points: ClassVar[int | None] = None

    def attach(self, find: Callable[[Handle], tuple[Joint, Array]]) -> tuple[Marker | Attachment, ...]:
        """Markers of the effect; effects on a joint look it up with `find`: handle to (joint, triad)."""
        return self.markers

    @abc.abstractmethod
    def invariants(self, x: Float[Array, "k *m 3"]) -> Float[Array, " p"]:
        """Invariants of the marker vectors, at most quadratic."""

    @abc.abstractmethod
    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""

    def energy_curvature(self, invariants: Float[Array, " p"]) -> Float[Array, "p p"]:
        """Second derivatives of the energy by the invariants; for Newton's Jacobian."""
        return jax.hessian(self.energy)(invariants)

    def respond(self, place: Array, motion: Motion, now: Now, lam: Array) -> Response:
        """Forces -D pi^T S_i with the averaged gradients S_i, D pi where forces take hold."""
        start = self.invariants(place_markers(place, motion.start))

        def gradient(steps: Float[Array, "s p"]) -> Float[Array, "s p"]:
            found = averaged_gradient(self.energy, start, steps, now.tableau, self.degree, self.points)
            return found if now.stress is None else found + now.stress

        return _response(self, gradient, place, motion, now)

    def linearised(self, place: Array, motion: Motion, now: Now, lam: Array) -> "LinearisedPotential":
        """The potential with gradients that are linear in the steps of the invariants."""
        start = self.invariants(place_markers(place, motion.start))
        steps = _steps(self, place, motion, now)
        gradient = averaged_gradient(self.energy, start, steps, now.tableau, self.degree, self.points)
        middle = start + 0.5 * jnp.asarray(now.tableau.b) @ steps
        if now.stress is not None:
            gradient = gradient + now.stress
        return LinearisedPotential(self, steps, gradient, self.energy_curvature(middle))

    def strain_rates(self, place: Array, motion: Motion, h: Array) -> Array:
        """Rates of the invariants at the stages: h times them are the increments."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        return jax.vmap(lambda xi, vi: jax.jvp(self.invariants, (xi,), (vi,))[1])(x, rates)

    def curvature(self, place: Array, rows: Array, coordinates: Array) -> Array:
        """Second derivatives of the energy [J per squared unit of invariant]."""
        return self.energy_curvature(self.invariants(place_markers(place, rows)))

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

    def respond(self, place: Array, motion: Motion, now: Now, lam: Array) -> Response:
        """The response with linear gradients."""
        coupling = averaged_coupling(now.tableau.stages)

        def gradient(steps: Float[Array, "s p"]) -> Float[Array, "s p"]:
            moved = coupling @ (steps - self.steps)
            return self.gradient + jnp.sum(self.curvature * moved[:, None], axis=-1)

        return _response(self.potential, gradient, place, motion, now)


def _steps(potential: Potential, place: Array, motion: Motion, now: Now) -> Float[Array, "s p"]:
    """Step times the rates of the invariants at the stages."""
    x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
    return jax.vmap(lambda xi, vi: jax.jvp(potential.invariants, (xi,), (vi,))[1])(x, now.h * rates)


def _response(
    potential: Potential, gradient: Callable[[Array], Array], place: Array, motion: Motion, now: Now
) -> Response:
    """Forces -D pi^T S_i with gradients S_i of the steps of the invariants, D pi where forces take hold."""
    x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
    given = gradient(_steps(potential, place, motion, now))
    held = x if motion.levers is None else place_markers(place, motion.levers)
    forces = jax.vmap(lambda xi, gi: jax.vjp(potential.invariants, xi)[1](-gi)[0])(held, given)
    return marker_response(place, forces, None, rates, motion)


def marker_response(
    place: Float[Array, "k *m 4"],
    forces: Float[Array, "s k *m 3"] | None,
    torques: Float[Array, "s k 3"] | None,
    rates: Float[Array, "s k *m 3"],
    motion: Motion,
) -> Response:
    """Response of forces [N] on markers and torques [N m] on their bodies."""
    stages = rates.shape[0]
    power, on_rows = jnp.zeros(stages, rates.dtype), None
    if forces is not None:
        power = power + jnp.sum(forces * rates, axis=tuple(range(1, forces.ndim)))
        on_rows = place[..., None] * forces[..., None, :]
        if place.ndim == 3:
            on_rows = jnp.sum(on_rows, axis=-3)
    if torques is not None:
        power = power + jnp.sum(torques * motion.spin, axis=(-1, -2))
    return Response(on_rows, torques, jnp.zeros((stages, 0)), power)
