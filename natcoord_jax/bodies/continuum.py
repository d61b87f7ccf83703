"""Shells and solids: a mesh, a material, and how they move as a whole."""

from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.mesh_handle import MeshHandle, check_folds, normals_at
from natcoord_jax.bodies.nodes import Nodes
from natcoord_jax.bodies.rigid import Orientation, orientation
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array, is_concrete, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import FLAG, NAME, Choice, of
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Directions, Number, Numbers
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.hyperelastic import Hyperelastic
from natcoord_jax.effects.materials import MASS, Elastic
from natcoord_jax.effects.shells import MembraneElement, MembraneTriangle, ShellElement, ShellTriangle
from natcoord_jax.effects.shells.layer import MATERIAL as LAYER
from natcoord_jax.effects.shells.quadrilateral import MEMBRANES
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
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mesh import Mesh

MESH = of("a mesh, as nc.mesh.box(...)", Mesh)
MATERIAL = of("a material, as nc.Elastic(...)", Elastic)
MOVING = COMPONENTS | Numbers((None, 3))


@eager_numpy
def _placed(
    nodes: Float[Array, "n 3"], position: Array, rotation: Array, velocity: Array, spin: Array
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Places and velocities of nodes that move as a rigid body does, given that of the mesh's origin."""
    arms = nodes @ rotation.T
    return position + arms, velocity + cross(spin, arms)


class Continuum(Recipe):
    """What shells and solids have in common."""

    mesh: Any = eqx.field(metadata=is_a(MESH))
    material: Any = eqx.field(kw_only=True, metadata=is_a(MATERIAL))
    position: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    orientation: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Orientation()))
    velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(MOVING))
    angular_velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    mass: str = eqx.field(default="lumped", kw_only=True, static=True, metadata=is_a(MASS))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    corners: ClassVar[tuple[int, ...]] = ()
    """Numbers of nodes of the cells that it takes."""

    def pose(self, name: str) -> tuple[Array, Array, Array, Array]:
        """Places and velocities of the nodes, rotation of the mesh, angular velocity."""
        require_double(f"{self.kind} {name!r}")
        if self.mesh.cells.shape[1] not in self.corners:
            raise ValueError(
                f"{self.kind} {name!r}: {self.mesh!r} has cells of {self.mesh.cells.shape[1]} nodes; pass "
                f"one with {' or '.join(map(str, self.corners))}"
            )
        if is_concrete(self.material.density) and not np.all(np.asarray(self.material.density) > 0):
            raise ValueError(
                f"{self.kind} {name!r}: the density [kg/m^3] of its material is zero, so that nothing "
                f"resists a force; pass {type(self.material).__name__}(density=...)"
            )
        turned = orientation(self.orientation, f"{self.kind} {name!r}")
        spin = as_array(self.angular_velocity, float)
        given = as_array(self.position, float), turned, as_array(self.velocity, float), spin
        return *_placed(as_array(self.mesh.nodes, float), *given), turned, spin

    def handle(
        self, scene: Builder, nodes: NodeSet, elements: Any, thickness: Any = None, *, bends: bool = False
    ) -> MeshHandle:
        """Add elements, whose handle is that of the body."""
        found = scene.add(elements)
        own = nodes, self.mesh, self.material, thickness, bends
        return MeshHandle(found.kind, found.name, found.scene, *own)


@eager_numpy
def _turned(vectors: Float[Array, "n 3"], rotation: Float[Array, "3 3"]) -> Float[Array, "n 3"]:
    return vectors @ rotation.T


