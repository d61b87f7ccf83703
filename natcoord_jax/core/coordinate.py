"""Joint coordinates (angles, displacements) and the kinds of effect that act on them.

A coordinate gives, over a step, its exact increment and the loads on the two frames that do unit work
on it. With that pair any scalar law acts on the coordinate with an exact energy balance, whatever the
joint, in the spanning tree or closing a loop.
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.gradient import averaged_gradient, cancelling_energy
from natcoord_jax.core.joint import Frame, frames_at
from natcoord_jax.core.kinds import JOINT, NAME, Several
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.unit_loads import PairMotion, UnitLoad

SAMPLES = 5
"""Instants of a step at which rates of prescribed coordinates are taken, ends included."""


@dataclass(frozen=True)
class Coordinate(abc.ABC):
    """Base of joint coordinates; final classes are frozen dataclasses: hashable, without arrays."""

    unit: ClassVar[str] = "rad"

    @abc.abstractmethod
    def unit_load(self, pair: PairMotion, h: Float[Array, ""]) -> UnitLoad:
        """Rate and unit load over a step."""

    @abc.abstractmethod
    def value(self, parent: Frame, child: Frame) -> Float[Array, ""]:
        """Value [rad, in (-pi, pi], or m] from frames at one time."""

    @abc.abstractmethod
    def rate(
        self, parent: Frame, child: Frame, parent_rate: Frame, child_rate: Frame, relative_spin: Array
    ) -> Float[Array, ""]:
        """Rate [rad/s or m/s] from frames at one time, their rates and the relative angular velocity."""


def pair_motion(place: Float[Array, "2 4 4"], motion: Motion, first: int) -> PairMotion:
    """Motion of the joint frames of bodies `first` and `first + 1` of an effect."""
    both = slice(first, first + 2)
    parent_start, child_start = frames_at(place, motion.start[both])
    parent, child = frames_at(place, motion.rows[:, both])
    parent_rate, child_rate = frames_at(place, motion.rates[:, both])
    spins = motion.spin[:, first], motion.spin[:, first + 1]
    return PairMotion(parent_start, child_start, parent, child, parent_rate, child_rate, *spins)


class CoordinateEffect(Effect):
    """Base of effects on the coordinates of joints.

    Attributes:
        joint: handle of the joint, or a tuple of handles.
        coordinate: index of the coordinate in the joint's list; of several joints the same of each, or a
            tuple of indices.
        name: optional name.
        axes: the coordinates' descriptions, filled in at compile.

    Class attributes:
        on_a_ball: what there is instead for joints that turn freely, which have no coordinate.
    """

    joint: Any = eqx.field(metadata=is_a(JOINT | Several(JOINT, 1)))
    coordinate: Any = eqx.field(default=0, kw_only=True, metadata=is_a(Whole(0) | Several(Whole(0), 1)))
    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))
    axes: tuple[Coordinate, ...] = eqx.field(default=(), init=False, static=True)

    kind: ClassVar[str] = "coordinate effect"
    on_a_ball: ClassVar[str] = ""

    @abc.abstractmethod
    def generalised(
        self, rates: Float[Array, "s c"], now: StepContext, lam: Float[Array, "s m"]
    ) -> tuple[Float[Array, "s c"], Float[Array, "s m"], Float[Array, " s"]]:
        """Generalised forces [N m or N], constraint rates and power, from the rates of the coordinates."""

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Unit loads of the coordinates times the generalised forces."""
        loads = [
            axis.unit_load(pair_motion(place[k], motion, 2 * k), now.h) for k, axis in enumerate(self.axes)
        ]
        rates = jnp.stack([load.rate for load in loads], axis=-1)
        forces, rows, power = self.generalised(rates, now, lam)
        if motion.force_rows is not None:
            held, still = motion.held, jnp.zeros_like(now.h)
            loads = [
                axis.unit_load(pair_motion(place[k], held, 2 * k), still) for k, axis in enumerate(self.axes)
            ]
        on_rows, torques = [], []
        for k, load in enumerate(loads):
            factor = forces[:, k, None, None]
            if load.forces is not None:
                on_rows.append((k, factor[..., None] * jnp.einsum("bma,sbmc->sbac", place[k], load.forces)))
            if load.torques is not None:
                torques.append((k, factor * load.torques))
        return Response(_joined(on_rows, len(loads)), _joined(torques, len(loads)), rows, power)


