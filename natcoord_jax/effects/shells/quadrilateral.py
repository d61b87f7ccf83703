"""A shell element of four nodes, each a point with a director.

Its strains are quadratic in the coordinates of the nodes (the paper's section 5): 16 numbers tell all of them
at every point, and the energy of Saint Venant and Kirchhoff is a quadratic function of these. Everything that
keeps such elements from locking is then another constant matrix, made once from the shape of the element:
shear as at the middles of the edges (Bathe and Dvorkin, Int. J. Numer. Methods Eng. 21, 1985), membrane
stresses of five parameters (Pian and Sumihara, ibid. 20, 1984).
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import of
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.effects.materials import Elastic
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.vectors import cross

XI, ETA = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the nodes."""
MODES = np.stack([XI, ETA, XI * ETA]) / 4.0
"""Derivatives by xi, by eta and mixed ones, from values at the nodes."""
EDGES = ((0, 1), (3, 2), (0, 3), (1, 2))
GAUSS = 1.0 / np.sqrt(3.0)
POINTS = ((-GAUSS, -GAUSS), (GAUSS, -GAUSS), (GAUSS, GAUSS), (-GAUSS, GAUSS))
SHAPES = np.array([(1 + XI * xi) * (1 + ETA * eta) / 4 for xi, eta in POINTS])
"""Shape functions of the nodes at the Gauss points."""
MATERIAL = of("a material, as nc.Elastic(...)", Elastic)


def _natural(xi: float, eta: float) -> np.ndarray:
    """Strains xi xi, eta eta and twice xi eta at a point, from changes of the membrane invariants."""
    half = 0.5
    return np.array(
        [[half, 0, half * eta**2, 0, eta, 0], [0, half, half * xi**2, 0, 0, xi], [0, 0, xi * eta, 1, xi, eta]]
    )


def _shears(xi: float, eta: float) -> np.ndarray:
    """Shears along xi and eta at a point, from those at the middles of the edges."""
    return 0.5 * np.array([[1 - eta, 1 + eta, 0, 0], [0, 0, 1 - xi, 1 + xi]])


def _derivatives(y: Float[Array, "4 3 *n"]) -> list[Float[Array, "3 *n"]]:
    """By xi, by eta and mixed, of what is interpolated between the nodes."""
    return [jnp.sum(row.reshape(4, *(1,) * (y.ndim - 1)) * y, axis=0) for row in MODES]


class _Surface:
    """The element's surface in the assembled pose: tangents, and Cartesian axes that follow it."""

    def __init__(self, x: Float[Array, "4 3"]):
        self.a, self.b, self.c = jnp.asarray(MODES) @ x
        one, other = (v / jnp.linalg.norm(v) for v in (self.a, self.b))
        normal = cross(one, other)
        # Half way between the axes that would follow one tangent and those that would follow the other.
        along = one + cross(other, normal / jnp.linalg.norm(normal))
        self.along = along / jnp.linalg.norm(along)

    def at(self, xi: float, eta: float) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
        """Components of the tangents along the axes, and the area per natural area [m^2]."""
        tangents = self.a + self.c * eta, self.b + self.c * xi
        normal = cross(*tangents)
        area = jnp.linalg.norm(normal)
        normal = normal / area
        first = self.along - (self.along @ normal) * normal
        first = first / jnp.linalg.norm(first)
        axes = jnp.stack([first, cross(normal, first)])
        return jnp.stack(tangents) @ axes.T, area


def _cartesian(jacobian: Float[Array, "2 2"]) -> tuple[Float[Array, "3 3"], Float[Array, "2 2"]]:
    """From natural to Cartesian strains and shears."""
    (p, q), (r, s) = jacobian
    inverse = jnp.stack([jnp.stack([s, -q]), jnp.stack([-r, p])]) / (p * s - q * r)
    (p, q), (r, s) = inverse
    rows = [p * p, q * q, p * q], [r * r, s * s, r * s], [2 * p * r, 2 * q * s, p * s + q * r]
    return jnp.stack([jnp.stack(row) for row in rows]), inverse


