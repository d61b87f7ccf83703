"""What elements of shells and membranes have in common: an energy that is quadratic in their invariants."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import of
from natcoord_jax.core.numeric import COMPONENTS, Directions, Number
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.effects.materials import MASS, Elastic, Laminate, Orthotropic, Sheet
from natcoord_jax.maths.vectors import cross, dot


class ShellReadings(eqx.Module):
    """What goes on in an element of a shell, in its middle, along its own axes 1 and 2.

    The first axis bisects between the side from the first node to the second and what the other sides ask
    for; the director is on the side of positive thickness.

    Attributes:
        strain: of the mid-surface 11, 22, and the angle 12 [-].
        curvature: of the mid-surface, by which strains grow along the director [1/m].
        shear: angles 13 and 23 between director and surface [-].
        resultants: membrane forces per length 11, 22, 12 [N/m].
        moments: per length [N].
        shear_forces: per length [N/m].
        stress: 11, 22, 12 at the surfaces on the sides against and along the director [N/m^2].
        energy: stored [J].
    """

    strain: Float[Array, "*t 3"]
    curvature: Float[Array, "*t 3"]
    shear: Float[Array, "*t 2"]
    resultants: Float[Array, "*t 3"]
    moments: Float[Array, "*t 3"]
    shear_forces: Float[Array, "*t 2"]
    stress: Float[Array, "*t 2 3"]
    energy: Float[Array, "*t"]


FLAT = 1e-9
"""Area at a corner, in squares of the sides, up to which an element is degenerate there."""

BESIDE = 0.1
"""Cosine of the angle between normal and directors at least: along the surface there is no thickness."""

MATERIAL = of("a material, as nc.Elastic(...)", Elastic, Orthotropic, Laminate)


class LayerElement(Potential):
    """Base of elements of a layer: a subclass gives `invariants`, `matrices` and `overlaps_of`."""

    thickness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    material: Any = eqx.field(kw_only=True, metadata=is_a(MATERIAL))
    direction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Directions()))
    offset: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))
    prestress: Any = eqx.field(default=None, kw_only=True, metadata=is_a(COMPONENTS))
    damping: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    mass: str = eqx.field(default="lumped", kw_only=True, static=True, metadata=is_a(MASS))
    reference: Any = eqx.field(default=None, kw_only=True)
    stiffness: Any = eqx.field(default=None, init=False)
    rest: Any = eqx.field(default=None, init=False)
    pull: Any = eqx.field(default=None, init=False)
    overlaps: Any = eqx.field(default=None, init=False)

    degree: ClassVar[int | None] = 2
    together: ClassVar[bool] = True
    derived: ClassVar[tuple[str, ...]] = ("stiffness", "rest", "pull", "overlaps")
    silent: ClassVar[bool] = False
    bends: ClassVar[bool] = True

    @abc.abstractmethod
    def matrices(self, x: Float[Array, "k 3"]) -> Any:
        """Integrals over the element without stress: `stiffness`, `membrane`, `stretching`."""

    @abc.abstractmethod
    def overlaps_of(self, x: Float[Array, "k 3"]) -> Float[Array, "k k"]:
        """Integrals of the products of the shape functions of its nodes [m^2]."""

    @property
    def areas(self) -> Float[Array, " k"]:
        """Areas that its nodes stand for [m^2]."""
        return jnp.sum(self.overlaps, axis=-1)

    @property
    def works(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether anything is lost, which its account then has."""
        return self.damping is not None

    @property
    def viscosity(self) -> Float[Array, "p p *n"] | None:
        """Stiffness times the time of the damping."""
        return None if self.damping is None else self.damping * self.stiffness

    @abc.abstractmethod
    def middle(self, x: Float[Array, "k 3"]) -> tuple[Float[Array, "3 m"], Float[Array, "2 s"]]:
        """Strains and shears in the middle by the invariants of the membrane and of shear."""

    @property
    def places(self) -> Float[Array, "k 3"]:
        """Of the nodes without stress [m]."""
        return self.reference[:, 0] if self.bends else self.reference

    def assembled_at(self, x: Float[Array, "k *m 3"]) -> "LayerElement":
        """With the assembled pose as the one without stress, unless another is given."""
        given = (x[:, :2] if self.bends else x) if self.reference is None else self.reference
        return _renewed(replace_fields(self, reference=given))

    def renewed(self) -> "LayerElement":
        """With the stiffness and the invariants of the pose without stress."""
        found, pull = self.matrices(self.places), None
        stiffness, rest = found.stiffness if self.bends else found.membrane, self.invariants(self.reference)
        if self.prestress is not None:
            pull = jnp.zeros_like(rest)
            pull = pull.at[: found.stretching.shape[1]].set(jnp.asarray(self.prestress) @ found.stretching)
        overlaps = self.overlaps_of(self.places)
        return replace_fields(self, stiffness=stiffness, rest=rest, pull=pull, overlaps=overlaps)

    def sheet(self) -> Sheet:
        """What it resists with, about its nodes."""
        found = self.material.sheet(self.thickness)
        return found if self.offset is None else found.shifted(self.offset)

    def mass_matrix(self) -> Float[Array, "k m *m"]:
        """Of the points [kg] and of the directors [kg m^2], and between them [kg m] if there is an offset."""
        h, z = self.thickness, 0.0 if self.offset is None else self.offset
        across = jnp.array([[1.0, z], [z, h**2 / 12 + z**2]]) if self.bends else jnp.ones((1, 1))
        across = self.material.density * h * across
        if self.mass == "consistent":
            return self.overlaps[:, None, :, None] * across[:, None]
        return self.areas[:, None, None] * across

    def flaws(self) -> dict[str, Array]:
        """Corners that are no corners, and directors along the surface."""
        if self.stiffness is None:
            return {}
        x = self.places
        sides = jnp.roll(x, -1, axis=0) - x
        corners = cross(jnp.roll(sides, 1, axis=0), sides)
        normal = jnp.sum(corners, axis=0)
        length = jnp.sqrt(dot(normal, normal))
        flat = jnp.min(dot(corners, normal)) <= FLAT * jnp.sum(sides**2) * length
        found = {
            "is degenerate or not convex: list its nodes in turn round it, each once": flat,
            "has no first axis: direction [-] is normal to it": ~flat
            & ~jnp.all(jnp.isfinite(self.stiffness)),
        }
        if self.bends:
            away = dot(self.reference[:, 1], normal) / jnp.where(length > 0, length, 1.0)
            beside = ~(jnp.all(away > BESIDE) | jnp.all(away < -BESIDE))
            said = "has directors along it, or to both of its sides: pass such as are near its normals"
            found[said] = ~flat & beside
        return found

    def energy(self, invariants: Float[Array, "p *n"]) -> Float[Array, "*n"]:
        """Energy [J]."""
        strain = invariants - self.rest
        found = 0.5 * jnp.sum(self.stiffness * strain[:, None] * strain[None], axis=(0, 1))
        return found if self.pull is None else found + jnp.sum(self.pull * strain, axis=0)

    def slope(self, invariants: Float[Array, "p *n"]) -> Float[Array, "p *n"]:
        """Stresses conjugate to the invariants."""
        found = jnp.sum(self.stiffness * (invariants - self.rest)[None], axis=1)
        return found if self.pull is None else found + self.pull

    def energy_curvature(self, invariants: Float[Array, " p"]) -> Float[Array, "p p"]:
        """The constant stiffness."""
        return self.stiffness

    def readings(self, place: Array, rows: Array) -> ShellReadings:
        """Strains of the surface of the nodes in the middle; resultants and stresses."""
        found = self.invariants(place_markers(place, rows))
        change, (strain_of, shear_of) = found - self.rest, self.middle(self.places)
        count, energy = strain_of.shape[1], self.energy(found)
        strain, curvature, shear = strain_of @ change[:count], jnp.zeros(3), jnp.zeros(2)
        if self.bends:
            curvature, shear = strain_of @ change[count : 2 * count], shear_of @ change[2 * count :]
        sheet, half, offset = self.sheet(), 0.5 * self.thickness, 0.0 if self.offset is None else self.offset
        pull = jnp.zeros(3) if self.prestress is None else jnp.asarray(self.prestress)
        sides = offset - half, offset + half
        stress = [face @ (strain + z * curvature) + pull / (2 * half) for z, face in zip(sides, sheet.faces)]
        resultants = sheet.membrane @ strain + sheet.coupling @ curvature + pull
        moments = sheet.coupling @ strain + sheet.bending @ curvature + offset * pull
        forces = sheet.shear @ shear
        return ShellReadings(strain, curvature, shear, resultants, moments, forces, jnp.stack(stress), energy)


@eager_numpy
def _renewed(element: LayerElement) -> LayerElement:
    return element.renewed()
