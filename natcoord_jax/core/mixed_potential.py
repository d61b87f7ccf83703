"""Potentials with unknowns of their own, as pressures and enhanced strains in elements."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.maths.elimination import definite_inverse, definite_solution
from natcoord_jax.maths.implicit import implicit_root

ITERATIONS = 30
"""Most of Newton's method for the unknowns of an element."""

SETTLED = 1e-12
"""Change of the unknowns, relative, after which one more step leaves rounding only."""


class MixedReadings(eqx.Module):
    """What the sensor of an element with unknowns of its own shows.

    Attributes:
        own: its unknowns.
        energy: stored [J].
    """

    own: Float[Array, "*t own"]
    energy: Float[Array, "*t"]


class MixedPotential(Potential):
    """Base of potentials with unknowns that nothing else sees, as the pressure in an element.

    Give `invariants`, and `mixed_energy` of these and of the unknowns. The energy is its stationary value: a
    minimum, as by enhanced strains, or a saddle, as by pressures. Elements solve for their unknowns by
    themselves, so that the equations of the system do not have them; `system.sense` shows them. Energy and
    momenta are kept as by any potential.

    Derivatives of every order are those of the stationary value, by the implicit rule.

    Attributes:
        markers: see `nc.Potential`.

    Class attributes:
        unknowns: number of unknowns of an element.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> class Series(nc.MixedPotential):
        ...     '''Two springs one after the other, with a point between them that has no mass.'''
        ...     unknowns = 1
        ...     def invariants(self, x):
        ...         return ((x[1] - x[0]) @ (x[1] - x[0]))[None]
        ...     def mixed_energy(self, invariants, own):
        ...         return 0.5 * 300.0 * own[0] ** 2 + 0.5 * 600.0 * (invariants[0] - own[0]) ** 2
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0)))
        >>> both = scene.add(Series((nc.Point(nc.ground), nc.Point(ball))))
        >>> system, state = scene.compile()
        >>> print(system.sense(state, both).own.round(6), system.sense(state, both).energy.round(6))
        [0.666667] 100.0
    """

    silent: ClassVar[bool] = False
    unknowns: ClassVar[int]

    @abc.abstractmethod
    def mixed_energy(self, invariants: Float[Array, " p"], own: Float[Array, " own"]) -> Float[Array, ""]:
        """Energy [J], stationary in the unknowns; its second derivatives by them are quasi-definite."""

    def begun(self, invariants: Float[Array, " p"]) -> Float[Array, " own"]:
        """Where the search for the unknowns begins."""
        return jnp.zeros(self.unknowns, invariants.dtype)

    def own_unknowns(self, invariants: Float[Array, " p"]) -> Float[Array, " own"]:
        """The unknowns, differentiable to any order; NaN where none are found, by which a run fails."""
        return implicit_root(_slope, _stationary, self, invariants)

    def change(self, invariants: Float[Array, " p"], own: Float[Array, " own"]) -> Float[Array, " own"]:
        """A step of Newton's method for the unknowns."""
        slope, bend = jax.grad(self.mixed_energy, 1), jax.hessian(self.mixed_energy, 1)
        return -definite_solution(bend(invariants, own), slope(invariants, own))

    def reach(self, invariants: Float[Array, " p"], own: Float[Array, " own"]) -> Float[Array, " own"]:
        """How far the unknowns would change if the invariants did by all of themselves, term by term."""
        mixed = jax.jacfwd(jax.grad(self.mixed_energy, 1), 0)(invariants, own)
        inverse = definite_inverse(jax.hessian(self.mixed_energy, 1)(invariants, own))
        return jnp.abs(inverse) @ (jnp.abs(mixed) @ jnp.abs(invariants))

    def energy(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Stationary value [J]."""
        return self.mixed_energy(invariants, self.own_unknowns(invariants))

    def readings(self, place: Array, rows: Array) -> MixedReadings:
        """The unknowns and the energy."""
        invariants = self.invariants(place_markers(place, rows))
        return MixedReadings(self.own_unknowns(invariants), self.energy(invariants))


def _slope(own: Array, potential: MixedPotential, invariants: Array) -> Float[Array, " own"]:
    """What vanishes at the unknowns."""
    return jax.grad(potential.mixed_energy, 1)(invariants, own)


def _stationary(potential: MixedPotential, invariants: Array) -> Float[Array, " own"]:
    """Newton's method."""

    def trip(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        own, _, count = carry
        step, reach = potential.change(invariants, own), potential.reach(invariants, own)
        return own + step, jnp.all(jnp.abs(step) <= SETTLED * (jnp.abs(own) + reach)), count + 1

    first = potential.begun(invariants), jnp.array(False), jnp.array(0)
    found, settled, _ = jax.lax.while_loop(lambda c: ~c[1] & (c[2] < ITERATIONS), trip, first)
    found = jnp.where(settled, found, jnp.nan)
    return found + potential.change(invariants, found)
