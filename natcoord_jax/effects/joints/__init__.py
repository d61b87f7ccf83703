"""Joints, their coordinates and relations between coordinates."""

from natcoord_jax.effects.joints.lower_pairs import (
    Cylindrical,
    Distance,
    Fixed,
    Planar,
    Prismatic,
    Revolute,
    Screw,
    Spherical,
    Universal,
)
from natcoord_jax.effects.joints.relations import Coupling, Drive

__all__ = [
    "Coupling",
    "Cylindrical",
    "Distance",
    "Drive",
    "Fixed",
    "Planar",
    "Prismatic",
    "Revolute",
    "Screw",
    "Spherical",
    "Universal",
]
