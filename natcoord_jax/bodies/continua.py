"""Shells and solids: the nodes of a mesh, and elements on its cells."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.bodies.nodes import Nodes
from natcoord_jax.bodies.rigid import Orientation, orientation
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array, is_concrete, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Number, Numbers
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.materials import Elastic
from natcoord_jax.effects.shells import ShellElement
from natcoord_jax.effects.solids import Brick
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mesh import Mesh

MESH = of("a mesh, as nc.mesh.box(...)", Mesh)
MATERIAL = of("a material, as nc.Elastic(...)", Elastic)
MOVING = COMPONENTS | Numbers((None, 3))

FOLD = 45.0
"""Angle [degrees] between cells and their mean normal at a node beyond which a surface is folded there."""


@dataclass(frozen=True)
class MeshHandle(Handle):
    """A reference to a shell or a solid in a scene: as an effect for sensors and energies, and to its nodes.

    Attributes:
        nodes: of the mesh, a set that is indexed, sliced and selected by position; joints, loads, springs and
            sensors take its nodes as any body.
        mesh: as it was given.
        material: of it.
        thickness: of a shell at its cells (cells,) [m]; None: it is a solid.
    """

    nodes: NodeSet = field(compare=False)
    mesh: Mesh = field(compare=False)
    material: Any = field(compare=False, repr=False, default=None)
    thickness: Any = field(compare=False, repr=False, default=None)

    def set(self, name: str) -> NodeSet:
        """The nodes of a set of the mesh, as "left".

        Raises:
            ValueError: for a name that there is not, naming those that there are.
        """
        if name not in self.mesh.sets:
            raise ValueError(f"{self.name!r} has no nodes {name!r}; its mesh has {sorted(self.mesh.sets)}")
        return self.nodes[self.mesh.sets[name]]

    def face(self, name: str | None = None) -> "Surface":
        """Faces of a solid by their name in the mesh, as "x1"; without one all that are outside, or a shell.

        Raises:
            ValueError: for a name that there is not, naming those that there are.
        """
        shell = self.mesh.cells.shape[1] == 4
        if name is None:
            return Surface(self, self.mesh.cells if shell else self.mesh.outside)
        if name not in self.mesh.faces:
            known = sorted(self.mesh.faces) or "none by name"
            raise ValueError(f"{self.name!r} has no faces {name!r}; its mesh has {known}")
        return Surface(self, self.mesh.faces[name])

    def surface(self, side: str) -> "Surface":
        """A shell as it is touched from one side: "outside", where its directors point, or "inside".

        Raises:
            ValueError: for a solid, or another side.
        """
        turns = {"outside": 1, "inside": -1}
        if self.thickness is None or side not in turns:
            raise ValueError(
                f"{self.name!r}: there is no side {side!r}; pass 'outside' or 'inside' of a shell, and take "
                "face(...) of a solid"
            )
        return Surface(self, self.mesh.cells[:, :: turns[side]], one_sided=True)

    def nearest(self, position: Any) -> Handle:
        """The node nearest to a position in the assembled pose [m]."""
        away = np.asarray(self.nodes.positions) - np.asarray(position, float)
        return self.nodes[int(np.argmin(np.sum(away**2, axis=1)))]


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of a solid, or a shell.

    Attributes:
        handle: of the solid or the shell.
        faces: numbers of the nodes round each of them (f, 4), in turn as seen from outside.
        one_sided: whether a shell is touched from outside only.
    """

    handle: MeshHandle
    faces: Int[np.ndarray, "f 4"]
    one_sided: bool = False

    def __repr__(self) -> str:
        return f"<{len(self.faces)} faces of {self.handle.name!r}>"


