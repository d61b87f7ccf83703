"""A shell element of four nodes, each a point with a director.

Its strains are quadratic in the coordinates of the nodes (the paper's section 5): 16 numbers tell all of them
at every point, and the energy of a material that is linear in them is a quadratic function of these. All that
keeps such elements from locking is then in a constant matrix, see `stiffness`.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.kinds import Choice
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Numbers
from natcoord_jax.effects.shells.layer import LayerElement
from natcoord_jax.effects.shells.stiffness import (
    EDGES,
    QuadrilateralMatrices,
    QuadrilateralSurface,
    cartesian,
    derivatives_of,
    dot,
    natural_shears,
    natural_strains,
    overlaps_of,
)

MEMBRANES = ("hybrid", "hybrid mitc4+")


def membrane_invariants(place: Float[Array, "4 3 *n"]) -> tuple[Array, ...]:
    """Products of the derivatives of the place [m^2]."""
    a, b, c = derivatives_of(place)
    return dot(a, a), dot(b, b), dot(c, c), dot(a, b), dot(a, c), dot(b, c)


class Quadrilateral(LayerElement):
    """What shells and membranes of four nodes have in common."""

    membrane: str = eqx.field(default="hybrid", kw_only=True, static=True, metadata=is_a(Choice(MEMBRANES)))

    faces: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1, 2, 3),)

    def matrices(self, x: Float[Array, "4 3"]) -> QuadrilateralMatrices:
        """Integrals over the element."""
        return QuadrilateralMatrices(x, self.sheet(), self.direction, self.membrane == MEMBRANES[1])

    def overlaps_of(self, x: Float[Array, "4 3"]) -> Float[Array, "4 4"]:
        """Of its nodes."""
        return overlaps_of(x)

    def middle(self, x: Float[Array, "4 3"]) -> tuple[Array, Array]:
        """By membrane invariants, and by shears."""
        strain_of, inverse = cartesian(QuadrilateralSurface(x, self.direction).at(0.0, 0.0)[0])
        return strain_of @ natural_strains(0.0, 0.0), inverse @ natural_shears(0.0, 0.0)


class ShellElement(Quadrilateral):
    """A quadrilateral of four nodes with directors, stress-free as assembled.

    Strains of Green and Lagrange, plane stress. The directors are those through the thickness, in the
    assembled pose normal to the surface. The element brings its mass to its nodes.

    Attributes:
        markers: the four nodes in turn round the element: a point and a director of each.
        thickness: [m].
        material: as `nc.Elastic`, `nc.Orthotropic` or `nc.Laminate`.
        direction: that, projected on the surface, is the first axis of the material and of what is read [-];
            default: half way between the sides.
        offset: of the middle of the thickness from the nodes, along the director [m]; default: none.
        prestress: resultants per length 11, 22, 12 that are there without strain [N/m]; default: none.
        damping: time by which viscous stresses are their stiffness times the rates of strain [s]; default:
            none. What is lost is in the work account of the elements.
        membrane: "hybrid": stresses of Pian and Sumihara; "hybrid mitc4+": with assumed strains, softer on
            coarse curved meshes.
        reference: points and directors (4, 2, 3) without stress [m, -]; None: those of the assembled pose.
        stiffness: by the invariants, follows from the others.
        rest: invariants without stress, follow from the others.
        pull: stresses of the prestress, follow from the others.
        mass: "lumped" at the nodes, or "consistent": between them, too, that of the interpolated motion.
        overlaps: integrals of products of the shape functions [m^2], follow from the others.

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
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((4, 2, 3))))

    kind: ClassVar[str] = "shell"
    units: ClassVar[tuple[int, ...] | None] = (6, 6, 4)
    vectors: ClassVar[int] = 2

    def invariants(self, x: Float[Array, "4 m 3 *n"]) -> Float[Array, "16 *n"]:
        """Membrane [m^2], curvature [m] and shear [m]."""
        place, director = x[:, 0], x[:, 1]
        a, b, c = derivatives_of(place)
        d, e, f = derivatives_of(director)
        twice = 2 * dot(a, d), 2 * dot(b, e), 2 * dot(c, f)
        bending = *twice, dot(a, e) + dot(b, d), dot(a, f) + dot(c, d), dot(b, f) + dot(c, e)
        shear = (0.25 * dot(place[j] - place[i], director[i] + director[j]) for i, j in EDGES)
        return jnp.stack([*membrane_invariants(place), *bending, *shear])


class MembraneElement(Quadrilateral):
    """A quadrilateral of four points that resists stretching only.

    Where it is slack it has no stiffness against bending at all. The element brings its mass to its nodes.

    Attributes:
        markers: the four points in turn round the element.
        thickness: [m].
        material: as `nc.Elastic`, `nc.Orthotropic` or `nc.Laminate`.
        direction: see `nc.ShellElement`.
        offset: must be None: there is no director along which it would be.
        prestress: resultants per length 11, 22, 12 that are there without strain [N/m]; default: none.
        damping: see `nc.ShellElement` [s].
        membrane: see `nc.ShellElement`.
        mass: see `nc.ShellElement`.
        reference: points (4, 3) without strain [m]; None: those of the assembled pose.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
        >>> nodes = scene.add(nc.Nodes.points(corners))
        >>> foil = nc.Elastic(E=3e9, nu=0.3, density=1400.0)
        >>> skin = scene.add(nc.MembraneElement.on(nodes, [range(4)], thickness=1e-4, material=foil))
        >>> print(f"{scene.compile()[0].mass[:, 0, 0].sum():.2f}")
        0.14
    """

    markers: Any = eqx.field(metadata=is_a(Markers(4)))
    reference: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((4, 3))))

    kind: ClassVar[str] = "membrane"
    bends: ClassVar[bool] = False

    def invariants(self, x: Float[Array, "4 3 *n"]) -> Float[Array, "6 *n"]:
        """Membrane [m^2]."""
        return jnp.stack(membrane_invariants(x))
