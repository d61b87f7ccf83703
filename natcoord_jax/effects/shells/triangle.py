"""Elements of three nodes: for meshes that quadrilaterals do not fill.

Membrane strains and curvatures are constant. Shears are as at the middles of the edges, along these (Lee and
Bathe, Development of MITC isotropic triangular shell finite elements, Comput. Struct. 82, 2004).
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Numbers
from natcoord_jax.effects.materials import Sheet
from natcoord_jax.effects.shells.layer import LayerElement
from natcoord_jax.effects.shells.stiffness import along_axes, cartesian, dot

MIDDLES = ((0.5, 0.0), (0.5, 0.5), (0.0, 0.5))
"""Natural coordinates of the middles of the edges, whose mean is exact to degree two."""
EDGES = ((0, 1), (0, 2), (1, 2))
STRAINS = np.diag([0.5, 0.5, 1.0])
"""Natural strains 11, 22 and twice 12 from changes of the membrane invariants."""


def natural_shears(r: float, s: float) -> np.ndarray:
    """Shears along both natural axes at a point, from those along the edges."""
    # Along r: g_12 + c s, along s: g_13 - c r, and their difference on the third edge is g_23.
    turn = np.array([-1.0, 1.0, -1.0])
    return np.stack([np.array([1.0, 0, 0]) + s * turn, np.array([0, 1.0, 0]) - r * turn])


def tangents_of(y: Float[Array, "3 3 *n"]) -> tuple[Float[Array, "3 *n"], Float[Array, "3 *n"]]:
    """Derivatives by the natural coordinates, which go from 0 to 1 along two edges."""
    return y[1] - y[0], y[2] - y[0]


def jacobian_of(x: Float[Array, "3 3"], direction: Any) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
    """Components of the tangents along the axes of the element, and twice its area [m^2].

    The first axis is the direction that is given, projected, or the first edge.
    """
    one, other = tangents_of(x)
    return along_axes(one, other, one if direction is None else jnp.asarray(direction))


class TriangleMatrices:
    """Integrals over an element, see `QuadrilateralMatrices`."""

    def __init__(self, x: Float[Array, "3 3"], sheet: Sheet, direction: Any):
        jacobian, twice = jacobian_of(x, direction)
        area = 0.5 * twice
        strain, inverse = cartesian(jacobian)
        strain = strain @ STRAINS
        self.stretching = area * strain
        self.membrane = area * strain.T @ sheet.membrane @ strain
        coupled, bent = (area * strain.T @ x @ strain for x in (sheet.coupling, sheet.bending))
        slide = jnp.zeros((3, 3))
        for r, s in MIDDLES:
            shears = inverse @ natural_shears(r, s)
            slide = slide + area / 3.0 * shears.T @ sheet.shear @ shears
        found = jnp.zeros((9, 9)).at[:3, :3].set(self.membrane).at[3:6, 3:6].set(bent)
        self.stiffness = found.at[:3, 3:6].set(coupled).at[3:6, :3].set(coupled.T).at[6:, 6:].set(slide)


class Triangle(LayerElement):
    """What shells and membranes of three nodes have in common."""

    faces: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1, 2, 2),)

    def matrices(self, x: Float[Array, "3 3"]) -> TriangleMatrices:
        """Integrals over the element."""
        return TriangleMatrices(x, self.sheet(), self.direction)

    def overlaps_of(self, x: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """Of its nodes."""
        return jacobian_of(x, None)[1] / 24.0 * (np.ones((3, 3)) + np.eye(3))

    def middle(self, x: Float[Array, "3 3"]) -> tuple[Array, Array]:
        """By membrane invariants, and by shears."""
        strain_of, inverse = cartesian(jacobian_of(x, self.direction)[0])
        return strain_of @ STRAINS, inverse @ natural_shears(1 / 3, 1 / 3)


def membrane_invariants(place: Float[Array, "3 3 *n"]) -> tuple[Array, Array, Array]:
    """Products of the derivatives of the place [m^2]."""
    a, b = tangents_of(place)
    return dot(a, a), dot(b, b), dot(a, b)


class ShellTriangle(Triangle):
    """A triangle of three nodes with directors, stress-free as assembled.

    Stiffer than quadrilaterals: the membrane strain is constant, so that bending in its own plane wants many.

    Attributes:
        markers: the three nodes in turn round the element: a point and a director of each.
        thickness: [m].
        material: as `nc.Elastic`, `nc.Orthotropic` or `nc.Laminate`.
        direction: see `nc.ShellElement`; default: along the first edge.
        offset: see `nc.ShellElement` [m].
        prestress: see `nc.ShellElement` [N/m].
        damping: see `nc.ShellElement` [s].
        mass: see `nc.ShellElement`.
        reference: points and directors (3, 2, 3) without stress [m, -]; None: those of the assembled pose.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)
        >>> nodes = scene.add(nc.Nodes.directors(corners, (0, 0, 1)))
        >>> glass = nc.Elastic(E=70e9, nu=0.22, density=2500.0)
        >>> pane = scene.add(nc.ShellTriangle.on(nodes, [range(3)], thickness=4e-3, material=glass))
        >>> print(f"{scene.compile()[0].mass[:, 0, 0].sum():.2f}")
        5.00
    """

    markers: Any = eqx.field(metadata=is_a(Markers(attachments=3)))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((3, 2, 3))))

    kind: ClassVar[str] = "shell triangle"
    units: ClassVar[tuple[int, ...] | None] = (3, 3, 3)
    vectors: ClassVar[int] = 2

    def invariants(self, x: Float[Array, "3 m 3 *n"]) -> Float[Array, "9 *n"]:
        """Membrane [m^2], curvature [m] and shear [m]."""
        place, director = x[:, 0], x[:, 1]
        (a, b), (d, e) = tangents_of(place), tangents_of(director)
        bending = 2 * dot(a, d), 2 * dot(b, e), dot(a, e) + dot(b, d)
        shear = (0.5 * dot(place[j] - place[i], director[i] + director[j]) for i, j in EDGES)
        return jnp.stack([*membrane_invariants(place), *bending, *shear])


class MembraneTriangle(Triangle):
    """A triangle of three points that resists stretching only.

    Attributes:
        markers: the three points in turn round the element.
        thickness: [m].
        material: as `nc.Elastic`, `nc.Orthotropic` or `nc.Laminate`.
        direction: see `nc.ShellElement`; default: along the first edge.
        offset: must be None: there is no director along which it would be.
        prestress: see `nc.ShellElement` [N/m].
        damping: see `nc.ShellElement` [s].
        mass: see `nc.ShellElement`.
        reference: points (3, 3) without strain [m]; None: those of the assembled pose.

    Example:
        >>> import natcoord_jax as nc
        >>> corners = tuple(nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (0, 1, 0)))
        >>> sail = nc.MembraneTriangle(corners, thickness=1e-4, material=nc.Elastic(E=3e9))
    """

    markers: Any = eqx.field(metadata=is_a(Markers(3)))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((3, 3))))

    kind: ClassVar[str] = "membrane triangle"
    bends: ClassVar[bool] = False

    def invariants(self, x: Float[Array, "3 3 *n"]) -> Float[Array, "3 *n"]:
        """Membrane [m^2]."""
        return jnp.stack(membrane_invariants(x))
