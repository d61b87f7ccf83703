"""Joints, their coordinates and relations between coordinates."""

from natcoord_jax.effects.joints.lower_pairs import (
    Cylindrical as Cylindrical,
    Distance as Distance,
    Fixed as Fixed,
    Planar as Planar,
    Prismatic as Prismatic,
    Revolute as Revolute,
    Screw as Screw,
    Spherical as Spherical,
    Universal as Universal,
)
from natcoord_jax.effects.joints.relations import Coupling as Coupling, Drive as Drive
