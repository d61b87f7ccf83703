"""The gap between two surfaces: what all contacts have in common, whatever keeps it open."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a, require
from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.kinds import of
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.potential import MarkerEffect, place_markers
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.vectors import unit


class Gap(Part):
    """Base of gaps between two surfaces: subclass it and give `invariants` and `distance`.

    A gap is pure geometry. `nc.GapPotential` pushes where it is negative, `nc.GapConstraint` keeps it from
    becoming so. Directions among the markers are unit vectors. The invariants must be at most quadratic in
    the marker vectors, and unchanged when all of them are rotated (and, for points, moved) together.

    Class attributes:
        markers: what `invariants` receives.
        degree: polynomial degree of `distance` in the invariants, if it is a polynomial; saves work.
        sides: numbers of a point marker of either body.

    Example:
        >>> import natcoord_jax as nc
        >>> class PointAboveGround(nc.Gap):
        ...     degree = 1
        ...     def invariants(self, x):
        ...         return (x[1] @ (x[2] - x[0]))[None]
        ...     def distance(self, invariants):
        ...         return invariants[0]
    """

    markers: ClassVar[Markers] = Markers()
    degree: ClassVar[int | None] = None
    sides: ClassVar[tuple[int, int]] = (0, -1)

    @abc.abstractmethod
    def invariants(self, x: Float[Array, "k 3"]) -> Float[Array, " p"]:
        """Invariants of the marker vectors, at most quadratic."""

    @abc.abstractmethod
    def distance(self, invariants: Float[Array, " p"]) -> Float[Array, ""]:
        """Distance of the surfaces, negative where they overlap [m]."""

    def contact(self, x: Float[Array, "k 3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Where the surfaces touch [m], and the unit normal from the first to the second; for friction."""
        raise NotImplementedError(f"{type(self).__name__} does not say where its surfaces touch")

    def touch(self, x: Float[Array, "k 3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The same for pictures; of gaps that do not say it a point of the second, and how it is pushed."""
        if type(self).contact is not Gap.contact:
            return self.contact(x)
        second = self.sides[1]
        return x[second], unit(self.gradient(x)[second])

    def gradient(self, x: Float[Array, "k 3"]) -> Float[Array, "k 3"]:
        """Of the distance by the marker vectors [-]."""
        return jax.grad(lambda x: self.distance(self.invariants(x)))(x)

    def averaged(
        self, start: Float[Array, " p"], steps: Float[Array, "s p"], tableau: Tableau
    ) -> Float[Array, "s p"]:
        """Gradient by the invariants, averaged along a step: it foretells the gap at its end exactly."""
        return averaged_gradient(self.distance, start, steps, tableau, self.degree)


GAP = of("a gap, as nc.SphereOnPlane(radius=0.1)", Gap)


class GapEffect(MarkerEffect):
    """Base of contacts with a gap between two surfaces."""

    gap: Gap = eqx.field(metadata=is_a(GAP))

    unit_directions: ClassVar[bool] = True

    def __check_init__(self) -> None:
        """Refuse markers of another gap."""
        require(self, "markers", self.gap.markers)

    def gap_at(self, place: Array, rows: Array) -> Float[Array, ""]:
        """Between the surfaces [m]."""
        return self.gap.distance(self.gap.invariants(place_markers(place, rows)))

    def touch(self, place: Array, rows: Array) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Where the surfaces touch [m], and the direction in which the second is pushed."""
        return self.gap.touch(place_markers(place, rows))
