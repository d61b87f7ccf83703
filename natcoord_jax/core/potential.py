"""Potentials: an energy of invariants of markers."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.effect import Effect, Motion, Now, Response
from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.markers import Marker


def place_markers(place: Float[Array, "k 4"], rows: Float[Array, "*s k 4 3"]) -> Float[Array, "*s k 3"]:
    """Marker vectors x_k = sum_a w_ka q_a, one marker to a body slot."""
    return jnp.sum(place[..., None] * rows, axis=-2)


class Potential(Effect):
    """Base of elastic effects between markers: subclass it and give `invariants` and `energy`.

    The invariants must be at most quadratic in the marker vectors, and unchanged when all of them are
    rotated (and, for points, moved) together: then energy, momentum and angular momentum are kept exactly.

    Attributes:
        markers: points and directions the energy depends on, in the order `invariants` receives them.
        name: optional name.

    Class attributes:
        degree: polynomial degree of `energy` in the invariants, if it is a polynomial; saves work.

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

    def attach(self, find: Callable[[Handle], tuple[Joint, Array]]) -> tuple[Marker, ...]:
        """Markers of the effect; effects on a joint look it up with `find`: handle to (joint, triad)."""
        return self.markers

    @abc.abstractmethod
    def invariants(self, x: Float[Array, "k 3"]) -> Float[Array, " p"]:
        """Invariants of the marker vectors, at most quadratic."""

    @abc.abstractmethod
    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Energy [J]."""

    def respond(self, place: Array, motion: Motion, now: Now, lam: Array) -> Response:
        """Forces -D pi^T S_i with the averaged gradients S_i, D pi where forces take hold."""
        start = self.invariants(place_markers(place, motion.start))
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        steps = jax.vmap(lambda xi, vi: jax.jvp(self.invariants, (xi,), (vi,))[1])(x, now.h * rates)
        gradient = averaged_gradient(self.energy, start, steps, now.tableau, self.degree)
        if now.stress is not None:
            gradient = gradient + now.stress
        held = x if motion.levers is None else place_markers(place, motion.levers)
        forces = jax.vmap(lambda xi, gi: jax.vjp(self.invariants, xi)[1](-gi)[0])(held, gradient)
        return marker_response(place, forces, None, rates, motion)

    def strain_rates(self, place: Array, motion: Motion, h: Array) -> Array:
        """Rates of the invariants at the stages: h times them are the increments."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        return jax.vmap(lambda xi, vi: jax.jvp(self.invariants, (xi,), (vi,))[1])(x, rates)

    def curvature(self, place: Array, rows: Array, coordinates: Array) -> Array:
        """Second derivatives of the energy [J per squared unit of invariant]."""
        return jax.hessian(self.energy)(self.invariants(place_markers(place, rows)))

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Array:
        """Energy [J]."""
        return self.energy(self.invariants(place_markers(place, rows)))


def marker_response(
    place: Float[Array, "k 4"],
    forces: Float[Array, "s k 3"] | None,
    torques: Float[Array, "s k 3"] | None,
    rates: Float[Array, "s k 3"],
    motion: Motion,
) -> Response:
    """Response of forces [N] on markers and torques [N m] on their bodies."""
    stages = rates.shape[0]
    power, on_rows = jnp.zeros(stages, rates.dtype), None
    if forces is not None:
        power = power + jnp.sum(forces * rates, axis=(-1, -2))
        on_rows = place[:, :, None] * forces[:, :, None, :]
    if torques is not None:
        power = power + jnp.sum(torques * motion.spin, axis=(-1, -2))
    return Response(on_rows, torques, jnp.zeros((stages, 0)), power)
