"""Solids."""

from natcoord_jax.effects.solids.brick import Brick as Brick
