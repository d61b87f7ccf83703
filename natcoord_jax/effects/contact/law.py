"""What is the same of all contacts: the law of an overlap, what impacts lose, what a sensor shows."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import Choice
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.potential import MarkerEffect
from natcoord_jax.maths.implicit import implicit_root
from natcoord_jax.maths.vectors import positive_part, safe_sqrt

HERTZ = "hertz"
LAW = Choice(("linear", HERTZ))
NO_GIFT = ": an impact gives nothing"
RESTITUTION = Number("positive", most=1.0, instead=NO_GIFT)

NEAR = 0.1
"""Argument up to which a logarithm's remainder is a series: beyond, three digits of sixteen cancel."""
TERMS = 18
"""Of that series: the next is below 1e-19."""


def damping_of(restitution: Any, speed: Any) -> Array:
    """Part of the force per closing speed [s/m] with which an impact of this speed keeps this part of it.

    A force Q (1 + a v) of a closing speed v, whatever Q is as a function of the gap, lets a mass rebound with
    the part e of its speed v_0 for the root d = a v_0 of (1 + d) / (1 - e d) = exp(d (1 + e)).

    Args:
        restitution: e, above 0 up to 1 [-].
        speed: v_0 of the impact [m/s].
    """
    return _damping(as_array(restitution, float), as_array(speed, float))


@eager_numpy
def _damping(restitution: Array, speed: Array) -> Array:
    restitution, speed = jnp.broadcast_arrays(restitution, speed)
    found = jax.vmap(partial(implicit_root, _missing, _bisected))(restitution.reshape(-1))
    return -jnp.expm1(-found).reshape(restitution.shape) / (restitution * speed)


