"""Springs, dampers and stops, between points and on joint coordinates."""

from natcoord_jax.effects.springs.joint_friction import JointFriction, SphericalDamper
from natcoord_jax.effects.springs.joint_springs import (
    Armature,
    JointDamper,
    JointPotential,
    JointSpring,
    JointStops,
)
from natcoord_jax.effects.springs.point_springs import Damper, NonlinearSpring, QuadraticSpring, Spring
from natcoord_jax.effects.springs.spherical_spring import SphericalSpring

__all__ = [
    "Armature",
    "Damper",
    "JointDamper",
    "JointFriction",
    "JointPotential",
    "JointSpring",
    "JointStops",
    "NonlinearSpring",
    "QuadraticSpring",
    "SphericalDamper",
    "SphericalSpring",
    "Spring",
]