def _joined(parts: list[tuple[int, Array]], count: int) -> Array | None:
    """Loads of all coordinates along the axis of bodies, zero where one has none; None without any."""
    if not parts:
        return None
    given = dict(parts)
    nothing = jnp.zeros_like(parts[0][1])
    return jnp.concatenate([given.get(k, nothing) for k in range(count)], axis=1)


class CoordinatePotential(CoordinateEffect):
    """Base of elastic laws on one joint coordinate: subclass it and give `energy`."""

    joint: Any = eqx.field(metadata=is_a(JOINT))
    coordinate: Any = eqx.field(default=0, kw_only=True, metadata=is_a(Whole(0)))

    kind: ClassVar[str] = "coordinate potential"
    stores: ClassVar[bool] = True
    elastic: ClassVar[bool] = True
    degree: ClassVar[int | None] = None

    @abc.abstractmethod
    def energy(self, coordinate: Float[Array, ""]) -> Float[Array, ""]:
        """Energy [J] of the continuous coordinate [rad or m]."""

    def generalised(self, rates: Array, now: StepContext, lam: Array) -> tuple[Array, Array, Array]:
        """Averaged gradient of the energy along the step."""
        gradient = averaged_gradient(
            lambda c: self.energy(c[0]), now.coordinates, now.h * rates, now.tableau, self.degree
        )
        if now.stress is not None:
            gradient = gradient + now.stress
        stages = now.tableau.stages
        return -gradient, jnp.zeros((stages, 0)), jnp.sum(-gradient * rates, axis=-1)

    def strain_rates(self, place: Array, motion: Motion, h: Array) -> Array:
        """Mean rate of the coordinate over the step."""
        return self.axes[0].unit_load(pair_motion(place[0], motion, 0), h).rate[:, None]

    def curvature(self, place: Array, rows: Array, coordinates: Array) -> Array:
        """Second derivative of the energy [N m/rad or N/m]."""
        return jax.hessian(lambda c: self.energy(c[0]))(coordinates)

    def cancelling(self, place: Array, rows: Array, coordinates: Array) -> tuple[Array, Array]:
        """Stiffness times the coordinate, of which the generalised force is a difference; the coordinate."""
        return cancelling_energy(lambda c: self.energy(c[0]), coordinates), jnp.abs(coordinates[0])

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Array:
        """Energy [J]."""
        return self.energy(coordinates[0])


class CoordinateForce(CoordinateEffect):
    """Base of non-potential laws on one joint coordinate: subclass it and give `force`."""

    joint: Any = eqx.field(metadata=is_a(JOINT))
    coordinate: Any = eqx.field(default=0, kw_only=True, metadata=is_a(Whole(0)))

    kind: ClassVar[str] = "coordinate force"
    works: ClassVar[bool] = True

    @abc.abstractmethod
    def force(self, rate: Float[Array, ""], inputs: Array, t: Float[Array, ""]) -> Float[Array, ""]:
        """Generalised force [N m or N] on the child, its opposite on the parent."""

    def generalised(self, rates: Array, now: StepContext, lam: Array) -> tuple[Array, Array, Array]:
        """The force at every stage; its power is force times rate, exactly."""
        forces = jax.vmap(self.force)(rates[:, 0], now.stage_inputs, now.times)
        return forces[:, None], jnp.zeros((len(now.tableau.b), 0)), forces * rates[:, 0]