def _missing(w: Float[Array, ""], restitution: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the equation over d^2, as a function of w = -log(1 - e d).

    Without the root d = 0 and with its digits at both ends: d is 3 (1 - e) / 2 towards e = 1, and 1 - e d no
    number towards e = 0.
    """
    u = -jnp.expm1(-w)
    d, square = u / restitution, restitution**2
    near = w < NEAR
    far = jnp.where(near, 1.0, u)
    rest = jnp.where(near, _remainder(jnp.where(near, -u, 0.0)), (w - far - 0.5 * far**2) / far**3)
    return d * _remainder(d) + square * u * rest - 0.5 * (1.0 - restitution) * (1.0 + restitution)


def _remainder(x: Array) -> Array:
    """(log(1 + x) - x + x^2 / 2) / x^3 of x > -1, smooth at zero."""
    near = jnp.abs(x) < NEAR
    small, far = jnp.where(near, x, 0.0), jnp.where(near, 1.0, x)
    series = jnp.polyval(jnp.asarray([(-1.0) ** k / (k + 3) for k in range(TERMS)][::-1]), small)
    return jnp.where(near, series, (jnp.log1p(far) - far + 0.5 * far**2) / far**3)


def _bisected(restitution: Float[Array, ""]) -> Float[Array, ""]:
    """The root, which is below 1 / e + 1: negative before it, positive beyond; 60 halvings are all digits."""

    def halved(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        middle = 0.5 * (low + high)
        beyond = _missing(middle, restitution) > 0
        return (jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)), None

    ends = jnp.zeros_like(restitution), 1.0 / restitution + 1.0
    return jax.lax.scan(halved, ends, None, length=60)[0][0]


def closing_speed(distance: Callable[[Array], Array], start: Array, flow: Array, h: Array) -> Array:
    """Mean rate at which a gap closes in a step [m/s], by its invariants and their mean rates.

    At one instant the rate.
    """
    moving = h > 0
    mean = (distance(start) - distance(start + h * flow)) / jnp.where(moving, h, 1.0)
    return jnp.where(moving, mean, -jax.jvp(distance, (start,), (flow,))[1])


class ContactReadings(eqx.Module):
    """What goes on in a contact.

    Attributes:
        gap: between the surfaces; negative where they overlap [m].
        force: that pushes them apart, without what is lost [N].
        energy: stored [J].
    """

    gap: Float[Array, "*t"]
    force: Float[Array, "*t"]
    energy: Float[Array, "*t"]


class ContactLaw(MarkerEffect):
    """Base of contacts: how much a force an overlap has, and how much of an impact is left.

    With a restitution, what impacts lose is the work in its account, which is never positive.

    Attributes:
        stiffness: k [N/m] of the linear law, force k d of an overlap d; of Hertz' law [N/m^1.5], k d^1.5.
        law: "linear" or "hertz".
        restitution: part of the closing speed that is left after an impact [-], above 0 up to 1; None: all.
        speed: of the impact that `restitution` is of [m/s].
        damping: part of the force per closing speed [s/m], follows from the two.

    Raises:
        ValueError: for a restitution above one, or one without the speed that it is of.
    """

    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    law: str = eqx.field(default="linear", kw_only=True, static=True, metadata=is_a(LAW))
    restitution: Any = eqx.field(default=None, kw_only=True, metadata=is_a(RESTITUTION))
    speed: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    damping: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "soft contact"
    derived: ClassVar[tuple[str, ...]] = ("damping",)
    stores: ClassVar[bool] = True
    drawn: ClassVar[bool] = False
    silent: ClassVar[bool] = False

    def __check_init__(self) -> None:
        """Refuse a restitution of no speed."""
        if (self.restitution is None) != (self.speed is None):
            raise ValueError(
                f"{type(self).__name__}: restitution [-] is that of one speed, since slower impacts lose "
                "less; pass `restitution` and `speed` [m/s], or neither"
            )

    @property
    def works(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether anything is lost, which its account then has."""
        return self.restitution is not None

    def assembled_at(self, x: Array) -> "ContactLaw":
        """With its damping."""
        return self.renewed()

    def renewed(self) -> "ContactLaw":
        """With the damping for its restitution."""
        if self.restitution is None:
            return self
        return replace_fields(self, damping=damping_of(self.restitution, self.speed))

    def stored_at(self, gap: Float[Array, ""]) -> Float[Array, ""]:
        """Energy of a gap [J]."""
        overlap = positive_part(-gap)
        if self.law == HERTZ:
            return 0.4 * self.stiffness * overlap**2 * safe_sqrt(overlap)
        return 0.5 * self.stiffness * overlap**2

    def lossy(self, closing: Array) -> Any:
        """Factor of the force at a rate of closing [m/s], by which impacts lose; together they never pull."""
        return 1.0 if self.damping is None else 1.0 + jnp.maximum(self.damping * closing, -1.0)

    def mean_force(self, before: Float[Array, ""], after: Float[Array, ""]) -> Float[Array, ""]:
        """What the energy of the overlap grows by from one gap to another, per what the gap falls by [N].

        Without a difference of energies, whose digits cancel where the gap hardly changes.
        """
        both = (before < 0) & (after < 0)
        change = jnp.where(before == after, 1.0, before - after)
        one, two = positive_part(-before), positive_part(-after)
        share = jnp.where(both, 1.0, (two - one) / change)
        if self.law != HERTZ:
            return 0.5 * self.stiffness * (one + two) * share
        # (a^5 - b^5) / (a^2 - b^2) of the roots.
        a, b = safe_sqrt(one), safe_sqrt(two)
        powers = one**2 + one * a * b + one * two + a * b * two + two**2
        some = a + b > 0
        return 0.4 * self.stiffness * share * jnp.where(some, powers / jnp.where(some, a + b, 1.0), 0.0)

    def gap_at(self, place: Array, rows: Array) -> Float[Array, ""]:
        """Between the surfaces, of contacts with one gap [m]."""
        raise NotImplementedError

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Float[Array, ""]:
        """Energy [J]."""
        return self.stored_at(self.gap_at(place, rows))

    def readings(self, place: Array, rows: Array) -> ContactReadings:
        """Gap and force."""
        gap = self.gap_at(place, rows)
        overlap = positive_part(-gap)
        force = self.stiffness * overlap * (safe_sqrt(overlap) if self.law == HERTZ else 1.0)
        return ContactReadings(gap, force, self.stored_at(gap))
