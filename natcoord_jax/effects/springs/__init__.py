"""Springs, dampers and stops, between points and on joint coordinates."""

from natcoord_jax.effects.springs.joint_springs import (
    Armature,
    JointDamper,
    JointFriction,
    JointPotential,
    JointSpring,
    JointStops,
    SphericalDamper,
    SphericalSpring,
)
from natcoord_jax.effects.springs.point_springs import Damper, NonlinearSpring, QuadraticSpring, Spring

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