class CoordinateInertia(CoordinateEffect):
    """Base of rotors: inertia that only a joint coordinate sees; subclass it and give `inertia_of`."""

    joint: Any = eqx.field(metadata=is_a(JOINT))
    coordinate: Any = eqx.field(default=0, kw_only=True, metadata=is_a(Whole(0)))

    kind: ClassVar[str] = "coordinate inertia"
    stores: ClassVar[bool] = True
    rotors: ClassVar[int] = 1
    impulsive: ClassVar[bool] = True

    @abc.abstractmethod
    def inertia_of(self) -> Float[Array, ""]:
        """Inertia [kg m^2 or kg] along the coordinate."""

    def generalised(self, rates: Array, now: StepContext, lam: Array) -> tuple[Array, Array, Array]:
        """Inertia impulse -I sum_j (A^-1)_ij (r_j - r_0) with the stored rate r_0."""
        forces = -self.inertia_of() * now.tableau.differentiated(rates - now.rates)
        return forces, jnp.zeros((forces.shape[0], 0)), jnp.zeros(forces.shape[0])

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Array:
        """Kinetic energy [J] of the rotor."""
        return 0.5 * self.inertia_of() * rates[0] ** 2


class CoordinateConstraint(CoordinateEffect):
    """Base of relations sum_k a_k c_k = f(t) between joint coordinates; one multiplier each.

    The multiplier is the generalised force; with a constant right-hand side it does no work, with a
    prescribed one its work is booked in the work account.
    """

    kind: ClassVar[str] = "coordinate constraint"
    multipliers: ClassVar[int] = 1
    impulsive: ClassVar[bool] = True
    works: ClassVar[bool] = True

    @abc.abstractmethod
    def coefficients(self) -> Float[Array, " c"]:
        """Factors a_k."""

    @abc.abstractmethod
    def target(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Right-hand side f(t)."""

    def prescribed(self, t: Array, h: Array) -> tuple[Float[Array, ""], Float[Array, " samples"]]:
        """Change of the right-hand side in a step, and its rates at instants of it, times the step."""
        times = t + h * jnp.linspace(0.0, 1.0, SAMPLES)
        rates = jax.vmap(lambda t: jax.jvp(self.target, (t,), (jnp.ones_like(t),))[1])(times)
        return self.target(times[-1]) - self.target(times[0]), h * rates

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """Left-hand side less right-hand side."""
        return (self.coefficients() @ coordinates - self.target(t))[None]

    def violation_rate(
        self, place: Array, rows: Array, rates: Array, spin: Array, t: Array, passing: Any
    ) -> Array:
        """That of both sides."""
        frames, moving = (jax.vmap(frames_at)(place, x.reshape(-1, 2, *NODE)) for x in (rows, rates))
        relative = spin[1::2] - spin[::2]
        found = []
        for k, axis in enumerate(self.axes):
            parent, child, *pair = jax.tree.map(lambda x, k=k: x[k], (*frames, *moving))
            found.append(axis.rate(parent, child, pair[0], pair[1], relative[k]))
        target = jax.jvp(self.target, (t,), (jnp.ones_like(t),))[1]
        return (self.coefficients() @ jnp.stack(found) - passing * target)[None]

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """That of the coordinates; metres where a relation has angles and displacements."""
        return ("m" if any(axis.unit == "m" for axis in self.axes) else "rad",)

    def generalised(self, rates: Array, now: StepContext, lam: Array) -> tuple[Array, Array, Array]:
        """Impulses a lambda; the row asks the coordinates at the end of the step to obey the relation.

        Without a step (h = 0, the projection of velocities) it asks for the rate of the relation.
        """
        factors = self.coefficients()
        resting = now.h == 0
        step = jnp.where(resting, 1.0, now.h)
        reached = (self.target(now.t + now.h) - factors @ now.coordinates) / step
        rate = jax.vmap(lambda t: jax.jvp(self.target, (t,), (jnp.ones_like(t),))[1])(now.times)
        if now.tableau.stages > 1:
            # Stage by stage the rate prescribed, moved by what the sum of these misses.
            reached = rate + (reached - jnp.asarray(now.tableau.b) @ rate)
        rows = rates @ factors - jnp.where(resting, rate, reached)
        return lam * factors, rows[:, None], lam[:, 0] * (rates @ factors)
