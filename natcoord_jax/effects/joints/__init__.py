"""Joints, their coordinates and relations between coordinates."""

from natcoord_jax.effects.joints.lower_pairs import (
    Cylindrical as Cylindrical,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Distance as Distance,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Fixed as Fixed,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Planar as Planar,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Prismatic as Prismatic,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Revolute as Revolute,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Screw as Screw,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Spherical as Spherical,
)
from natcoord_jax.effects.joints.lower_pairs import (
    Universal as Universal,
)
from natcoord_jax.effects.joints.relations import Coupling as Coupling
from natcoord_jax.effects.joints.relations import Drive as Drive
