"""Bodies: recipes that give rows and mass."""

from natcoord_jax.bodies.beam import Beam, BeamHandle
from natcoord_jax.bodies.contact import Contact, Plane
from natcoord_jax.bodies.continuum import Shell, Solid
from natcoord_jax.bodies.gas import Gas
from natcoord_jax.bodies.interpolation import DirectorInterpolation, RelativeMotion
from natcoord_jax.bodies.loads import EdgeLoad, LineLoad, Pressure
from natcoord_jax.bodies.mesh_handle import Edge, MeshHandle, Surface
from natcoord_jax.bodies.nodes import Nodes
from natcoord_jax.bodies.rigid import PointMass, RigidBody
from natcoord_jax.bodies.sections import CircularSection, RectangularSection, Section, TubularSection
from natcoord_jax.bodies.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
from natcoord_jax.bodies.tie import Fold, Tie

__all__ = [
    "Beam",
    "BeamHandle",
    "Box",
    "Capsule",
    "CircularSection",
    "Contact",
    "Cylinder",
    "DirectorInterpolation",
    "Edge",
    "EdgeLoad",
    "Ellipsoid",
    "Fold",
    "Gas",
    "LineLoad",
    "MeshHandle",
    "Nodes",
    "Plane",
    "PointMass",
    "Pressure",
    "RectangularSection",
    "RelativeMotion",
    "RigidBody",
    "Section",
    "Shell",
    "Solid",
    "Sphere",
    "Surface",
    "Tie",
    "TubularSection",
]