class Shell(Continuum):
    """A shell on a mesh of quadrilaterals and triangles: nodes with a director, and their elements.

    Attributes:
        mesh: of its mid-surface.
        thickness: [m], one number or one for each cell.
        material: as `nc.Elastic(...)`, with a density.
        position: of the origin of the mesh [m].
        orientation: of the mesh: a rotation matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad]).
        velocity: of the origin of the mesh (3,), or of every node besides its rotation (n, 3) [m/s].
        angular_velocity: as of a rigid body [rad/s].
        mass: "lumped" at the nodes; or "consistent": that of the motion that the elements interpolate, which
            has the exact moments of inertia and couples the accelerations of neighbours.
        directors: at the nodes (n, 3), in the axes of the mesh [-]; default: mean normals of the cells.
        direction: in the axes of the mesh, that, projected on the surface, is the first axis of the material
            and of what is read [-]; default: in every element half way between its sides.
        offset: of the middle of the thickness from the mesh, along the directors [m]; default: none.
        prestress: resultants per length 11, 22, 12 that are there without strain [N/m]; default: none.
        damping: time by which viscous stresses are their stiffness times the rates of strain [s]; default:
            none. What is lost is in the work account of the shell.
        bending: whether it resists bending; if not, its nodes are points without directors.
        membrane: "hybrid", or "hybrid mitc4+", softer on coarse curved meshes; see `nc.ShellElement`.
        name: of the elements; the nodes are called "name nodes". Triangles beside quadrilaterals are a set
            of their own, "name triangles".

    Raises:
        ValueError: when it is added: for a surface that is folded, with the node.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> mesh = nc.mesh.rectangle((1.0, 0.5), (4, 2))
        >>> metal = nc.Elastic(E=70e9, nu=0.3, density=2700.0)
        >>> plate = scene.add(nc.Shell(mesh, thickness=2e-3, material=metal, name="plate"))
        >>> held = scene.add(nc.Clamp(nc.ground, plate.set("left")))
        >>> gravity = scene.add(nc.Gravity())
        >>> system, state = scene.compile()
        >>> end = nc.equilibrium(system, state).state
        >>> corner = plate.nearest((1.0, 0.0, 0.0))
        >>> round(float(system.sense(end, corner).position[2]), 4)
        -0.1277
    """

    thickness: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive") | Numbers((None,), "positive")))
    material: Any = eqx.field(kw_only=True, metadata=is_a(LAYER))
    direction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Directions()))
    offset: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))
    prestress: Any = eqx.field(default=None, kw_only=True, metadata=is_a(COMPONENTS))
    damping: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    bending: bool = eqx.field(default=True, kw_only=True, static=True, metadata=is_a(FLAG))
    membrane: str = eqx.field(default="hybrid", kw_only=True, static=True, metadata=is_a(Choice(MEMBRANES)))
    directors: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 3))))

    kind = "shell"
    corners: ClassVar[tuple[int, ...]] = (4,)

    def add_to(self, scene: Builder, name: str) -> MeshHandle:
        """Add nodes and elements."""
        places, velocities, turned, spin = self.pose(name)
        moving = {"velocity": velocities, "name": f"{name} nodes"}
        if self.bending:
            directors = _turned(as_array(self._directors(name), float), turned)
            nodes = scene.add(Nodes.directors(places, directors, angular_velocity=spin, **moving))
        else:
            nodes = scene.add(Nodes.points(places, **moving))
        thick = as_array(self.thickness, float)
        if thick.ndim and thick.shape != (len(self.mesh.cells),):
            raise ValueError(
                f"shell {name!r}: thickness [m] has shape {thick.shape}; pass one number, or "
                f"{(len(self.mesh.cells),)} for the cells"
            )
        own: dict[str, Any] = {"each": {"thickness": thick}} if thick.ndim else {"thickness": thick}
        if self.direction is not None:
            own["direction"] = _turned(as_array(self.direction, float)[None], turned)[0]
        own |= {
            key: getattr(self, key)
            for key in ("material", "offset", "prestress", "damping", "membrane", "mass")
        }
        cells = self.mesh.cells
        each = as_array(np.broadcast_to(thick, (len(cells),))) if is_concrete(thick) else thick
        three = cells[:, 2] == cells[:, 3]
        if three.any() and not three.all():
            scene.add(self._elements(nodes, three, f"{name} triangles", own))
        main = self._elements(nodes, three if three.all() else ~three, name, own)
        return self.handle(scene, nodes, main, each, bends=self.bending)

    def _elements(self, nodes: NodeSet, some: np.ndarray, name: str, own: dict[str, Any]) -> Any:
        """On some of the cells, which are all triangles or all quadrilaterals."""
        cells = self.mesh.cells[some]
        if "each" in own:
            own = own | {"each": {key: value[some] for key, value in own["each"].items()}}
        if cells[0, 2] == cells[0, 3]:
            cells, own = cells[:, :3], {key: value for key, value in own.items() if key != "membrane"}
            kind: Any = ShellTriangle if self.bending else MembraneTriangle
        else:
            kind = ShellElement if self.bending else MembraneElement
        return kind.on(nodes, cells, name=name, **own)

    def _directors(self, name: str) -> Any:
        if self.directors is not None:
            return self.directors
        found = normals_at(as_array(self.mesh.nodes, float), self.mesh.cells)
        check_folds(self.mesh, found, name)
        return found


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
