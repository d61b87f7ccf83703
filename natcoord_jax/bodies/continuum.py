"""What shells and solids have in common: a mesh, a material, and how they move as a whole."""

from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.mesh_handle import MeshHandle
from natcoord_jax.bodies.rigid import Orientation, orientation
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import as_array, is_concrete, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Numbers
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.materials import MASS, Elastic
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
