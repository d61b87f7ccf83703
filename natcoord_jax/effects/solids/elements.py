"""Elements of solids of any hyperelastic material, by tables of shape functions and quadrature points.

The invariants are the strains of Green and Lagrange at the quadrature points, quadratic in the coordinates of
the nodes. Elements for nearly incompressible materials take the ratio of volumes J in the energy U(J) as its
projection on polynomials of their own, in the reference volume: that is the mixed method of displacements,
pressures and dilatations with the latter two eliminated (J. C. Simo, R. L. Taylor, K. S. Pister, Comput.
Methods Appl. Mech. Eng. 51 (1985) 177-208).
"""

from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.cells import CELLS, quadrature, shapes
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.kinds import of
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.together import chunked
from natcoord_jax.effects.hyperelastic import Hyperelastic, tensors_of
from natcoord_jax.effects.materials import Elastic
from natcoord_jax.effects.solids.brick import SolidPotential, SolidReadings, inverse_and_volume, von_mises
from natcoord_jax.effects.solids.mass import consistent_mass, lumped_mass
from natcoord_jax.effects.solids.tangents import solid_tangents
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.symmetric import full

MATERIAL = of("a material, as nc.Elastic(...) or nc.NeoHooke(...)", Elastic, Hyperelastic)


class SolidElement(SolidPotential):
    """Base of elements of solids: a subclass says of how many nodes, and what the volumes are projected on.

    Attributes:
        markers: its nodes, in the order of `nc.mesh.Mesh`.
        material: as `nc.Elastic` or `nc.NeoHooke`.
        mass: "lumped" at the nodes, or "consistent": between them, too, that of the interpolated motion.
        reference: points (k, 3) without stress [m]; None: those of the assembled pose.
        gradients: derivatives of the shape functions at the quadrature points [1/m], follow from the others.
        volumes: of the quadrature points [m^3], follow from the others.
        modes: orthonormal functions there that volumes are projected on, follow from the others.

    Class attributes:
        count: number of nodes.
        projected: number of these functions: 1, then linear ones; none: volumes are not projected.
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    material: Any = eqx.field(kw_only=True, metadata=is_a(MATERIAL))
    modes: Any = eqx.field(default=None, init=False)

    derived: ClassVar[tuple[str, ...]] = ("gradients", "volumes", "modes")
    count: ClassVar[int]
    projected: ClassVar[int] = 0
    listed: ClassVar[str] = "nodes as in nc.mesh.Mesh, those of edges midway"

    def __check_init__(self) -> None:
        if len(self.markers) != self.count:
            raise ValueError(
                f"{type(self).__name__}: has {len(self.markers)} markers; pass {self.count} nc.Point"
            )
        if self.projected and not self.material.split:
            raise ValueError(
                f"{type(self).__name__}: the energy of {type(self.material).__name__} does not split off "
                "that of a change of volume, which this element needs; pass one that does, as nc.NeoHooke or "
                "nc.MooneyRivlin, or take an element without projected volumes"
            )

    def renewed(self) -> "SolidElement":
        """With what follows from the pose without stress."""
        points, weights = quadrature(self.count)
        (values, slopes), gradients, volumes = shapes(CELLS[self.count], points), [], []
        for slope, weight in zip(slopes, weights):
            inverse, volume = inverse_and_volume(self.reference.T @ slope)
            gradients.append(slope @ inverse)
            volumes.append(weight * volume)
        volume = jnp.stack(volumes)
        places = values @ self.reference
        places = places - volume @ places / jnp.sum(volume)
        functions = [jnp.ones_like(volume), *places.T][: self.projected]
        modes: list[Array] = []
        for function in functions:
            for mode in modes:
                function = function - (volume * mode) @ function * mode
            modes.append(function / jnp.sqrt(jnp.abs(volume) @ function**2))
        stacked = jnp.stack(modes, axis=1) if modes else jnp.zeros((len(volumes), 0))
        return replace_fields(self, gradients=jnp.stack(gradients), volumes=volume, modes=stacked)

    def mass_matrix(self) -> Float[Array, "k *m"]:
        """Of the points [kg]."""
        if self.mass == "consistent":
            return consistent_mass(self.count, self.reference, self.material.density)
        return lumped_mass(self.count, self.volumes, self.material.density)

    def invariants(self, x: Float[Array, "k 3 *n"]) -> Float[Array, "p *n"]:
        """Strains of Green and Lagrange at the quadrature points, component by component [-]."""
        return jnp.concatenate(self.strains(x))

    def by_point(self, invariants: Float[Array, "p *n"]) -> Float[Array, "6 g *n"]:
        """Components at the quadrature points."""
        return invariants.reshape(6, -1, *invariants.shape[1:])

    def project(self, values: Float[Array, "g *n"]) -> Float[Array, "g *n"]:
        """Values at the quadrature points made functions that the element has; symmetric in its volume."""
        if not self.projected:
            return values
        shares = jnp.sum(self.modes * (self.volumes * values)[:, None], axis=0)
        return jnp.sum(self.modes * shares[None], axis=1)

    def energy(self, invariants: Float[Array, "p *n"]) -> Float[Array, "*n"]:
        """Energy [J]."""
        found = self.material.energy_density(self.by_point(invariants), self.project)
        return jnp.sum(self.volumes * found, axis=0)

    def mean_stress(self, start: Float[Array, "6 g *n"], step: Float[Array, "6 g *n"]) -> Array:
        """Stress of Piola and Kirchhoff whose work over a step is the change of energy [N/m^2]."""
        return self.material.mean_stress(start, step, self.mean_pressure(start, step))

    def mean_pressure(self, start: Float[Array, "6 g *n"], step: Float[Array, "6 g *n"]) -> Array | None:
        """Change of the energy of volumes by them, projected; None: the material finds it."""
        if not self.projected:
            return None
        before, after = (jnp.sqrt(tensors_of(x).c) for x in (start, start + step))
        return self.project(self.material.pressure(self.project(before), self.project(after)))

    def averaged(
        self, start: Float[Array, "p *n"], steps: Float[Array, "s p *n"], tableau: Tableau
    ) -> Float[Array, "s p *n"]:
        """Averaged gradients: of one stage by products and quotients, of more by quadrature."""
        if tableau.stages > 1 or tableau.variational:
            degree = self.material.degree
            return averaged_gradient(self.energy, start, steps, tableau, degree, None, self.slope)
        found = self.mean_stress(self.by_point(start), self.by_point(steps[0]))
        return (self.volumes * found).reshape(steps.shape)

    def cancelling(self, place: Array, rows: Array, coordinates: Array) -> tuple[Array, Array]:
        """Stiffness times strains, of which the stresses are differences; the distance of the nodes."""
        x = place_markers(place, rows)
        strain = self.by_point(self.invariants(x))

        def stress(strain: Array) -> Array:
            return jax.grad(lambda e: jnp.sum(self.material.energy_density(e)))(strain)

        def work(unit: Array) -> Array:
            along = jnp.broadcast_to(unit[:, None], strain.shape)
            found = jnp.abs(jax.jvp(stress, (strain,), (along,))[1])
            return jnp.sum(unit[:, None] * found * strain**2, axis=0)

        # One copy of the derivatives for all components: laws of one's own may be long.
        found = jnp.sum(jax.vmap(work)(jnp.eye(6)), axis=0)
        reach = jnp.sqrt(jnp.max(jnp.sum((x - x[0]) ** 2, axis=-1)))
        return jnp.sum(self.volumes * found), reach

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Array, *, turning: bool
    ) -> Array | None:
        """In formulas for one stage."""
        several = motion.spin.shape[-2] > place.shape[1]
        if several or now.tableau.stages > 1 or now.tableau.variational or now.stress is not None:
            return None
        return chunked(partial(solid_tangents, turning=turning), self, place, motion, now)

    def readings(self, place: Array, rows: Array) -> SolidReadings:
        """Strains and stresses on average over the element."""
        x = place_markers(place, rows)
        found = self.invariants(x)
        strain = self.by_point(found)
        stress = full(self.by_point(jax.grad(self.energy)(found)))
        f = jnp.einsum("gkj,ki->ijg", self.gradients, x)
        volume = jnp.sum(self.volumes * jnp.sqrt(tensors_of(strain).c))
        cauchy = jnp.einsum("ikg,klg,jlg->ij", f, stress, f) / volume
        return SolidReadings(
            strain @ self.volumes / jnp.sum(self.volumes), cauchy, von_mises(cauchy), self.energy(found)
        )


class Hexahedron8(SolidElement):
    """A brick of eight points, of any material; it locks in bending, unlike `nc.Brick`.

    Attributes:
        markers: its nodes, in the order of `nc.mesh.Mesh`.
        material: as `nc.Elastic` or `nc.NeoHooke`.
        mass: "lumped" at the nodes, or "consistent": between them, too, that of the interpolated motion.
        reference: points without stress [m]; None: those of the assembled pose.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> mesh = nc.mesh.box((1.0, 0.2, 0.2), (2, 1, 1), element="hexahedron8")
        >>> rubber = nc.NeoHooke(E=1e6, nu=0.45, density=1100.0)
        >>> block = nc.Solid(mesh, material=rubber, element="Hexahedron8")
    """

    kind: ClassVar[str] = "hexahedron"
    count: ClassVar[int] = 8
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[8].facets


class Hexahedron20(SolidElement):
    """A brick of twenty points, with 27 points of quadrature.

    Its fields, in [m] where they are lengths, are those of `nc.Hexahedron8`.
    """

    kind: ClassVar[str] = "serendipity hexahedron"
    count: ClassVar[int] = 20
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[20].facets


class Hexahedron27(SolidElement):
    """A brick of 27 points.

    Its fields, in [m] where they are lengths, are those of `nc.Hexahedron8`.
    """

    kind: ClassVar[str] = "quadratic hexahedron"
    count: ClassVar[int] = 27
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[27].facets


class Hexahedron27P1(SolidElement):
    """A brick of 27 points with linear volumes, for nearly incompressible materials.

    Attributes:
        markers: its nodes, in the order of `nc.mesh.Mesh`.
        material: one that splits off the energy of a change of volume, as `nc.NeoHooke`.
        reference: points without stress [m]; None: those of the assembled pose.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> mesh = nc.mesh.box((1.0, 0.2, 0.2), (2, 1, 1), element="hexahedron27")
        >>> rubber = nc.NeoHooke(E=1e6, nu=0.45, density=1100.0)
        >>> block = nc.Solid(mesh, material=rubber, element="Hexahedron27P1")
    """

    kind: ClassVar[str] = "quadratic hexahedron with linear pressure"
    count: ClassVar[int] = 27
    projected: ClassVar[int] = 4
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[27].facets


class Tetrahedron10(SolidElement):
    """A tetrahedron of ten points, with four points of quadrature.

    Its fields, in [m] where they are lengths, are those of `nc.Hexahedron8`.
    """

    kind: ClassVar[str] = "quadratic tetrahedron"
    count: ClassVar[int] = 10
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[10].facets


class Tetrahedron10P0(SolidElement):
    """A tetrahedron of ten points with one volume, for nearly incompressible materials.

    Its fields, in [m] where they are lengths, are those of `nc.Hexahedron27P1`.
    """

    kind: ClassVar[str] = "quadratic tetrahedron with constant pressure"
    count: ClassVar[int] = 10
    projected: ClassVar[int] = 1
    faces: ClassVar[tuple[tuple[int, ...], ...]] = CELLS[10].facets
