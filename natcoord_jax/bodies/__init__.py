"""Bodies: recipes that give rows and mass."""

from natcoord_jax.bodies.rigid import PointMass as PointMass
from natcoord_jax.bodies.rigid import RigidBody as RigidBody
from natcoord_jax.bodies.shapes import (
    Box as Box,
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
