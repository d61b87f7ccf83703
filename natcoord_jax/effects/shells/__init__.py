"""Shells."""

from natcoord_jax.effects.shells.quadrilateral import ShellElement as ShellElement
