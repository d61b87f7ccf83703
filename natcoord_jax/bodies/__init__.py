"""Bodies: recipes that give rows and mass."""

from natcoord_jax.bodies.rigid import PointMass as PointMass, RigidBody as RigidBody
from natcoord_jax.bodies.shapes import (
    Box as Box,
    Cylinder as Cylinder,
    Ellipsoid as Ellipsoid,
    Sphere as Sphere,
)