def stiffness_of(
    x: Float[Array, "4 3"],
    membrane: Float[Array, "3 3"],
    bending: Float[Array, "3 3"],
    shear: Float[Array, "2 2"],
) -> Float[Array, "16 16"]:
    """Second derivatives of the energy by the invariants.

    Args:
        x: nodes in the assembled pose [m].
        membrane: stiffness against strains [N/m].
        bending: against curvatures [N m].
        shear: against shears [N/m].
    """
    surface = _Surface(x)
    (j1, j2), _ = surface.at(0.0, 0.0)
    points = [(xi, eta, *surface.at(xi, eta)) for xi, eta in POINTS]
    area = sum(p[3] for p in points)
    middle = [sum(p[k] * p[3] for p in points) / area for k in (0, 1)]
    softness, unit = definite_inverse(membrane), jnp.eye(3)

    def stress(j: Array) -> Array:
        return jnp.stack([j[0] ** 2, j[1] ** 2, j[0] * j[1]])

    mixed, soft = jnp.zeros((5, 6)), jnp.zeros((5, 5))
    bend, slide = jnp.zeros((6, 6)), jnp.zeros((4, 4))
    for xi, eta, jacobian, weight in points:
        strain, inverse = _cartesian(jacobian)
        natural = strain @ _natural(xi, eta)
        columns = (eta - middle[1]) * stress(j1), (xi - middle[0]) * stress(j2)
        stresses = jnp.concatenate([unit, jnp.stack(columns, axis=1) / area], axis=1)
        mixed = mixed + weight * stresses.T @ natural
        soft = soft + weight * stresses.T @ softness @ stresses
        bend = bend + weight * natural.T @ bending @ natural
        shears = inverse @ _shears(xi, eta)
        slide = slide + weight * shears.T @ shear @ shears
    found = jnp.zeros((16, 16)).at[:6, :6].set(mixed.T @ definite_inverse(soft) @ mixed)
    return found.at[6:12, 6:12].set(bend).at[12:, 12:].set(slide)


def areas_of(x: Float[Array, "4 3"]) -> Float[Array, "4"]:
    """Areas that the nodes of an element stand for [m^2]."""
    surface = _Surface(x)
    areas = jnp.stack([surface.at(xi, eta)[1] for xi, eta in POINTS])
    return jnp.asarray(SHAPES).T @ areas


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


