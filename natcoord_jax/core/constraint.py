"""Constraints on markers: equations between points and directions, or between their velocities."""

import abc
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import equations
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.potential import MarkerEffect, marker_response, place_markers

FREE, RESTING = 1, 2
"""What inequalities do in a part of a step, where impacts are located."""


class Constraint(MarkerEffect):
    """Base of constraints on markers of any number of bodies: subclass it and give `residual`.

    A residual that is at most quadratic in the marker vectors is kept exactly by every scheme, and with one
    that is unchanged when all of them are rotated (and, for points, moved) together, momentum and angular
    momentum are, too. The multipliers times the derivative of the residual are the forces on the markers:
    `system.instant(...).multipliers` has them by name.

    Attributes:
        markers: points and directions, or attachments, in the order `residual` receives them: a point or a
            direction as (3,), an attachment as (4, 3).
        name: optional name.

    Class attributes:
        multipliers: number of equations.

    Example:
        A bead on a circle about a point of another body, in the plane normal to a direction of that body:

        >>> import natcoord_jax as nc
        >>> import jax.numpy as jnp
        >>> class PointOnCircle(nc.Constraint):
        ...     multipliers = 2
        ...     radius: float = 1.0
        ...     def residual(self, x):
        ...         centre, normal, bead = x
        ...         arm = bead - centre
        ...         return jnp.stack([normal @ arm, 0.5 * (arm @ arm - self.radius**2)])
    """

    kind: ClassVar[str] = "constraint"
    impulsive: ClassVar[bool] = True

    @abc.abstractmethod
    def residual(self, x: Float[Array, "k *m 3"]) -> Float[Array, " m"]:
        """What vanishes, at most quadratic in the marker vectors."""

    def quadratic(self, place: Array, rows: Array) -> Array:
        """The residual."""
        return equations(self.residual(place_markers(place, rows)), self, "residual")

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """The residual."""
        return self.quadratic(place, rows)

    def violation_rate(
        self, place: Array, rows: Array, rates: Array, spin: Array, t: Array, passing: Any
    ) -> Array:
        """That of the residual."""
        rate = jax.jvp(self.residual, (place_markers(place, rows),), (place_markers(place, rates),))[1]
        return equations(rate, self, "residual")

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """Metres where the residual depends on where points are."""
        at = place_markers(place, rows)
        change = np.asarray(jax.jacfwd(self.residual)(at))
        points = np.any(np.asarray(place)[..., ::4] != 0, axis=-1, keepdims=True)
        return tuple("m" if np.any(x * points) else "-" for x in change)

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Rates G(Q_i) V_i, of quadratic residuals the discrete derivative (57); forces G^T lambda_i."""

        def stage(x: Array, rates: Array, held: Array, multipliers: Array) -> tuple[Array, Array]:
            rate = jax.jvp(self.residual, (x,), (rates,))[1]
            return equations(rate, self, "residual"), jax.vjp(self.residual, held)[1](multipliers)[0]

        x, rates, held = (place_markers(place, q) for q in (motion.rows, motion.rates, motion.held.rows))
        found, forces = jax.vmap(stage)(x, rates, held, lam)
        return replace_fields(marker_response(place, forces, None, rates, motion), rows=found)


class VelocityConstraint(MarkerEffect):
    """Base of constraints on velocities that no positions follow from: subclass it and give `rate`.

    Rolling without slip, a blade on ice: the forces do no work, and energy is kept exactly.

    Attributes:
        markers: points and directions, in the order `rate` receives them.
        name: optional name.

    Class attributes:
        multipliers: number of equations.

    Example:
        A blade: its point moves along a direction of its body only.

        >>> import natcoord_jax as nc
        >>> import jax.numpy as jnp
        >>> class Blade(nc.VelocityConstraint):
        ...     multipliers = 1
        ...     def rate(self, x, velocity, spin):
        ...         point, across = x
        ...         return (across @ velocity[0])[None]
    """

    kind: ClassVar[str] = "velocity constraint"
    impulsive: ClassVar[bool] = True

    @abc.abstractmethod
    def rate(
        self, x: Float[Array, "k *m 3"], velocity: Float[Array, "k *m 3"], spin: Float[Array, "k 3"]
    ) -> Float[Array, " m"]:
        """What vanishes, linear in the velocities.

        Args:
            x: marker vectors.
            velocity: of the markers [m/s, 1/s].
            spin: angular velocities of their bodies [rad/s].
        """

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """None: positions are free."""
        return jnp.zeros(self.multipliers)

    def violation_rate(
        self, place: Array, rows: Array, rates: Array, spin: Array, t: Array, passing: Any
    ) -> Array:
        """What the velocities leave."""
        rate = self.rate(place_markers(place, rows), place_markers(place, rates), spin)
        return equations(rate, self, "rate")

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """Metres, as of points."""
        return ("m",) * self.multipliers

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The rates, and the forces and torques that do no work along motions without them."""

        def stage(x, rates, spin, held, multipliers):
            given = equations(self.rate(x, rates, spin), self, "rate")
            return given, *jax.vjp(lambda v, w: self.rate(held, v, w), rates, spin)[1](multipliers)

        x, rates, held = (place_markers(place, q) for q in (motion.rows, motion.rates, motion.held.rows))
        found, forces, torques = jax.vmap(stage)(x, rates, motion.spin, held, lam)
        return replace_fields(marker_response(place, forces, torques, rates, motion), rows=found)
