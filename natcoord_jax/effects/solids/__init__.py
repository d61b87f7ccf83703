"""Solids."""

from natcoord_jax.effects.solids.brick import Brick
from natcoord_jax.effects.solids.elements import (
    Hexahedron8,
    Hexahedron20,
    Hexahedron27,
    Hexahedron27P1,
    Tetrahedron10,
    Tetrahedron10P0,
)

__all__ = [
    "Brick",
    "Hexahedron20",
    "Hexahedron27",
    "Hexahedron27P1",
    "Hexahedron8",
    "Tetrahedron10",
    "Tetrahedron10P0",
]
