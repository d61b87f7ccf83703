"""Shells."""

from natcoord_jax.effects.shells.quadrilateral import MembraneElement as MembraneElement
from natcoord_jax.effects.shells.quadrilateral import ShellElement as ShellElement
from natcoord_jax.effects.shells.triangle import MembraneTriangle as MembraneTriangle
from natcoord_jax.effects.shells.triangle import ShellTriangle as ShellTriangle
