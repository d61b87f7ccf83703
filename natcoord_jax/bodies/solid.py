"""Solids: nodes that are points, and elements between them."""

from typing import Any, ClassVar

import equinox as eqx

from natcoord_jax.bodies.continuum import Continuum
from natcoord_jax.bodies.mesh_handle import MeshHandle
from natcoord_jax.bodies.nodes import Nodes
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.kinds import Choice, of
from natcoord_jax.core.recipe import Builder
from natcoord_jax.effects.hyperelastic import Hyperelastic
from natcoord_jax.effects.materials import Elastic
from natcoord_jax.effects.solids import (
    Brick,
    Hexahedron8,
    Hexahedron20,
    Hexahedron27,
    Hexahedron27P1,
    Tetrahedron10,
    Tetrahedron10P0,
)
from natcoord_jax.effects.solids.elements import SolidElement

SOLID_MATERIAL = of("a material, as nc.Elastic(...) or nc.NeoHooke(...)", Elastic, Hyperelastic)
SOLID_ELEMENTS = {
    8: (Brick, Hexahedron8),
    10: (Tetrahedron10, Tetrahedron10P0),
    20: (Hexahedron20,),
    27: (Hexahedron27, Hexahedron27P1),
}
"""Elements by the number of nodes of a cell."""
ELEMENT = Choice(tuple(e.__name__ for elements in SOLID_ELEMENTS.values() for e in elements))


class Solid(Continuum):
    """A solid on a mesh of hexahedra or tetrahedra: nodes that are points, and elements between them.

    Attributes:
        mesh: of hexahedra of 8, 20 or 27 nodes or tetrahedra of 10.
        material: as `nc.Elastic(...)` or `nc.NeoHooke(...)`, with a density.
        element: name of the class of the elements. Default: on hexahedra of eight nodes "Brick", which does
            not lock in bending, for `nc.Elastic`, else "Hexahedron8"; on others "Hexahedron20",
            "Hexahedron27" or "Tetrahedron10", and "Hexahedron27P1" or "Tetrahedron10P0", which nearly
            incompressible materials need, for materials that split off the energy of a change of volume.
        position: of the origin of the mesh [m].
        orientation: of the mesh: a rotation matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad]).
        velocity: of the origin of the mesh (3,), or of every node besides its rotation (n, 3) [m/s].
        angular_velocity: as of a rigid body [rad/s].
        mass: "lumped" or "consistent", see `nc.Shell`.
        name: of the elements; the nodes are called "name nodes".

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> rubber = nc.Elastic(E=1e6, nu=0.3, density=1000.0)
        >>> block = scene.add(nc.Solid(nc.mesh.box((1, 0.2, 0.2), (4, 1, 1)), material=rubber))
        >>> held = scene.add(nc.Clamp(nc.ground, block.set("x0")))
        >>> system, state = scene.compile()
        >>> system.structure.dofs
        48
    """

    material: Any = eqx.field(kw_only=True, metadata=is_a(SOLID_MATERIAL))
    element: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(ELEMENT))

    kind = "solid"
    corners: ClassVar[tuple[int, ...]] = tuple(SOLID_ELEMENTS)

    def _element(self, name: str) -> type[Brick] | type[SolidElement]:
        """The class of the elements.

        Raises:
            ValueError: for one of another number of nodes, or of other materials.
        """
        fitting = SOLID_ELEMENTS[self.mesh.cells.shape[1]]
        if self.element is None:
            first = fitting[0]
            simple = isinstance(self.material, Elastic) if first is Brick else not self.material.split
            return first if simple else fitting[-1]
        found = [e for e in fitting if e.__name__ == self.element]
        if not found:
            raise ValueError(
                f"solid {name!r}: {self.element} is no element for {self.mesh!r}; pass one of "
                f"{[e.__name__ for e in fitting]}"
            )
        if found[0] is Brick and not isinstance(self.material, Elastic):
            raise ValueError(
                f"solid {name!r}: its enhanced strains keep Brick to nc.Elastic(...); pass Hexahedron8, or a "
                "mesh of hexahedra with 20 or 27 nodes"
            )
        return found[0]

    def add_to(self, scene: Builder, name: str) -> MeshHandle:
        """Add nodes and elements."""
        places, velocities, turned, _ = self.pose(name)
        element, material = self._element(name), self.material.turned(turned)
        nodes = scene.add(Nodes.points(places, velocity=velocities, name=f"{name} nodes"))
        return self.handle(
            scene, nodes, element.on(nodes, self.mesh.cells, material=material, mass=self.mass, name=name)
        )