class ShellElement(Potential):
    """A quadrilateral of four nodes with directors, stress-free as assembled.

    Saint Venant-Kirchhoff material in plane stress. The directors are those through the thickness, in the
    assembled pose normal to the surface. The element brings its mass to its nodes.

    Attributes:
        markers: the four nodes in turn round the element: a point and a director of each.
        thickness: [m].
        material: as `nc.Elastic`.
        reference: points and directors (4, 2, 3) without stress [m, -]; None: those of the assembled pose.
        stiffness: by the invariants, follows from the others.
        rest: invariants without stress, follow from the others.
        areas: that the nodes stand for [m^2], follow from the others.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
        >>> nodes = scene.add(nc.Nodes.directors(corners, (0, 0, 1)))
        >>> glass = nc.Elastic(E=70e9, nu=0.22, density=2500.0)
        >>> pane = scene.add(nc.ShellElement.on(nodes, [range(4)], thickness=4e-3, material=glass))
        >>> float(scene.compile()[0].mass[:, 0, 0].sum().round(6))
        10.0
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=4)))
    thickness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    material: Any = eqx.field(kw_only=True, metadata=is_a(MATERIAL))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((4, 2, 3))))
    stiffness: Any = eqx.field(default=None, init=False)
    rest: Any = eqx.field(default=None, init=False)
    areas: Any = eqx.field(default=None, init=False)

    kind: ClassVar[str] = "shell"
    degree: ClassVar[int | None] = 2
    units: ClassVar[tuple[int, ...] | None] = (6, 6, 4)
    together: ClassVar[bool] = True
    vectors: ClassVar[int] = 2
    faces: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1, 2, 3),)
    derived: ClassVar[tuple[str, ...]] = ("stiffness", "rest", "areas")
    silent: ClassVar[bool] = False

    def assembled_at(self, x: Float[Array, "4 *m 3"]) -> "ShellElement":
        """With the assembled pose as the one without stress, unless another is given."""
        given = x[:, :2] if self.reference is None else self.reference
        return replace_fields(self, reference=given).renewed()

    def renewed(self) -> "ShellElement":
        """With the stiffness and the invariants of the pose without stress."""
        x, (membrane, bending, shear) = self.reference, self.sheet()
        return replace_fields(
            self,
            stiffness=stiffness_of(x[:, 0], membrane, bending, shear),
            rest=self.invariants(x),
            areas=areas_of(x[:, 0]),
        )

    def sheet(self) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"], Float[Array, "2 2"]]:
        """Stiffness against strains [N/m], curvatures [N m] and shears [N/m]."""
        h, plane = self.thickness, self.material.plane_stress()
        return h * plane, h**3 / 12 * plane, h * self.material.transverse_shear()

    def lumped_mass(self) -> Float[Array, "4 2"]:
        """Of the points [kg] and of the directors [kg m^2]."""
        h = self.thickness
        each = self.material.density * h * self.areas
        return jnp.stack([each, h**2 / 12 * each], axis=1)

    def flaws(self) -> dict[str, Array]:
        """Corners that are no corners."""
        return {
            "is degenerate or turned over: list its nodes in turn round it": jnp.min(self.areas) <= 0.0,
            **self.material.flaws(),
        }

    def invariants(self, x: Float[Array, "4 m 3 *n"]) -> Float[Array, "16 *n"]:
        """Membrane [m^2], curvature [m] and shear [m]."""

        def dot(u: Array, v: Array) -> Array:
            return jnp.sum(u * v, axis=0)

        place, director = x[:, 0], x[:, 1]
        a, b, c = _derivatives(place)
        d, e, f = _derivatives(director)
        membrane = dot(a, a), dot(b, b), dot(c, c), dot(a, b), dot(a, c), dot(b, c)
        twice = 2 * dot(a, d), 2 * dot(b, e), 2 * dot(c, f)
        bending = *twice, dot(a, e) + dot(b, d), dot(a, f) + dot(c, d), dot(b, f) + dot(c, e)
        shear = (0.25 * dot(place[j] - place[i], director[i] + director[j]) for i, j in EDGES)
        return jnp.stack([*membrane, *bending, *shear])

    def energy(self, invariants: Float[Array, "16 *n"]) -> Float[Array, "*n"]:
        """Energy [J]."""
        strain = invariants - self.rest
        return 0.5 * jnp.sum(self.stiffness * strain[:, None] * strain[None], axis=(0, 1))

    def slope(self, invariants: Float[Array, "16 *n"]) -> Float[Array, "16 *n"]:
        """Stresses conjugate to the invariants."""
        return jnp.sum(self.stiffness * (invariants - self.rest)[None], axis=1)

    def energy_curvature(self, invariants: Float[Array, " p"]) -> Float[Array, "p p"]:
        """The constant stiffness."""
        return self.stiffness

    def readings(self, place: Array, rows: Array) -> ShellReadings:
        """Strains and stresses in the middle."""
        found = self.invariants(place_markers(place, rows))
        change, h = found - self.rest, self.thickness
        strain_of, inverse = _cartesian(_Surface(self.reference[:, 0]).at(0.0, 0.0)[0])
        strain, curvature = (strain_of @ _natural(0.0, 0.0) @ x for x in (change[:6], change[6:12]))
        shear = inverse @ _shears(0.0, 0.0) @ change[12:]
        membrane, bending, sliding = self.sheet()
        plane = membrane / h
        stress = jnp.stack([plane @ (strain + side * h / 2 * curvature) for side in (-1.0, 1.0)])
        return ShellReadings(
            strain,
            curvature,
            shear,
            membrane @ strain,
            bending @ curvature,
            sliding @ shear,
            stress,
            self.energy(found),
        )
