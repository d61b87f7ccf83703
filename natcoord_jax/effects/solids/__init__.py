"""Solids."""

from natcoord_jax.effects.solids.brick import Brick as Brick
from natcoord_jax.effects.solids.elements import Hexahedron8 as Hexahedron8
from natcoord_jax.effects.solids.elements import Hexahedron20 as Hexahedron20
from natcoord_jax.effects.solids.elements import Hexahedron27 as Hexahedron27
from natcoord_jax.effects.solids.elements import Hexahedron27P1 as Hexahedron27P1
from natcoord_jax.effects.solids.elements import Tetrahedron10 as Tetrahedron10
from natcoord_jax.effects.solids.elements import Tetrahedron10P0 as Tetrahedron10P0
