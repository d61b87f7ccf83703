"""Shells."""

from natcoord_jax.effects.shells.quadrilateral import MembraneElement, ShellElement
from natcoord_jax.effects.shells.triangle import MembraneTriangle, ShellTriangle

__all__ = [
    "MembraneElement",
    "MembraneTriangle",
    "ShellElement",
    "ShellTriangle",
]
