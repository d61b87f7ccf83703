"""Friction where two surfaces touch: a force against slip, whatever pushes them together."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import on_rows, place_markers
from natcoord_jax.effects.contact.gap import Gap, GapEffect
from natcoord_jax.maths.vectors import cross, dot, positive_part

REGULARISED = 3e-6
"""Velocity of slip, in terms of the speeds of a scene, up to which friction is smooth: what sticks under a
load creeps less than that."""


class Rubbing(GapEffect):
    """Base of contacts whose multipliers are an impulse along the normal and those of friction.

    A force of slip acts where the surfaces touch, f sqrt(|u|^2 + eps^2) = -mu N u of the velocity u with
    which the second slips on the first: at most mu N, and against it. At the end of a step slip that friction
    can stop is stopped (`natcoord_jax.mechanics.impacts`).

    Attributes:
        markers: that the gap is of.
        gap: between the surfaces.
        friction: coefficient mu [-]; None: there is none.
        regularisation: eps [m/s]; None: see `nc.GapConstraint`.
        name: optional name.
        mobility: change of the speed of closing by a unit impulse [1/kg], follows from the masses.
        phase: in the part of a step at hand of schemes that locate impacts, `FREE` where nothing pushes until
            the gap closes, at its end, `RESTING` where it is closed, 0 elsewhere. None: of other schemes.
    """

    friction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    regularisation: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    mobility: Any = eqx.field(default=None, init=False)
    phase: Any = eqx.field(default=None, init=False)

    unilateral: ClassVar[bool] = True
    impulsive: ClassVar[bool] = True
    works: ClassVar[bool] = True
    silent: ClassVar[bool] = False
    drawn: ClassVar[bool] = False

    def __check_init__(self) -> None:
        """Refuse friction at no one knows which point."""
        if self.friction is not None and type(self.gap).contact is Gap.contact:
            raise ValueError(
                f"{type(self).__name__}: friction [-] acts where surfaces touch, which "
                f"{type(self.gap).__name__} does not say; give it a method `contact`"
            )

    def assembled_at(self, x: Array) -> Any:
        """With a mobility, which is found when the masses are known."""
        return replace_fields(super().assembled_at(x), mobility=jnp.ones(()))

    @property
    def multipliers(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Impulse along the normal, and with friction that of slip by its components."""
        return 1 if self.friction is None else 4

    @property
    def bends(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Friction does, where slip changes its sign."""
        return self.friction is not None

    @property
    def slips(self) -> Any:
        """Its regularisation, with friction."""
        return None if self.friction is None else ("regularisation", REGULARISED)

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """Metres."""
        return ("m",)

    def pushes(self, place: Array, rows: Array) -> Float[Array, "1 k 4 3"]:
        """Forces on the rows of the bodies per unit impulse along the gradient of the gap."""
        return on_rows(place, self.gap.gradient(place_markers(place, rows))[None])

    def rubs(self, place: Array, rows: Array) -> Float[Array, "3 k 4 3"]:
        """The same of impulses against slip, by components."""
        if self.friction is None:
            return jnp.zeros((3, *rows.shape), rows.dtype)
        x = place_markers(place, rows)
        still = jnp.zeros_like(x), jnp.zeros((rows.shape[0], 3), x.dtype)
        forces, torques = jax.jacrev(lambda v, w: self.slip(x, v, w), argnums=(0, 1))(*still)
        # On orthonormal directors.
        turning = 0.5 * cross(torques[:, :, None], rows[:, 1:])
        return on_rows(place, forces) + jnp.pad(turning, ((0, 0), (0, 0), (1, 0), (0, 0)))

    def flow(self, place: Array, motion: Motion) -> Float[Array, "s p"]:
        """Rates of the invariants at the stages of a step."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        return jax.vmap(lambda xi, vi: jax.jvp(self.gap.invariants, (xi,), (vi,))[1])(x, rates)

    def pushing(
        self, place: Array, motion: Motion, gradient: Float[Array, "s p"], pushed: Float[Array, " s"]
    ) -> Float[Array, "s k 3"]:
        """Impulses on the markers, along the gradient of the gap by its invariants."""
        x = place_markers(place, motion.rows)
        return jax.vmap(lambda xi, g, m: m * jax.vjp(self.gap.invariants, xi)[1](g)[0])(x, gradient, pushed)

    def rubbing(
        self, place: Array, motion: Motion, lam: Float[Array, "s 4"]
    ) -> tuple[Float[Array, "1 k 3"], Float[Array, "1 k 3"], Float[Array, "1 3"]]:
        """Impulses of friction on markers, of torques on their bodies, and what is missing of its law."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        # What is along the normal by rounding, or while a step is being solved, is no friction.
        along = lam[0, 1:]
        slip, pulled = jax.vjp(lambda v, w: self.slip(x[0], v, w), rates[0], motion.spin[0])
        forces, torques = (y[None] for y in pulled(along))
        missing = missing_friction(along, slip, self.friction * lam[0, 0], self.regularisation)
        return forces, torques, self.mobility * missing[None]

    def slip(
        self, x: Float[Array, "k 3"], rates: Float[Array, "k 3"], spin: Float[Array, "k 3"]
    ) -> Float[Array, "3"]:
        """Velocity with which the second surface slips on the first [m/s]."""
        point, normal = self.gap.contact(x)
        first, second = (rates[k] + cross(spin[k], point - x[k]) for k in self.gap.sides)
        relative = second - first
        return relative - dot(normal, relative) * normal


def missing_friction(
    along: Float[Array, "3"],
    slip: Float[Array, "3"],
    most: Float[Array, ""],
    regularisation: Float[Array, ""],
) -> Float[Array, "3"]:
    """What is missing of the law of friction f sqrt(|u|^2 + eps^2) = -mu N u: zero where it is obeyed.

    Args:
        along: impulse against slip, f.
        slip: velocity u.
        most: mu times the impulse along the normal; negative counts as none.
        regularisation: eps.
    """
    most = positive_part(most)
    speed = jnp.sqrt(dot(slip, slip) + regularisation**2)
    # Where the speed changes, an impulse beyond the cone counts as one on it: then Newton's iteration
    # finds its way from anywhere. At the solution none is beyond.
    square = dot(along, along)
    beyond = square > most**2
    # (What decays in open contacts has squares in the end that derivatives cannot be divided by.)
    within = jnp.where(beyond, most / jnp.sqrt(jnp.where(beyond & (most > 0), square, 1.0)), 1.0) * along
    fixed = jax.lax.stop_gradient(speed)
    return along * fixed + within * (speed - fixed) + most * slip
