"""Bodies: recipes that give rows and mass."""

from natcoord_jax.bodies.beam import Beam as Beam
from natcoord_jax.bodies.beam import BeamHandle as BeamHandle
from natcoord_jax.bodies.contact import Contact as Contact
from natcoord_jax.bodies.contact import Plane as Plane
from natcoord_jax.bodies.edge_load import EdgeLoad as EdgeLoad
from natcoord_jax.bodies.fold import Fold as Fold
from natcoord_jax.bodies.gas import Gas as Gas
from natcoord_jax.bodies.interpolation import DirectorInterpolation as DirectorInterpolation
from natcoord_jax.bodies.interpolation import RelativeMotion as RelativeMotion
from natcoord_jax.bodies.line_load import LineLoad as LineLoad
from natcoord_jax.bodies.mesh_handle import Edge as Edge
from natcoord_jax.bodies.mesh_handle import MeshHandle as MeshHandle
from natcoord_jax.bodies.mesh_handle import Surface as Surface
from natcoord_jax.bodies.nodes import Nodes as Nodes
from natcoord_jax.bodies.rigid import PointMass as PointMass
from natcoord_jax.bodies.rigid import RigidBody as RigidBody
from natcoord_jax.bodies.sections import (
    CircularSection as CircularSection,
)
from natcoord_jax.bodies.sections import (
    RectangularSection as RectangularSection,
)
from natcoord_jax.bodies.sections import (
    Section as Section,
)
from natcoord_jax.bodies.sections import (
    TubularSection as TubularSection,
)
from natcoord_jax.bodies.shapes import (
    Box as Box,
)
from natcoord_jax.bodies.shapes import (
    Capsule as Capsule,
)
from natcoord_jax.bodies.shapes import (
    Cylinder as Cylinder,
)
from natcoord_jax.bodies.shapes import (
    Ellipsoid as Ellipsoid,
)
from natcoord_jax.bodies.shapes import (
    Sphere as Sphere,
)
from natcoord_jax.bodies.shell import Shell as Shell
from natcoord_jax.bodies.solid import Solid as Solid
from natcoord_jax.bodies.surface_load import Pressure as Pressure
from natcoord_jax.bodies.tie import Tie as Tie