@eager_numpy
def _placed(
    nodes: Float[Array, "n 3"], position: Array, rotation: Array, velocity: Array, spin: Array
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Places and velocities of nodes that move as a rigid body does, given that of the mesh's origin."""
    arms = nodes @ rotation.T
    return position + arms, velocity + cross(spin, arms)


@eager_numpy
def _normals(nodes: Float[Array, "n 3"], cells: Int[np.ndarray, "m 4"]) -> Float[Array, "n 3"]:
    """Mean normals of the cells at the nodes, by their areas."""
    corners = nodes[cells]
    areas = cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    total = jnp.zeros_like(nodes).at[cells].add(areas[:, None])
    size = jnp.sqrt(jnp.sum(total**2, axis=1, keepdims=True))
    return total / jnp.where(size > 0, size, 1.0)


class _Continuum(Recipe):
    """What shells and solids have in common."""

    mesh: Any = eqx.field(metadata=is_a(MESH))
    material: Any = eqx.field(kw_only=True, metadata=is_a(MATERIAL))
    position: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    orientation: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Orientation()))
    velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(MOVING))
    angular_velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    corners: ClassVar[int] = 0

    def _pose(self, name: str) -> tuple[Array, Array, Array, Array]:
        """Places and velocities of the nodes, rotation of the mesh, angular velocity."""
        require_double(f"{self.kind} {name!r}")
        if self.mesh.cells.shape[1] != self.corners:
            raise ValueError(
                f"{self.kind} {name!r}: {self.mesh!r} has cells of {self.mesh.cells.shape[1]} nodes; pass "
                f"one with {self.corners}"
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

    def _handle(self, scene: Builder, nodes: NodeSet, elements: Any, thickness: Any = None) -> MeshHandle:
        found = scene.add(elements)
        return MeshHandle(found.kind, found.name, found.scene, nodes, self.mesh, self.material, thickness)


class Shell(_Continuum):
    """A shell on a mesh of quadrilaterals: nodes with a director through the thickness, and their elements.

    Attributes:
        mesh: of its mid-surface.
        thickness: [m], one number or one for each cell.
        material: as `nc.Elastic(...)`, with a density.
        position: of the origin of the mesh [m].
        orientation: of the mesh: a rotation matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad]).
        velocity: of the origin of the mesh (3,), or of every node besides its rotation (n, 3) [m/s].
        angular_velocity: as of a rigid body [rad/s].
        directors: at the nodes (n, 3), in the axes of the mesh [-]; default: mean normals of the cells.
        name: of the elements; the nodes are called "name nodes".

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
    directors: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Numbers((None, 3))))

    kind = "shell"
    corners: ClassVar[int] = 4

    def add_to(self, scene: Builder, name: str) -> MeshHandle:
        """Add nodes and elements."""
        places, velocities, turned, spin = self._pose(name)
        along = self.directors
        if along is None:
            along = _normals(as_array(self.mesh.nodes, float), self.mesh.cells)
            self._check_folds(along, name)
        directors = _turned(as_array(along, float), turned)
        moving = {"velocity": velocities, "angular_velocity": spin, "name": f"{name} nodes"}
        nodes = scene.add(Nodes.directors(places, directors, **moving))
        thick = as_array(self.thickness, float)
        if thick.ndim and thick.shape != (len(self.mesh.cells),):
            raise ValueError(
                f"shell {name!r}: thickness [m] has shape {thick.shape}; pass one number, or "
                f"{(len(self.mesh.cells),)} for the cells"
            )
        own = {"each": {"thickness": thick}} if thick.ndim else {"thickness": thick}
        elements = ShellElement.on(nodes, self.mesh.cells, material=self.material, name=name, **own)
        each = as_array(np.broadcast_to(thick, (len(self.mesh.cells),))) if is_concrete(thick) else thick
        return self._handle(scene, nodes, elements, each)

    def _check_folds(self, normals: Array, name: str) -> None:
        if not is_concrete(normals, self.mesh.nodes):
            return
        corners = np.asarray(self.mesh.nodes)[self.mesh.cells]
        own = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        size = np.linalg.norm(own, axis=1)
        if np.any(size == 0):
            raise ValueError(f"shell {name!r}: cell {int(np.argmin(size))} of the mesh has no area")
        cosines = np.sum((own / size[:, None])[:, None] * np.asarray(normals)[self.mesh.cells], axis=2)
        if cosines.min() < np.cos(np.radians(FOLD)):
            node = int(self.mesh.cells.flat[np.argmin(cosines)])
            raise ValueError(
                f"shell {name!r}: at node {node} the surface is folded, or its cells are listed in turn one "
                "way and the other; list all of them the same way, pass `directors` (n, 3), or make one "
                "shell of each side of the fold and join them"
            )


@eager_numpy
def _turned(vectors: Float[Array, "n 3"], rotation: Float[Array, "3 3"]) -> Float[Array, "n 3"]:
    return vectors @ rotation.T


class Solid(_Continuum):
    """A solid on a mesh of hexahedra: nodes that are points, and elements between them.

    Attributes:
        mesh: of hexahedra.
        material: as `nc.Elastic(...)`, with a density.
        position: of the origin of the mesh [m].
        orientation: of the mesh: a rotation matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad]).
        velocity: of the origin of the mesh (3,), or of every node besides its rotation (n, 3) [m/s].
        angular_velocity: as of a rigid body [rad/s].
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

    kind = "solid"
    corners: ClassVar[int] = 8

    def add_to(self, scene: Builder, name: str) -> MeshHandle:
        """Add nodes and elements."""
        places, velocities, _, _ = self._pose(name)
        nodes = scene.add(Nodes.points(places, velocity=velocities, name=f"{name} nodes"))
        return self._handle(scene, nodes, Brick.on(nodes, self.mesh.cells, material=self.material, name=name))
