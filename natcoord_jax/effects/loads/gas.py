"""Gas enclosed by a surface: its energy is a function of the volume that is enclosed.

The volume is cubic in the places of the nodes, so that neither its gradient in the middle of a step nor the
mean along the step will do: the one misses the change of the volume by a cubic term, the other turns the
surface. What is added here to the first keeps energy, momentum and angular momentum.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.closed_tangents import by_twists, twist_maps
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.motion import Motion, Response, SpreadTangents, StepContext
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.potential import MarkerEffect, marker_response, place_markers
from natcoord_jax.effects.loads.pressure import ETA, XI, follower_loads
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.vectors import cross

ATMOSPHERE = 101325.0
"""Pressure of the air [N/m^2]."""

SMALL = 0.05
"""Size of an argument below which quotients of differences are series."""

TERMS = 11
"""Of these series: what they leave out is below rounding."""


def enclosed_volume(x: Float[Array, "k 3"], faces: Int[Array, "f 4"]) -> Float[Array, ""]:
    """Volume within a closed surface of bilinear faces, counter-clockwise from outside [m^3]; exact."""
    corners = (x - jnp.mean(x, axis=0))[faces]
    a, b = (0.25 * jnp.einsum("a,fax->fx", jnp.asarray(signs), corners) for signs in (XI, ETA))
    return 4.0 / 3.0 * jnp.sum(jnp.mean(corners, axis=1) * cross(a, b))


def volume_gradient(x: Float[Array, "k 3"], faces: Int[Array, "f 4"]) -> Float[Array, "k 3"]:
    """Its gradient [m^2], homogeneous of degree two in `x`."""
    return jnp.zeros_like(x).at[faces].add(jax.vmap(follower_loads)(x[faces]))


def discrete_volume_gradient(
    middle: Float[Array, "k 3"], moved: Float[Array, "k 3"], faces: Int[Array, "f 4"]
) -> Float[Array, "k 3"]:
    """Vectors D [m^2] that neither push nor turn the surface in the middle of a step, D . moved = V_1 - V_0.

    With g the gradient, V_1 - V_0 = g(middle) . moved + V(moved) / 4. The increments are split into twice a
    rotation b and a rest e without angular momentum; mixed differences of V along them give vectors whose
    work is the cubic term, and what they turn is taken from them by a rotation, which does no work along e.
    """
    r = middle - jnp.mean(middle, axis=0)
    inertia = jnp.sum(r * r) * jnp.eye(3) - r.T @ r
    inverse = definite_inverse(inertia)
    turn = 0.5 * inverse @ jnp.sum(cross(r, moved), axis=0)
    turned = cross(turn, r)
    rest = moved - 2.0 * turned
    of_turn, of_both, of_rest = (volume_gradient(x, faces) for x in (turned, turned + rest, rest))
    cubic = 0.75 * of_turn + 0.25 * of_both - of_rest / 6.0
    excess = inverse @ jnp.sum(cross(r, cubic), axis=0)
    return volume_gradient(middle, faces) + cubic - cross(excess, r)


def _quotient(x: Array, whole: Any, series: list[float]) -> Array:
    """A function with a removable singularity at zero."""
    near = jnp.abs(x) < SMALL
    inner = jnp.polyval(jnp.asarray(series[::-1]), jnp.where(near, x, 0.0))
    return jnp.where(near, inner, whole(jnp.where(near, 1.0, x)))


def _growth(x: Array) -> Array:
    """(e^x - 1) / x."""
    factorials = np.cumprod(np.arange(1.0, TERMS + 1))
    return _quotient(x, lambda x: jnp.expm1(x) / x, (1.0 / factorials).tolist())


def _logarithm(x: Array) -> Array:
    """ln(1 + x) / x."""
    series = [(-1.0) ** k / (k + 1) for k in range(TERMS)]
    return _quotient(x, lambda x: jnp.log1p(x) / x, series)


class GasReadings(eqx.Module):
    """How a gas is.

    Attributes:
        volume: [m^3].
        pressure: above that around it [N/m^2].
    """

    volume: Float[Array, "*t"]
    pressure: Float[Array, "*t"]


class EnclosedGas(MarkerEffect):
    """A gas in a closed surface of quadrilaterals between points, within another of constant pressure.

    With the volume V it has the pressure p_0 (V_0 / V)^n. Energy, momentum and angular momentum are kept to
    rounding by schemes of order two. Usually made by `nc.Gas`.

    Attributes:
        markers: the points.
        faces: numbers of the points round each face (f, 4), counter-clockwise as seen from outside; of a
            triangle the last one twice.
        gauge_pressure: above the ambient one, at the volume `volume` [N/m^2].
        ambient: pressure around the surface [N/m^2].
        exponent: n [-]: one for a gas that stays as warm as it is, 1.4 for air that has no time to, zero for
            a constant pressure.
        volume: V_0 [m^3]; None: that of the assembled pose.

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> corners = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        >>> points = tuple(nc.Point(nc.ground, np.array(x)) for x in corners)
        >>> faces = np.array(nc.mesh.HEXAHEDRON)
        >>> air = nc.EnclosedGas(points, faces=faces, gauge_pressure=1e3)
    """

    faces: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, 4))))
    gauge_pressure: Any = eqx.field(kw_only=True, metadata=is_a(Number()))
    ambient: Any = eqx.field(default=ATMOSPHERE, kw_only=True, metadata=is_a(Number("not negative")))
    exponent: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number("not negative")))
    volume: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    kind: ClassVar[str] = "gas"
    stores: ClassVar[bool] = True
    spread: ClassVar[bool] = True
    silent: ClassVar[bool] = False
    drawn: ClassVar[bool] = False

    def assembled_at(self, x: Float[Array, "k 3"]) -> "EnclosedGas":
        """With the volume of the assembled pose, unless another is given."""
        faces = jnp.asarray(self.faces, jnp.int32)
        volume = enclosed_volume(x, faces) if self.volume is None else self.volume
        return replace_fields(self, faces=faces, volume=volume)

    def flaws(self) -> dict[str, Array]:
        """Volumes and pressures that no gas has."""
        flaws = {"has no pressure: gauge_pressure [N/m^2] is below minus the ambient one": self._first <= 0.0}
        said = "encloses no volume: list the points of each face counter-clockwise as seen from outside"
        return flaws if self.volume is None else flaws | {said: self.volume <= 0.0}

    @property
    def _first(self) -> Array:
        """p_0 [N/m^2]."""
        return self.gauge_pressure + self.ambient

    def pressure_at(self, volume: Float[Array, ""]) -> Float[Array, ""]:
        """Above the ambient one [N/m^2]."""
        return self._first * jnp.exp(-self.exponent * jnp.log(volume / self.volume)) - self.ambient

    def mean_pressure(self, volume: Float[Array, ""], change: Float[Array, ""]) -> Float[Array, ""]:
        """Work per change of volume along it [N/m^2], whatever its size."""
        relative = change / volume
        shape = _logarithm(relative)
        grown = _growth((1.0 - self.exponent) * relative * shape)
        return (self.pressure_at(volume) + self.ambient) * shape * grown - self.ambient

    def readings(self, place: Array, rows: Array) -> GasReadings:
        """Volume and pressure."""
        volume = enclosed_volume(place_markers(place, rows), self.faces)
        return GasReadings(volume, self.pressure_at(volume))

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Float[Array, ""]:
        """Energy [J], with that of the ambient; zero at V_0."""
        change = enclosed_volume(place_markers(place, rows), self.faces) - self.volume
        return -self.mean_pressure(self.volume, change) * change

    def _check(self, now: StepContext) -> None:
        if now.tableau.stages > 1 or now.tableau.variational:
            raise ValueError(
                "gas in a surface: its forces are exact for the energy-momentum method of order two only; "
                "pass scheme=nc.EnergyMomentum() or nc.Dissipative()"
            )

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Mean pressure times the discrete gradient of the volume."""
        self._check(now)
        rates = place_markers(place, motion.rates)
        start, middle = (place_markers(place, x) for x in (motion.start, motion.rows[0]))
        moved = now.h * rates[0]
        gradient = discrete_volume_gradient(middle, moved, self.faces)
        change = jnp.sum(gradient * moved)
        forces = self.mean_pressure(enclosed_volume(start, self.faces), change) * gradient
        return marker_response(place, forces[None], None, rates, motion)

    @property
    def parts(self) -> Int[Array, "*n f 4"]:
        """The points of each face."""
        return self.faces

    def spread_tangents(
        self, place: Array, motion: Motion, now: StepContext, *, turning: bool
    ) -> SpreadTangents:
        """Of every face that of its pressure; of all points together that of the volume."""
        if motion.spin.shape[-2] > place.shape[1]:
            raise ValueError("gas in a surface: its points must be nodes, not places between those of a tie")

        def one(
            gas: "EnclosedGas", place: Array, start: Array, rows: Array, rates: Array
        ) -> tuple[Array, Array, Array]:
            begun, middle = place_markers(place, start), place_markers(place, rows)
            moved = now.h * place_markers(place, rates)
            volume = enclosed_volume(begun, gas.faces)
            gradient = discrete_volume_gradient(middle, moved, gas.faces)
            at_end = volume_gradient(middle + 0.5 * moved, gas.faces)
            pressure, slope = jax.value_and_grad(gas.mean_pressure, argnums=1)(
                volume, jnp.sum(gradient * moved)
            )
            return pressure, gradient, slope * at_end

        pressure, gradient, stiffening = jax.vmap(one)(
            self, place, motion.start, motion.rows[0], motion.rates[0]
        )
        return SpreadTangents(
            self._of_faces(place, motion, now, pressure, turning),
            *_of_all(place, motion, now.h, gradient, stiffening, turning),
        )

    def _of_faces(
        self, place: Array, motion: Motion, now: StepContext, pressure: Array, turning: bool
    ) -> Float[Array, "nf 4 1 r 4 1 r"]:
        def gathered(x: Array) -> Array:
            return jax.vmap(lambda x, faces: x[faces])(x, self.faces).reshape(-1, 4, *x.shape[2:])

        own = gathered(place)[:, :, None]
        rows, rates, spin = (gathered(x[0])[None] for x in (motion.rows, motion.rates, motion.spin))
        moving = Motion(gathered(motion.start), rows, rates, spin)
        corners = jnp.sum(own[:, :, 0, :, None] * moving.rows[0], axis=2)
        push = jnp.repeat(pressure, self.faces.shape[-2])[:, None, None]
        forces = push * jax.vmap(follower_loads)(corners)
        slopes = jax.vmap(jax.jacfwd(follower_loads))(corners).reshape(-1, 12, 12)
        return by_twists(-0.5 * push * slopes, forces[:, :, None], own, moving, now.h, turning)


def _of_all(
    place: Array, motion: Motion, h: Array, gradient: Array, stiffening: Array, turning: bool
) -> tuple[Array, Array]:
    """Wrenches of forces along the gradient, and the change of pressure by twists (n, k, 1, r)."""
    if not turning:
        weights = place[..., :1]
        return (weights * gradient)[:, :, None], (h * weights * stiffening)[:, :, None]
    across, along, _ = twist_maps(place[:, :, None], motion, h)
    columns = jnp.einsum("nkmux,nkx->nku", across, gradient)
    rows = h * jnp.einsum("nkmux,nkx->nku", along, stiffening)
    return columns[:, :, None], rows[:, :, None]
