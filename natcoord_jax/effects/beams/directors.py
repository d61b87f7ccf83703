"""Beam elements that interpolate points and directors with the same Lagrange functions (the paper's family).

Strains at reduced Gauss points (Betsch & Steinmann, Frame-indifferent beam finite elements based upon the
geometrically exact beam theory, 2002), of interpolated points and directors,

    Gamma_i = d_i . phi' - (...)_0,    K_i = e_ijk (d_k . d_j' - (...)_0) / 2,

are quadratic in the nodes and frame-indifferent. Interpolated directors shorten between nodes that are turned
against each other, and the element then stretches at no cost: fine meshes only, or `BeamElement`.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Definite, Numbers, Vector
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.maths.vectors import dot


class BeamReadings(eqx.Module):
    """Strains and section forces of beam elements, about the axes d_1, d_2, d_3 of the section.

    Attributes:
        strain: Gamma_1, Gamma_2 (shear), Gamma_3 (stretch) [-] and K_1, K_2 (curvature), K_3 (twist) [1/m],
            zero in the unstressed shape; of director elements at each Gauss point.
        resultant: forces N_1, N_2, N_3 [N] and moments M_1, M_2, M_3 [N m], energy-conjugate to them.
        energy: strain energy [J].
    """

    strain: Float[Array, "*shape 6"]
    resultant: Float[Array, "*shape 6"]
    energy: Float[Array, "*elements"]


def director_strains(
    x: Float[Array, "nodes 4 3"], values: Float[Array, "points nodes"], slopes: Float[Array, "points nodes"]
) -> Float[Array, "points 6"]:
    """(d_i . phi', K_i) at the Gauss points [-, 1/m], not less those of the unstressed shape."""
    at, along = jnp.tensordot(values, x, 1), jnp.tensordot(slopes, x, 1)
    d, rates = at[:, 1:], along[:, 1:]
    stretch = [dot(d[:, i], along[:, 0]) for i in range(3)]
    pairs = [((i + 1) % 3, (i + 2) % 3) for i in range(3)]
    curvature = [0.5 * (dot(d[:, k], rates[:, j]) - dot(d[:, j], rates[:, k])) for j, k in pairs]
    return jnp.stack(stretch + curvature, axis=1)


class DirectorElement(Potential):
    """Linearly elastic beam over two, three or four nodes with interpolated directors.

    Attributes:
        markers: attachments of the nodes, the third axis along the tangent.
        values: of the shape functions at the Gauss points, shape (points, nodes).
        slopes: their derivatives by arc length [1/m].
        weights: of the Gauss points [m].
        stiffness: C, shape (6, 6) [N, N m, N m^2], for (Gamma_1, Gamma_2, Gamma_3, K_1, K_2, K_3).
        reference: strains of the unstressed shape, shape (points, 6) [-, 1/m].
        inertia: mass of the points and directors of the nodes (nodes, 4, nodes, 4) [kg, kg m, kg m^2], which
            couples them; None: what the nodes sit on has it.
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=0)))
    values: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, None))))
    slopes: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, None))))
    weights: Any = eqx.field(kw_only=True, metadata=is_a(Vector(None)))
    stiffness: Any = eqx.field(kw_only=True, metadata=is_a(Definite((6, 6))))
    reference: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, 6))))
    inertia: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 4, None, 4))))

    kind: ClassVar[str] = "director element"
    couples: ClassVar[bool] = True
    silent: ClassVar[bool] = False
    degree: ClassVar[int | None] = 2

    def mass_matrix(self) -> Float[Array, "k 4 k 4"] | None:
        """Of the nodes."""
        return self.inertia

    def readings(self, place: Array, rows: Array) -> BeamReadings:
        """Strains and section forces at the Gauss points."""
        invariants = self.invariants(place_markers(place, rows))
        strains = self.strains(invariants)
        return BeamReadings(strains, self.resultants(strains), self.energy(invariants))

    def invariants(self, x: Array) -> Array:
        """Strains at the Gauss points before those of the unstressed shape are taken off [-, 1/m]."""
        return director_strains(x, self.values, self.slopes).reshape(-1)

    def strains(self, invariants: Array) -> Float[Array, "points 6"]:
        """Strains Gamma [-] and K [1/m] at the Gauss points, zero in the unstressed shape."""
        return invariants.reshape(-1, 6) - self.reference

    def resultants(self, strains: Float[Array, "*p 6"]) -> Float[Array, "*p 6"]:
        """Section forces [N] and moments [N m] about the axes of the section."""
        return jnp.sum(self.stiffness * strains[..., None, :], axis=-1)

    def energy(self, invariants: Array) -> Array:
        """Strain energy [J]."""
        strains = self.strains(invariants)
        return 0.5 * jnp.sum(self.weights * jnp.sum(strains * self.resultants(strains), axis=-1))


class DirectorDamping(Force):
    """Internal damping of a director element: section forces C_v de/dt of its strain rates.

    Attributes:
        markers: attachments of the element's nodes.
        values: of the shape functions at the Gauss points, shape (points, nodes).
        slopes: their derivatives by arc length [1/m].
        weights: of the Gauss points [m].
        viscosity: C_v, shape (6, 6) [N s, N m s, N m^2 s].
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=0)))
    values: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, None))))
    slopes: Any = eqx.field(kw_only=True, metadata=is_a(Numbers((None, None))))
    weights: Any = eqx.field(kw_only=True, metadata=is_a(Vector(None)))
    viscosity: Any = eqx.field(kw_only=True, metadata=is_a(Definite((6, 6))))

    kind: ClassVar[str] = "director damping"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Forces -(de/dx)^T C_v de/dt on the nodes."""

        def strains(x: Array) -> Array:
            return director_strains(x, self.values, self.slopes)

        speed = jax.jvp(strains, (x,), (rate,))[1]
        pull = -self.weights[:, None] * jnp.sum(self.viscosity * speed[:, None, :], axis=-1)
        return Load(jax.vjp(strains, x)[1](pull)[0], None)
